"""Bytes over TCP: all sockets of an agent in one thread.

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
from collections.abc import Callable
from typing import Annotated, Any, Final

import msgspec

from pancakes.errors import PancakesError
from pancakes.mesh.address import parse_address
from pancakes.mesh.net.buffers import bound_buffers
from pancakes.mesh.net.loop import READ, WRITE, Loop
from pancakes.mesh.net.transport import Connection, ConnectionHandler, Scheduled, Transport
from pancakes.runtime.clock import Clock
from pancakes.runtime.kernel.guest import Guest

_READ_BYTES: Final = 64 * 1024
"""So much is read at a time: its packets are handled before they have left the processor's cache."""
_LINGER_S: Final = 1.0  # for what a closed connection still has to send, and for the other side to take it
_USER_TIMEOUT_MS: Final = 5000  # the kernel gives up a connection whose bytes are not acknowledged for so long
_ACCEPT_PAUSE_S: Final = 0.5  # when the process is out of file descriptors

_Place = tuple[socket.AddressFamily, Any]


def _host_and_port(address: str) -> tuple[str, int]:
    """Takes an address apart.

    Raises:
        ValueError: it is none over TCP.
    """
    parts = parse_address(address)
    if parts.scheme != "tcp" or parts.path:
        raise ValueError(f"{address!r} is no address of TCP: write it as tcp://host:port")
    return parts.host, parts.port


def _address(place: Any) -> str:
    host, port = place[0], place[1]
    return f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"


def _why(error: OSError | int) -> str:
    number = error if isinstance(error, int) else error.errno
    text = os.strerror(number) if number is not None else str(error)
    return text[:1].lower() + text[1:]


class TcpTransport(Transport):
    """Connections over TCP, and the one thread that serves them.

    Args:
        clock: the host clock.
        name: the agent's name, which its thread bears.
        settings: see `Settings`.
    """

    class Settings(msgspec.Struct):
        """How it connects.

        Attributes:
            dial_s: so long a dial may take, in seconds of host time.
        """

        dial_s: Annotated[float, msgspec.Meta(gt=0, le=60)] = 5.0

    def __init__(self, clock: Clock, name: str, settings: Settings) -> None:
        self.dial_s = settings.dial_s
        self.loop = Loop(clock, f"net-{name}" if name else "net")
        self.open: dict[_Socket, None] = {}  # all that `close` has to close, in the order it was opened
        self.read_buffer = memoryview(bytearray(_READ_BYTES))

    def listen(self, address: str, accept: Callable[[], ConnectionHandler]) -> str:
        sock: socket.socket | None = None
        try:
            family, place = _resolve(*_host_and_port(address))[0]
            sock = socket.socket(family, socket.SOCK_STREAM)
            if os.name == "posix":
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind(place)
            sock.listen(128)
        except ValueError as error:
            raise PancakesError(f"cannot listen at {address}: {error}") from None
        except OSError as error:
            if sock is not None:
                sock.close()
            why = error.strerror if isinstance(error, socket.gaierror) else _why(error)
            raise PancakesError(f"cannot listen at {address}: {why}") from None
        sock.setblocking(False)
        listener = _Listener(self, sock, accept)
        self.loop.call_later(0.0, listener.begin)
        return _address(sock.getsockname())

    def dial(self, address: str, handler: ConnectionHandler) -> None:
        self.loop.call_later(0.0, lambda: _Connecting(self, address, handler).begin())

    def looks_up(self, address: str) -> bool:
        try:
            _resolve(*_host_and_port(address), socket.AI_NUMERICHOST)
        except (OSError, ValueError):
            return True
        return False

    def call_later(self, delay_s: float, function: Callable[[], None]) -> Scheduled:
        return self.loop.call_later(delay_s, function)

    def lend_thread(self, make_guest: Callable[[Callable[[], None]], Guest], busy_poll_s: float = 0.0) -> None:
        self.loop.lend(make_guest, busy_poll_s)

    def close(self) -> None:
        self.loop.stop(self._close_all)

    def _close_all(self) -> None:
        for it in list(self.open):
            it.dispose("the transport was closed")


class _Socket(ABC):
    """Something open that a transport owns."""

    @abstractmethod
    def dispose(self, reason: str) -> None:
        """Ends it at once. In the loop's thread."""


class _Listener(_Socket):
    """Takes connections at an address."""

    def __init__(self, transport: TcpTransport, sock: socket.socket, accept: Callable[[], ConnectionHandler]) -> None:
        self._transport = transport
        self._sock = sock
        self._make_handler = accept

    def begin(self) -> None:
        self._transport.open[self] = None
        self._resume()

    def dispose(self, reason: str) -> None:
        self._transport.open.pop(self, None)
        self._transport.loop.forget(self._sock)
        self._sock.close()

    def _resume(self) -> None:
        if self in self._transport.open:
            self._transport.loop.watch(self._sock, READ, self._ready)

    def _ready(self, _events: int) -> None:
        try:
            sock, place = self._sock.accept()
        except (BlockingIOError, ConnectionAbortedError):
            return  # it was there, and has gone again
        except OSError:  # no file descriptor is left: it would be ready again at once, for ever
            self._transport.loop.forget(self._sock)
            self._transport.loop.call_later(_ACCEPT_PAUSE_S, self._resume)
            return
        _TcpConnection(self._transport, sock, _address(place), self._make_handler()).begin()


class _Connecting(_Socket):
    """Opens a connection: finds out where a name leads, then tries one place after the other."""

    def __init__(self, transport: TcpTransport, address: str, handler: ConnectionHandler) -> None:
        self._transport = transport
        self._address = address
        self._handler = handler
        self._sock: socket.socket | None = None
        self._places: list[_Place] = []
        late = f"{address} did not answer within {transport.dial_s:g} s"
        self._timer = transport.loop.call_later(transport.dial_s, lambda: self.dispose(late))

    def begin(self) -> None:
        self._transport.open[self] = None
        try:
            host, port = _host_and_port(self._address)
        except ValueError as error:
            self.dispose(str(error))
            return
        try:
            self._try(_resolve(host, port, socket.AI_NUMERICHOST))
        except socket.gaierror:  # a name: asking for it may take seconds, so not in this thread
            threading.Thread(target=self._ask, args=(host, port), name="resolve", daemon=True).start()

    def dispose(self, reason: str) -> None:
        if self in self._transport.open:
            self._drop_socket()
            self._finish()
            self._handler.closed(reason)

    def _ask(self, host: str, port: int) -> None:
        loop = self._transport.loop
        try:
            places = _resolve(host, port, 0)
        except OSError as error:
            reason = f"{self._address} cannot be found: {error.strerror or error}"
            loop.call_later(0.0, lambda: self.dispose(reason))
        else:
            loop.call_later(0.0, lambda: self._try(places))

    def _finish(self) -> None:
        del self._transport.open[self]
        self._timer.cancel()

    def _drop_socket(self) -> None:
        if self._sock is not None:
            self._transport.loop.forget(self._sock)
            self._sock.close()
            self._sock = None

    def _try(self, places: list[_Place]) -> None:
        if self not in self._transport.open:
            return  # too late
        self._places = places
        family, place = self._places.pop(0)
        try:
            self._sock = socket.socket(family, socket.SOCK_STREAM)
            self._sock.setblocking(False)
            self._sock.connect(place)
        except BlockingIOError:
            assert self._sock is not None
            self._transport.loop.watch(self._sock, WRITE, self._ready)
        except OSError as error:
            self._next(_why(error))
        else:
            self._ready(WRITE)

    def _ready(self, _events: int) -> None:
        sock = self._sock
        assert sock is not None
        error = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if error:
            self._next(_why(error))
            return
        try:
            # The kernel may give a dial to a free local port that very port, and join the socket to itself.
            is_its_own_peer = sock.getsockname() == sock.getpeername()
        except OSError as gone:  # it was there, and has gone again
            self._next(_why(gone))
            return
        if is_its_own_peer:
            self._next("connection refused")
            return
        self._sock = None
        self._transport.loop.forget(sock)
        self._finish()
        _TcpConnection(self._transport, sock, self._address, self._handler).begin()

    def _next(self, why: str) -> None:
        self._drop_socket()
        if self._places:
            self._try(self._places)
        else:
            self.dispose(f"{self._address} cannot be reached: {why}")


def _resolve(host: str, port: int, flags: int = 0) -> list[_Place]:
    # Of a string Python would make the bytes by way of a codec for foreign alphabets, which takes 0.5 MiB.
    found = socket.getaddrinfo(host.encode(), port, type=socket.SOCK_STREAM, flags=flags)
    return [(family, place) for family, _, _, _, place in found]


class _TcpConnection(Connection, _Socket):
    """One connection. `_lock` guards what waits, so that senders and the loop's thread keep the order."""

    def __init__(self, transport: TcpTransport, sock: socket.socket, remote: str, handler: ConnectionHandler) -> None:
        self.remote = remote
        self._transport = transport
        self._sock = sock
        self._handler = handler
        self._lock = threading.Lock()
        self._waiting: deque[memoryview] = deque()
        self._unsent = 0
        self._closing = False
        self._told = False
        self._timer: Scheduled | None = None

    def begin(self) -> None:
        self._sock.setblocking(False)
        self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):
            self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _USER_TIMEOUT_MS)
        bound_buffers(self._sock)
        self._transport.open[self] = None
        self._transport.loop.watch(self._sock, READ, self._ready)
        self._handler.opened(self)

    def send(self, data: bytes) -> int:
        with self._lock:
            if self._closing or not data:
                return self._unsent
            if self._waiting:
                self._waiting.append(memoryview(data))
                self._unsent += len(data)
                return self._unsent
            try:
                sent = self._sock.send(data)
            except BlockingIOError:
                sent = 0
            except OSError as error:
                self._break_off(_why(error))
                return 0
            if sent == len(data):
                return 0
            self._waiting.append(memoryview(data)[sent:])
            self._unsent = unsent = len(data) - sent
        self._transport.loop.call_later(0.0, self._watch)
        return unsent

    def unsent(self) -> int:
        return self._unsent

    def close(self, reason: str = "") -> None:
        with self._lock:
            if self._closing:
                return
            self._closing = True
        self._transport.loop.call_later(0.0, lambda: self._begin_close(reason or "this side closed the connection"))

    def dispose(self, reason: str) -> None:
        with self._lock:
            if self not in self._transport.open:
                return
            del self._transport.open[self]
            self._closing = True
            if self._timer is not None:
                self._timer.cancel()
            self._transport.loop.forget(self._sock)
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
        self._transport.loop.call_later(0.0, lambda: self.dispose(f"the connection to {self.remote} broke: {reason}"))

    def _begin_close(self, reason: str) -> None:
        """Sends what waits, then says that no more comes, and waits until the other side has taken it.

        A socket that is closed with unread bytes in it resets the connection, and the other side may then never
        see the last words.
        """
        if self in self._transport.open:
            self._timer = self._transport.loop.call_later(_LINGER_S, lambda: self.dispose(reason))
            self._half_close()
        self._tell(reason)

    def _half_close(self) -> None:
        with self._lock:
            if not self._waiting:
                with contextlib.suppress(OSError):
                    self._sock.shutdown(socket.SHUT_WR)

    def _watch(self) -> None:
        if self in self._transport.open:
            self._transport.loop.watch(self._sock, READ | WRITE if self._waiting else READ, self._ready)

    def _ready(self, events: int) -> None:
        if events != READ:
            if events & WRITE:
                self._write()
            if not events & ~WRITE or self not in self._transport.open:
                return
        buffer = self._transport.read_buffer
        try:
            count = self._sock.recv_into(buffer)
        except BlockingIOError:
            return
        except OSError as error:
            self.dispose(f"the connection to {self.remote} broke: {_why(error)}")
            return
        if count == 0:
            self.dispose("the other side closed the connection")
        elif not self._closing:
            self._handler.received(bytes(buffer[:count]))

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
            self.dispose(f"the connection to {self.remote} broke: {_why(error)}")
            return
        self._watch()
        if self._closing:
            self._half_close()
        else:
            self._handler.drained()
