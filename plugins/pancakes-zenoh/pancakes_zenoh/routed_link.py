"""One connection between two agents through Zenoh routers: a stream of bytes each way.

Zenoh brings messages, and may lose some where a router dies. Here each frame says how many bytes went before, so that
a loss ends the connection, and is never silent; and the receiver grants what may be sent (`credit_pool`).
"""

from __future__ import annotations

from typing import Protocol

from pancakes.mesh.stream import LINGER_S, ConnectionOwner, KeptConnection
from pancakes.mesh.tls import TlsLayer
from pancakes.mesh.transport import ConnectionHandler
from pancakes_zenoh.credit_pool import LEAST_BYTES, MOST_BYTES, CreditPool
from pancakes_zenoh.link_frames import LONGEST_PHRASE, PIECE_BYTES, FrameKind, LinkFrame, frame_bytes


class LinkOwner(ConnectionOwner, Protocol):
    """The transport of links.

    Attributes:
        credit: what peers may send.
        links: the links that stand, by their numbers.
    """

    credit: CreditPool
    links: dict[int, RoutedLink]

    def post(self, peer: str, frame: bytes) -> None:
        """Sends a frame to a session, behind all that were posted before. From any thread; never waits."""

    def link_ended(self, link: RoutedLink) -> None:
        """A link has ended. In the loop's thread."""


class RoutedLink(KeptConnection):
    """One connection.

    Args:
        owner: the transport.
        number: its number, which the side that dialled has drawn.
        peer: the id of the other end's session.
        remote: the address of the other end.
        dialled: what the other side is told of who dials, and what, see `link_frames`; empty where it came in.
        handler: takes the bytes that come.

    Attributes:
        number: see above.
        peer: see above.
    """

    _owner: LinkOwner

    def __init__(
        self, owner: LinkOwner, number: int, peer: str, remote: str, dialled: str, handler: ConnectionHandler
    ) -> None:
        super().__init__(owner, remote, handler)
        self.number, self.peer = number, peer
        self._dialled = dialled
        self._sent = 0
        self._granted = LEAST_BYTES  # bytes that may be sent, counted from the link's beginning
        self._received = 0
        self._last_word: FrameKind | None = None  # that was sent or came, after which nothing is sent
        self._broken = ""
        self._lingered = -1

    def take(self, frame: LinkFrame) -> None:
        """A frame came for this connection. In the loop's thread."""
        match frame.kind:
            case FrameKind.DATA:
                self._take_data(frame)
            case FrameKind.GRANT:
                self._take_grant(frame.offset)
            case FrameKind.FIN if frame.offset == self._received:
                self.dispose(self._end())
            case FrameKind.FIN:
                self.break_off(f"bytes were lost on the way: {self._received} of {frame.offset} came")
            case FrameKind.BREAK:
                self._last_word = FrameKind.BREAK
                why = str(frame.data, "utf-8", "replace")
                self.dispose(f"the other side broke the connection off: {why if why.isprintable() else ascii(why)}")
            case FrameKind.OPEN:
                self.break_off("it was opened twice")

    def break_off(self, why: str) -> None:
        """Ends it at once, and tells the other side why. In the loop's thread."""
        self._broken = why
        self.dispose(f"the connection to {self.remote} broke: {why}")

    def gone(self, why: str) -> None:
        """The other end's session is not there any more. In the loop's thread."""
        self._last_word = FrameKind.BREAK
        self.dispose(f"the connection to {self.remote} broke: {why}")

    def _take_data(self, frame: LinkFrame) -> None:
        size = len(frame.data)
        if frame.offset != self._received:
            self.break_off(f"bytes were lost on the way: those at {self._received} are missing")
            return
        try:
            limit = self._owner.credit.taken(self.number, size, frame.waiting)
        except ValueError as error:
            self.break_off(str(error))
            return
        self._received += size
        self._take(frame.data)
        if limit is not None and self in self._owner.open:
            self._say(FrameKind.GRANT, limit)

    def _take_grant(self, limit: int) -> None:
        with self._lock:
            if limit > self._sent + LEAST_BYTES + MOST_BYTES:
                too_much = True
            else:
                too_much = False
                self._granted = max(self._granted, limit)
            had = bool(self._waiting)
            self._send_granted()
            has_drained = had and not self._waiting
        if too_much:
            self.break_off(f"{limit} bytes were granted, and {self._sent} were sent")
        elif has_drained and self._closing:
            self._half_close()
        elif has_drained:
            self._handler.drained()

    def _listen(self) -> None:
        self._owner.links[self.number] = self
        self._owner.credit.opened(self.number)
        if self._dialled:
            self._owner.post(self.peer, frame_bytes(FrameKind.OPEN, self.number, 0, 0, self._dialled.encode()))

    def _put(self, data: bytes) -> int:
        self._waiting.append(memoryview(data))
        self._unsent += len(data)
        self._send_granted()
        return self._unsent

    def _send_granted(self) -> None:
        """Sends as much as was granted. Under the lock."""
        while self._waiting and self._last_word is None:
            room = min(self._granted - self._sent, PIECE_BYTES)
            if room <= 0:
                return
            parts: list[memoryview] = []
            size = 0
            while self._waiting and size < room:
                part = self._waiting.popleft()
                if len(part) > room - size:
                    self._waiting.appendleft(part[room - size :])
                    part = part[: room - size]
                parts.append(part)
                size += len(part)
            self._unsent -= size
            self._say(FrameKind.DATA, self._sent, self._unsent, *parts)
            self._sent += size

    def _say(self, kind: FrameKind, offset: int, waiting: int = 0, *parts: bytes | memoryview) -> None:
        self._owner.post(self.peer, frame_bytes(kind, self.number, offset, waiting, *parts))

    def _shut(self) -> None:
        if self._last_word is None:
            self._last_word = FrameKind.FIN
            self._say(FrameKind.FIN, self._sent)

    def _give_up(self, reason: str) -> None:
        left = self._unsent
        if left and left != self._lingered:  # a router is slower than a kernel: as long as something goes, it goes on
            self._lingered = left
            self._timer = self._owner.loop.call_later(LINGER_S, lambda: self._give_up(reason))
        else:
            self.dispose(reason)

    def _release(self) -> None:
        if self._last_word is None:
            if self._waiting and not self._broken:
                self._broken = "the other side has given it up"
            if self._broken:
                self._say(FrameKind.BREAK, 0, 0, self._broken.encode()[:LONGEST_PHRASE])
            else:
                self._say(FrameKind.FIN, self._sent)
            self._last_word = FrameKind.BREAK
        self._owner.links.pop(self.number, None)
        self._owner.credit.ended(self.number)
        self._owner.link_ended(self)


class SealedLink(TlsLayer, RoutedLink):
    """One encrypted connection: routers see ciphertext. `TlsLayer` says what it takes."""
