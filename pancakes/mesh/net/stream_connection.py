"""A connection that the kernel keeps as a stream of bytes, over TCP or within one machine.

What the kernel does not take when a caller sends it, the loop's thread sends.
"""

from __future__ import annotations

import contextlib
import os
import socket
from typing import Protocol

from pancakes.mesh.net.kept_connection import ConnectionOwner, KeptConnection
from pancakes.mesh.net.loop import READ, WRITE
from pancakes.mesh.net.transport import ConnectionHandler


def why(error: OSError | int) -> str:
    """Returns what the operating system says of a failure, as a phrase."""
    number = error if isinstance(error, int) else error.errno
    text = os.strerror(number) if number is not None else str(error)
    return text[:1].lower() + text[1:]


class SocketOwner(ConnectionOwner, Protocol):
    """A transport over sockets.

    Attributes:
        read_buffer: where bytes are read to.
    """

    read_buffer: memoryview


class StreamConnection(KeptConnection):
    """One connection over a socket.

    Args:
        owner: the transport.
        sock: the socket, which is connected.
        remote: the address of the other end.
        handler: takes the bytes that come.
    """

    _owner: SocketOwner

    def __init__(self, owner: SocketOwner, sock: socket.socket, remote: str, handler: ConnectionHandler) -> None:
        super().__init__(owner, remote, handler)
        self._sock = sock

    def _listen(self) -> None:
        self._owner.loop.watch(self._sock, READ, self._ready)

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
            reason = why(error)
            self._owner.loop.call_later(0.0, lambda: self._hear_out(reason))
            return 0
        if sent < len(data):
            self._waiting.append(memoryview(data)[sent:])
            self._unsent = len(data) - sent
            self._owner.loop.call_later(0.0, self._watch)
        return self._unsent

    def _shut(self) -> None:
        with contextlib.suppress(OSError):
            self._sock.shutdown(socket.SHUT_WR)

    def _release(self) -> None:
        self._owner.loop.forget(self._sock)
        self._sock.close()

    def _watch(self) -> None:
        if self in self._owner.open:
            self._owner.loop.watch(self._sock, READ | WRITE if self._waiting else READ, self._ready)

    def _ready(self, events: int) -> None:
        if events != READ:
            if events & WRITE:
                self._write()
            if not events & ~WRITE or self not in self._owner.open:
                return
        self._read()

    def _read(self) -> bool:
        """Takes what has come in; returns whether there may be more."""
        buffer = self._owner.read_buffer
        try:
            count = self._sock.recv_into(buffer)
        except BlockingIOError:
            return False
        except OSError as error:
            self.dispose(f"the connection to {self.remote} broke: {why(error)}")
            return False
        if count == 0:
            self.dispose(self._end())
            return False
        self._take(buffer[:count])
        return True

    def _hear_out(self, reason: str) -> None:
        """The other side takes no more bytes: what it has said before it ended still counts, an answer for one."""
        while self in self._owner.open and self._read():
            pass
        self.dispose(f"the connection to {self.remote} broke: {reason}")

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
            self._hear_out(why(error))
            return
        self._watch()
        if self._closing:
            self._half_close()
        else:
            self._handler.drained()
