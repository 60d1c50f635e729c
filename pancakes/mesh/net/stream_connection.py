"""A connection that the kernel keeps as a stream of bytes, over TCP or within one machine.

A caller that sends does so itself where nothing waits, which saves two changes of thread; what the kernel does
not take is sent by the loop's thread. One lock for each connection keeps the order between the two.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from abc import ABC, abstractmethod
from collections import deque
from typing import Final, Protocol

from pancakes.mesh.net.loop import READ, WRITE, Loop
from pancakes.mesh.net.transport import Connection, ConnectionHandler, Scheduled

_LINGER_S: Final = 1.0  # for what a closed connection still has to send, and for the other side to take it


def why(error: OSError | int) -> str:
    """Returns what the operating system says of a failure, as a phrase."""
    number = error if isinstance(error, int) else error.errno
    text = os.strerror(number) if number is not None else str(error)
    return text[:1].lower() + text[1:]


class OpenSocket(ABC):
    """Something open that a transport owns."""

    @abstractmethod
    def dispose(self, reason: str) -> None:
        """Ends it at once. In the loop's thread."""


class SocketOwner(Protocol):
    """What a transport has in common with all that it has open.

    Attributes:
        loop: the transport's thread.
        open: all that the transport has to close at its end, in the order it was opened.
        read_buffer: where bytes are read to.
    """

    loop: Loop
    open: dict[OpenSocket, None]
    read_buffer: memoryview


class StreamConnection(Connection, OpenSocket):
    """One connection. `_lock` guards what waits, so that senders and the loop's thread keep the order."""

    def __init__(self, owner: SocketOwner, sock: socket.socket, remote: str, handler: ConnectionHandler) -> None:
        self.remote = remote
        self._owner = owner
        self._sock = sock
        self._handler = handler
        self._lock = threading.Lock()
        self._waiting: deque[memoryview] = deque()
        self._unsent = 0
        self._closing = False
        self._told = False
        self._timer: Scheduled | None = None

    def begin(self) -> None:
        """Its socket is connected: the handler is told so. In the loop's thread."""
        self._take_socket()
        self._handler.opened(self)

    def _take_socket(self) -> None:
        self._owner.open[self] = None
        self._owner.loop.watch(self._sock, READ, self._ready)

    def send(self, data: bytes) -> int:
        with self._lock:
            if self._closing or not data:
                return self._unsent
            return self._put(data)

    def _put(self, data: bytes) -> int:
        """Gives bytes to the kernel, or puts them behind those that wait for it. Under the lock."""
        if self._waiting:
            self._waiting.append(memoryview(data))
            self._unsent += len(data)
            return self._unsent
        try:
            sent = self._sock.send(data)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            self._break_off(why(error))
            return 0
        if sent < len(data):
            self._waiting.append(memoryview(data)[sent:])
            self._unsent = len(data) - sent
            self._owner.loop.call_later(0.0, self._watch)
        return self._unsent

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
            self._owner.loop.forget(self._sock)
            self._sock.close()
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

        A socket that is closed with unread bytes in it resets the connection, and the other side may then never
        see the last words.
        """
        if self in self._owner.open:
            self._timer = self._owner.loop.call_later(_LINGER_S, lambda: self.dispose(reason))
            self._half_close()
        self._tell(reason)

    def _half_close(self) -> None:
        with self._lock:
            if not self._waiting:
                with contextlib.suppress(OSError):
                    self._sock.shutdown(socket.SHUT_WR)

    def _watch(self) -> None:
        if self in self._owner.open:
            self._owner.loop.watch(self._sock, READ | WRITE if self._waiting else READ, self._ready)

    def _ready(self, events: int) -> None:
        if events != READ:
            if events & WRITE:
                self._write()
            if not events & ~WRITE or self not in self._owner.open:
                return
        buffer = self._owner.read_buffer
        try:
            count = self._sock.recv_into(buffer)
        except BlockingIOError:
            return
        except OSError as error:
            self.dispose(f"the connection to {self.remote} broke: {why(error)}")
            return
        if count == 0:
            self.dispose(self._end())
        else:
            self._take(buffer[:count])

    def _end(self) -> str:
        """Returns how a connection has ended that the other side has closed."""
        return "the other side closed the connection"

    def _take(self, data: memoryview) -> None:
        """Bytes have come in; they are to be copied before the next ones."""
        if not self._closing:
            self._handler.received(bytes(data))

    def _write(self) -> None:
        try:
            with self._lock:
                while self._waiting:
                    part = self._waiting[0]
                    sent = self._sock.send(part)
                    self._unsent -= sent
                    if sent < len(part):
                        self._waiting[0] = part[sent:]
                        return
                    self._waiting.popleft()
        except BlockingIOError:
            return
        except OSError as error:
            self.dispose(f"the connection to {self.remote} broke: {why(error)}")
            return
        self._watch()
        if self._closing:
            self._half_close()
        else:
            self._handler.drained()
