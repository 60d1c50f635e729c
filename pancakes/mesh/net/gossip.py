"""Gossip: how agents tell each other where others can be dialled, so that a fleet becomes a full mesh."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, Protocol

from pancakes.mesh.address import LOCAL
from pancakes.mesh.net.links import Links
from pancakes.mesh.net.peers import Peers
from pancakes.mesh.net.session import Session
from pancakes.mesh.net.transport import Transport
from pancakes.mesh.way_facts import reachable_from
from pancakes.mesh.wire.link_messages import Gossip, Role

ADDRESSES: Final = 64
"""Most addresses in one message to a new link."""

_EVERYWHERE: Final = (LOCAL, "tcp")
"""Each agent dials these; other schemes those agents alone that are linked by them, or listen at them."""

Listens = tuple[str, ...]
"""Where one agent can be dialled, the best address first."""


class Says(Protocol):
    """Sends gossip over a link."""

    def __call__(self, session: Session, message: Gossip) -> None:
        """Tells a peer of others."""


class Gossiper:
    """What one agent tells its peers of others. In the transport's thread.

    Args:
        role: the role of this agent.
        links: its links.
        say: sends what it tells.
        transport: knows the ways to addresses.
    """

    def __init__(self, role: Role, links: Links, say: Says, transport: Transport) -> None:
        # A client that looks at two agents must not make neighbours of them: it belongs to neither.
        self._tells = role != "client"
        self._links = links
        self._say = say
        self._transport = transport

    def beacon(self, peers: Peers) -> None:
        """Tells all peers of some agents."""
        agents = peers.beacon()
        self._links.announced(sum([self._tell(session, agents) for session in self._links]))

    def stood_up(self, session: Session, peers: Peers) -> None:
        """Tells a new peer of all agents, and the others of it, unless it is known."""
        agents = peers.gossip()
        for first in range(0, len(agents), ADDRESSES):
            self._tell(session, agents[first : first + ADDRESSES])
        hello = session.hello
        # Of an address that peers have named they know, and the newcomer hears of all others and dials them.
        if hello is not None and hello.listen and hello.role != "client" and peers.is_news(session.number):
            for other in self._links:
                self._tell(other, [hello.listen])

    def _tell(self, session: Session, agents: Iterable[Listens]) -> bool:
        """Tells a peer of agents other than itself, as far as it can dial them; returns whether there were any."""
        if not self._tells or session.hello is None:
            return False
        own = set(session.hello.listen)
        schemes = {*_EVERYWHERE, *map(_scheme, (session.remote, *own))}
        others = [self._best(session.remote, schemes, listen) for listen in agents if own.isdisjoint(listen)]
        named = tuple(filter(None, others))
        if named:
            self._say(session, Gossip(named))
        return bool(named)

    def _best(self, remote: str, schemes: set[str], listen: Listens) -> str:
        """Returns the cheapest address of an agent that a peer can dial, the first of equal ones; empty: none."""
        there = reachable_from(remote, listen, self._transport.reach)
        dialled = [address for address in there if _scheme(address) in schemes]
        return min(dialled, key=lambda address: self._transport.facts(address).cost, default="")


def _scheme(address: str) -> str:
    return address.partition("://")[0]
