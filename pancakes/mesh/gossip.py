"""Gossip: agents tell each other where others can be dialled, so that a fleet becomes a full mesh."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Final, Protocol

from pancakes.mesh.address import LOCAL, reachable_from
from pancakes.mesh.links import Links
from pancakes.mesh.messages import AgentSeen, Gossip, Hello, Role
from pancakes.mesh.partial_mesh import FewLinks, Sighting
from pancakes.mesh.peers import Peers
from pancakes.mesh.session import Session
from pancakes.mesh.transport import Transport

ADDRESSES: Final = 64
"""Most addresses in one message to a new link."""
BEACON_ADDRESSES: Final = 8
"""How many addresses are in a beacon; in a larger fleet each beacon names the next ones. If each beacon had all of
them, each agent would pay for the square of the fleet to tell what all agents know: a new link gets them all.
"""
TO_ONE: Final = 32
"""How many agents are in a beacon to one peer: of a thousand, each agent hears of each within half a minute."""

MOST_CHOSEN: Final = 1024
"""How many choices of an address are cached."""

_EVERYWHERE: Final = (LOCAL, "tcp")
"""Every agent can dial these; other schemes only agents that have a link or listen with them."""


class Says(Protocol):
    """Send gossip over a link."""

    def __call__(self, session: Session, message: Gossip) -> None:
        """Tell a peer of others."""


class Gossiper:
    """What one agent tells its peers of others. In the transport's thread.

    Args:
        role: the role of this agent.
        links: its links.
        say: sends gossip.
        transport: knows the facts of addresses.
        few: knows all agents, if this one keeps only a few links; None: only linked agents are named.
    """

    def __init__(self, role: Role, links: Links, say: Says, transport: Transport, few: FewLinks | None) -> None:
        # A client with links to two agents must not make them neighbours.
        self._tells = role != "client"
        self._links = links
        self._say = say
        self._transport = transport
        self._few = few
        self._beacons = 0
        # Beacons name the same agents to the same peers again and again.
        self._address_for = lru_cache(MOST_CHOSEN)(self._choose)

    def beacon(self, own: Hello, peers: Peers, now_s: float) -> None:
        """Tell all peers of this agent and some others; or one peer, by turns, of many."""
        hearers = list(self._links)
        if self._few is not None:
            others = self._few.some(TO_ONE, now_s)
            hearers = hearers[self._beacons % len(hearers) :][:1] if hearers else []
        else:
            others = peers.gossip()
            if len(others) > BEACON_ADDRESSES:
                first = self._beacons * BEACON_ADDRESSES % len(others)
                others = (others + others)[first : first + BEACON_ADDRESSES]
        self._beacons += 1
        agents = [*([(own.name, own.listen, 0.0)] if own.listen else ()), *others]
        self._links.announced(sum([self._tell(session, agents) for session in hearers]))

    def on_link_up(self, session: Session, peers: Peers, now_s: float) -> None:
        """Tell a new peer of all agents, and all others of the peer, unless they know it."""
        hello, is_news = session.hello, peers.is_news(session.number)
        if self._few is None:
            agents = peers.gossip()
        else:  # a link that comes and goes does not need everything again
            agents = self._few.fresh(now_s) if is_news else self._few.some(TO_ONE, now_s)
        for first in range(0, len(agents), ADDRESSES):
            self._tell(session, agents[first : first + ADDRESSES])
        # If peers have named its address, they know the newcomer already; it hears of all others and dials them.
        if hello is not None and hello.listen and hello.role != "client" and is_news:
            for other in self._links:
                self._tell(other, [(hello.name, hello.listen, 0.0)])

    def _tell(self, session: Session, agents: Iterable[Sighting]) -> bool:
        """Tell a peer of other agents that it can dial; return whether there were any."""
        if not self._tells or session.hello is None:
            return False
        remote, own = session.remote, session.hello.listen
        named = [
            AgentSeen(name, address, age_s)
            for name, listen, age_s in agents
            if (address := self._address_for(remote, own, listen))
        ]
        if named:
            self._say(session, Gossip(tuple(named)))
        return bool(named)

    def _choose(self, remote: str, own: tuple[str, ...], listen: tuple[str, ...]) -> str:
        """Return the cheapest address of an agent that a peer can dial, the first of equal ones.

        Args:
            remote: the address of the peer.
            own: where the peer listens.
            listen: where the agent listens.

        Returns:
            Empty if there is none, or if the agent is the peer.
        """
        if not set(own).isdisjoint(listen):
            return ""
        schemes = {*_EVERYWHERE, *map(_scheme, (remote, *own))}
        there = reachable_from(remote, listen, self._transport.reach)
        dialled = [address for address in there if _scheme(address) in schemes]
        return min(dialled, key=lambda address: self._transport.facts(address).cost, default="")


def _scheme(address: str) -> str:
    return address.partition("://")[0]
