"""Links that an agent has ended as too many, until the peers have heard that: what they sent before is not lost."""

from __future__ import annotations

from functools import partial
from typing import Final

from pancakes.mesh.net.receiving import Receiving
from pancakes.mesh.net.session import Session
from pancakes.mesh.net.transport import Transport
from pancakes.mesh.wire.link import PacketsReceived

DRAINED_S: Final = 5.0
"""The connection is closed after so long, if the peer does not do it."""


class Resting:
    """Hears those links to their end. In the transport's thread.

    Args:
        transport: in whose thread it works.
        receiving: takes what comes over them.
    """

    def __init__(self, transport: Transport, receiving: Receiving) -> None:
        self._transport = transport
        self._receiving = receiving
        self._sessions: dict[int, Session] = {}

    def __contains__(self, session: Session) -> bool:
        """Whether a link has been ended, and is heard still."""
        return session.number in self._sessions

    def begin(self, session: Session) -> None:
        """A link was ended: the peer was told goodbye, and will close the connection when it hears that."""
        self._sessions[session.number] = session
        self._transport.call_later(DRAINED_S, partial(self.end, session, "it rests"))

    def received(self, session: Session, data: bytes, now_s: float) -> None:
        """Bytes came in."""
        for action in session.link.receive(data, now_s) if session.link is not None else ():
            if isinstance(action, PacketsReceived):
                self._receiving.packets(session, action)

    def end(self, session: Session, reason: str) -> None:
        """Closes the connection, where the link is heard still."""
        if self._sessions.pop(session.number, None) is not None:
            session.end(reason)

    def close(self) -> None:
        """Closes all connections."""
        for session in list(self._sessions.values()):
            self.end(session, "this agent left the mesh")
