"""What an agent believes of its peers, and lets them send."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from pancakes.mesh.net.bucket import Bucket
from pancakes.mesh.net.links import Links
from pancakes.mesh.net.rekeying import Rekeying
from pancakes.mesh.net.rosters import Rosters
from pancakes.mesh.net.session import Session
from pancakes.mesh.net.speaker import fault_of_source
from pancakes.mesh.net.transport import Scheduled
from pancakes.mesh.security.access import Access, asks
from pancakes.mesh.security.certified import fault_of_bearer
from pancakes.mesh.security.rules import Bearer
from pancakes.mesh.wire.link_messages import Hello, Refusal, RosterNumber, RosterText
from pancakes.packet import Packet

if TYPE_CHECKING:
    from pancakes.mesh.security.keys import Keys

MOST_ASKED_HZ: Final = 1000.0
"""So often a peer may ask this agent for something, in a second; as much at once. The rest is refused."""


class Trust:
    """The keys, the roster and the rules of one agent, as its links need them. In the transport's thread.

    Args:
        role: the role of this agent.
        keys: its keys; None: it has none.
        access: what it lets its peers do; None: it is a terminal, which takes packets of any source on any channel.
        links: its links.
        tell: sends a message over a link.
        refuse: ends a link, and tells the peer why.
        call_later: as `Transport.call_later`.
        now: the host clock.
        log: takes (level, text).
    """

    def __init__(
        self,
        role: str,
        keys: Keys | None,
        access: Access | None,
        links: Links,
        tell: Callable[[Session, RosterNumber | RosterText], None],
        refuse: Callable[[Session, Refusal, str], None],
        call_later: Callable[[float, Callable[[], None]], Scheduled],
        now: Callable[[], float],
        log: Callable[[str, str], None],
    ) -> None:
        self._role = role
        self._access = access
        self._links = links
        self._now = now
        self.rosters = Rosters(keys, links, tell, refuse, call_later, log)
        self.rekeying = Rekeying(keys, links, refuse, call_later, log)
        if access is not None:
            access.bearer_of = self._bearer_of

    def begin(self) -> None:
        """The mesh has begun."""
        self.rosters.begin()
        self.rekeying.begin()

    def fault_of_hello(self, session: Session, hello: Hello) -> str:
        """Returns in what a hello is not as the certificate of its sender says, as a sentence; empty: in nothing."""
        shown = session.certified
        return fault_of_bearer(shown, hello.name, hello.role, hello.fleet) if shown is not None else ""

    def fault_of_packet(self, session: Session, packet: Packet) -> str:
        """Returns why the peer may not send packets with this head, as a sentence; empty: it may."""
        access = self._access
        if access is None:
            return ""
        return fault_of_source(self._role, session.peer, session.role, packet) or access.fault_of_packet(
            *_bearer(session), session.peer, packet
        )

    def asks_too_much(self, session: Session, first: Packet, number: int) -> str:
        """Returns why what the peer asks for is refused, as a sentence; empty: it asks for nothing, or not too often.

        Args:
            session: the link that the packets came over.
            first: the first of them; the others have the same head.
            number: how many they are.
        """
        if self._access is None or not asks(first) or self._asked_of(session).take(number, self._now()):
            return ""
        return f"{session.peer} asks for more than {MOST_ASKED_HZ:g} things in a second"

    def _asked_of(self, session: Session) -> Bucket:
        if session.asked is None:
            session.asked = Bucket(MOST_ASKED_HZ, MOST_ASKED_HZ, self._now())
        return session.asked

    def _bearer_of(self, peer: str) -> tuple[Bearer, bool] | None:
        """See `Access.bearer_of`. Any thread."""
        session = self._links.by_name().get(peer)
        return _bearer(session) if session is not None else None


def _bearer(session: Session) -> tuple[Bearer, bool]:
    shown = session.certified
    if shown is not None:
        return Bearer(shown.name, shown.role, shown.groups), True
    return Bearer(session.peer, "operator" if session.role == "client" else session.role), False
