"""What every connection has in common that a transport keeps open, whatever carries its bytes.

A caller that sends does so itself where nothing waits, which saves two changes of thread. One lock for each connection
keeps the order between that and the loop's thread.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import deque
from typing import Final, Protocol

from pancakes.mesh.net.loop import Loop
from pancakes.mesh.net.transport import Connection, ConnectionHandler, Scheduled

LINGER_S: Final = 1.0
"""For what a closed connection still has to send, and for the other side to take it."""


class Disposable(ABC):
    """Something open that a transport owns."""

    @abstractmethod
    def dispose(self, reason: str) -> None:
        """Ends it at once. In the loop's thread."""


class ConnectionOwner(Protocol):
    """What a transport has in common with all that it has open.

    Attributes:
        loop: the transport's thread.
        open: all that the transport has to close at its end, in the order it was opened.
    """

    loop: Loop
    open: dict[Disposable, None]


class KeptConnection(Connection, Disposable):
    """One connection. `_lock` guards what waits, so that senders and the loop's thread keep the order.

    Args:
        owner: the transport.
        remote: the address of the other end.
        handler: takes the bytes that come.
    """

    def __init__(self, owner: ConnectionOwner, remote: str, handler: ConnectionHandler) -> None:
        self.remote = remote
        self._owner = owner
        self._handler = handler
        self._lock = threading.Lock()
        self._waiting: deque[memoryview] = deque()
        self._unsent = 0
        self._closing = False
        self._told = False
        self._timer: Scheduled | None = None

    def begin(self) -> None:
        """Bytes can go either way: the handler is told so. In the loop's thread."""
        self._start()
        self._handler.opened(self)

    def _start(self) -> None:
        """From now on what comes in is taken."""
        self._owner.open[self] = None
        self._listen()

    def send(self, data: bytes) -> int:
        with self._lock:
            if self._closing or not data:
                return self._unsent
            return self._put(data)

    def unsent(self) -> int:
        return self._unsent

    def close(self, reason: str = "") -> None:
        with self._lock:
            if self._closing:
                return
            self._closing = True
        self._owner.loop.call_later(0.0, lambda: self._begin_close(reason or "this side closed the connection"))

    def dispose(self, reason: str) -> None:
        with self._lock:
            if self not in self._owner.open:
                return
            del self._owner.open[self]
            self._closing = True
            if self._timer is not None:
                self._timer.cancel()
            self._release()
            self._waiting.clear()
            self._unsent = 0
        self._tell(reason)

    def _tell(self, reason: str) -> None:
        if not self._told:
            self._told = True
            self._handler.closed(reason)

    def _break_off(self, reason: str) -> None:
        """Ends it from any thread, the lock being held."""
        self._owner.loop.call_later(0.0, lambda: self.dispose(f"the connection to {self.remote} broke: {reason}"))

    def _begin_close(self, reason: str) -> None:
        """Sends what waits, then says that no more comes, and waits until the other side has taken it.

        What is given up with unread bytes in it breaks the connection, and the other side may then never see the last
        words.
        """
        if self in self._owner.open:
            self._timer = self._owner.loop.call_later(LINGER_S, lambda: self._give_up(reason))
            self._half_close()
        self._tell(reason)

    def _give_up(self, reason: str) -> None:
        """What a closed connection had to send has had its time."""
        self.dispose(reason)

    def _half_close(self) -> None:
        """Says that no more comes, once nothing waits."""
        with self._lock:
            if not self._waiting:
                self._shut()

    def _end(self) -> str:
        """Returns how a connection has ended that the other side has closed."""
        return "the other side closed the connection"

    def _take(self, data: memoryview) -> None:
        """Bytes have come in; they are to be copied before the next ones."""
        if not self._closing:
            self._handler.received(bytes(data))

    # What carries the bytes

    @abstractmethod
    def _listen(self) -> None:
        """Begins to take what comes in: calls `_take`, and `dispose` with `_end()` once no more comes."""

    @abstractmethod
    def _put(self, data: bytes) -> int:
        """Sends bytes, or puts them behind those that wait; returns how many wait. Under the lock."""

    @abstractmethod
    def _shut(self) -> None:
        """Tells the other side that no more comes. Under the lock."""

    @abstractmethod
    def _release(self) -> None:
        """Gives up what carries the bytes. Under the lock."""
