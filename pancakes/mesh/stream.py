"""Connections over stream sockets: listen, dial, send and close, for TCP and for sockets within a machine.

`KeptConnection` is what all connections share, whatever carries their bytes. A caller that sends does so itself if
nothing waits, which saves two changes of thread; what the kernel does not take, the loop's thread sends later. One
lock for each connection keeps the order. `StreamConnection` adds the socket, and `StreamTransport` dials and accepts.
A name is looked up in a thread of its own, and its addresses are tried side by side.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple, Protocol

import msgspec

from pancakes.errors import PancakesError
from pancakes.mesh.event_loop import READ, WRITE, Loop, TimerHandle
from pancakes.mesh.sockets import Place, by_turns, pace_s
from pancakes.mesh.transport import Connection, ConnectionHandler, Scheduled, SchemeTransport
from pancakes.util.runtime_dir import LOOK_S

if TYPE_CHECKING:
    from pancakes.security.keys import Keys


LINGER_S: Final = 1.0
"""For what a closed connection still has to send, and for the other side to take it."""


class Disposable(ABC):
    """Something open that a transport owns."""

    @abstractmethod
    def dispose(self, reason: str) -> None:
        """End it at once. In the loop's thread."""


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
        """End it from any thread, the lock being held."""
        self._owner.loop.call_later(0.0, lambda: self.dispose(f"the connection to {self.remote} broke: {reason}"))

    def _begin_close(self, reason: str) -> None:
        """Send what waits, announce the end, and wait until the other side has read everything.

        What is given up with unread bytes in it breaks the connection, and the other side may then never see the last
        words.
        """
        if self in self._owner.open:
            self._timer = self._owner.loop.call_later(LINGER_S, lambda: self._give_up(reason))
            self._half_close()
        self._tell(reason)

    def _give_up(self, reason: str) -> None:
        """End a closed connection whose time to send is over."""
        self.dispose(reason)

    def _half_close(self) -> None:
        """Announce the end of the stream once nothing waits."""
        with self._lock:
            if not self._waiting:
                self._shut()

    def _end(self) -> str:
        """Return the reason for an end from the other side."""
        return "the other side closed the connection"

    def _take(self, data: memoryview) -> None:
        """Take bytes that came in; copy them before the next ones."""
        if not self._closing:
            self._handler.received(bytes(data))

    # What carries the bytes

    @abstractmethod
    def _listen(self) -> None:
        """Begin to read: call `_take` with bytes, and `dispose` with `_end()` at the end of the stream."""

    @abstractmethod
    def _put(self, data: bytes) -> int:
        """Send bytes, or queue them; return how many wait. Under the lock."""

    @abstractmethod
    def _shut(self) -> None:
        """Announce the end of the stream to the other side. Under the lock."""

    @abstractmethod
    def _release(self) -> None:
        """Release what carries the bytes. Under the lock."""


def why(error: OSError | int) -> str:
    """Return the operating system's text for an error, as a phrase."""
    number = error if isinstance(error, int) else error.errno
    text = os.strerror(number) if number is not None else str(error)
    return text[:1].lower() + text[1:]


class SocketOwner(ConnectionOwner, Protocol):
    """A transport over sockets.

    Attributes:
        read_buffer: the buffer for reading.
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
        """Pass bytes to the kernel, or queue them. Under the lock."""
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
        """Read what has come in; return whether there may be more."""
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
        """Read the rest, such as an answer, from a side that takes no more bytes."""
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


_READ_BYTES: Final = 64 * 1024
"""How much is read at a time: its packets are handled before they have left the processor's cache."""
_ACCEPT_PAUSE_S: Final = 0.5  # when the process is out of file descriptors

LOOK_UP_S: Final = 30.0
"""How long a name may be looked up: the resolver asks one server after the other, each for some seconds."""


class Bound(NamedTuple):
    """A listening socket.

    Attributes:
        sock: the socket.
        address: where others dial it.
        ended: called once it is closed.
        is_there: returns whether others can still find it; None: always.
    """

    sock: socket.socket
    address: str
    ended: Callable[[], None]
    is_there: Callable[[], bool] | None = None


class StreamTransport(SchemeTransport):
    """A transport over stream sockets.

    Args:
        loop: the transport's thread.
        settings: see `Settings`.
        keys: see `SchemeTransport`.
    """

    class Settings(msgspec.Struct):
        """The settings of connections.

        Attributes:
            dial_s: how long a dial may take, in seconds of host time, for all addresses of a name together; that begins
                once the name was looked up.
        """

        dial_s: Annotated[float, msgspec.Meta(gt=0, le=60)] = 5.0

    def __init__(self, loop: Loop, settings: Settings, keys: Keys | None = None) -> None:
        self.keys = keys
        self.dial_s = settings.dial_s
        self.loop = loop
        self.open: dict[Disposable, None] = {}
        self._listeners: dict[str, _Listener] = {}
        self.read_buffer = memoryview(bytearray(_READ_BYTES))

    def listen(self, address: str, accept: Callable[[], ConnectionHandler]) -> str:
        try:
            bound = self.bind(address)
        except ValueError as error:
            raise PancakesError(f"cannot listen at {address}: {error}") from None
        except PancakesError as error:
            raise PancakesError(f"cannot listen at {address}: {error}") from None
        except OSError as error:
            reason = error.strerror if isinstance(error, socket.gaierror) else why(error)
            raise PancakesError(f"cannot listen at {address}: {reason}") from None
        bound.sock.setblocking(False)
        listener = self._listeners[bound.address] = _Listener(self, address, bound, accept)
        self.loop.call_later(0.0, listener.begin)
        return bound.address

    def stop_listening(self, address: str) -> None:
        listener = self._listeners.pop(address, None)
        if listener is not None:
            listener.end()

    def dial(self, address: str, handler: ConnectionHandler) -> None:
        self.loop.call_later(0.0, lambda: _Connecting(self, address, handler).begin())

    def may_be_named(self, address: str) -> bool:
        try:
            self.places(address, look_up=False)
        except (OSError, ValueError):
            return False
        return True

    def close(self) -> None:
        for it in list(self.open):
            it.dispose("the transport was closed")

    # What addresses mean to it

    @abstractmethod
    def bind(self, address: str) -> Bound:
        """Make a socket that takes connections at an address.

        Raises:
            ValueError: it is not an address of this transport; the phrase says why.
            OSError: the operating system refuses.
        """

    @abstractmethod
    def places(self, address: str, look_up: bool) -> list[Place]:
        """Return the places of an address, the best first.

        Args:
            address: what to dial.
            look_up: whether a name may be looked up, which can take seconds.

        Raises:
            ValueError: it is not an address of this transport; the phrase says why.
            socket.gaierror: a name cannot be resolved, or would have to be looked up.
            OSError: the operating system refuses.
        """

    @abstractmethod
    def remote(self, sock: socket.socket, place: Any) -> str:
        """Return an address for the other end of a connection that came in from `place`."""

    @abstractmethod
    def prepare(self, sock: socket.socket, dialled: str) -> str:
        """Prepare an open connection; return why its other end is refused, or empty.

        Args:
            sock: its socket.
            dialled: the address that was dialled; empty if it came in.
        """

    def connection(
        self, sock: socket.socket, remote: str, handler: ConnectionHandler, dialled: bool
    ) -> StreamConnection:
        """Make the connection of an open socket."""
        return StreamConnection(self, sock, remote, handler)

    def connect(self, sock: socket.socket, place: Any) -> None:
        """Connect a socket that does not block.

        Raises:
            OSError: as `socket.connect`.
        """
        sock.connect(place)


class _Listener(Disposable):
    """Listen at an address, with a new socket if others can no longer find the last one."""

    def __init__(
        self, transport: StreamTransport, address: str, bound: Bound, accept: Callable[[], ConnectionHandler]
    ) -> None:
        self._transport = transport
        self._address = address
        self._bound = bound
        self._make_handler = accept
        self._ended = False

    def begin(self) -> None:
        self._transport.open[self] = None
        self._resume()
        if self._bound.is_there is not None:
            self._transport.loop.call_later(LOOK_S, self._look)

    def end(self) -> None:
        """Stop listening; the address is free at once. Any thread."""
        self._ended = True
        # Only the loop may close its socket; a socket that was shut down blocks nothing.
        with contextlib.suppress(OSError):
            self._bound.sock.shutdown(socket.SHUT_RDWR)
        self._transport.loop.call_later(0.0, lambda: self.dispose("nothing listens any more"))

    def dispose(self, reason: str) -> None:
        self._transport.open.pop(self, None)
        self._close()

    def _close(self) -> None:
        self._transport.loop.forget(self._bound.sock)
        self._bound.sock.close()
        self._bound.ended()

    def _look(self) -> None:
        if self not in self._transport.open or self._ended:
            return
        if self._bound.is_there is not None and not self._bound.is_there():
            with contextlib.suppress(OSError, PancakesError):  # its directory may come back later
                bound = self._transport.bind(self._address)
                bound.sock.setblocking(False)
                self._close()
                self._bound = bound
                self._resume()
        self._transport.loop.call_later(LOOK_S, self._look)

    def _resume(self) -> None:
        if self in self._transport.open:
            self._transport.loop.watch(self._bound.sock, READ, self._ready)

    def _ready(self, _events: int) -> None:
        if self._ended:
            self._transport.loop.forget(self._bound.sock)  # it would be ready for ever
            return
        try:
            sock, place = self._bound.sock.accept()
        except (BlockingIOError, ConnectionAbortedError):
            return  # the connection has already ended
        except OSError:  # out of file descriptors: it would be ready again at once, for ever
            self._transport.loop.forget(self._bound.sock)
            self._transport.loop.call_later(_ACCEPT_PAUSE_S, self._resume)
            return
        _begin(self._transport, sock, "", self._transport.remote(sock, place), self._make_handler())


class _Connecting(Disposable):
    """Open a connection: resolve the name, then try its places side by side."""

    def __init__(self, transport: StreamTransport, address: str, handler: ConnectionHandler) -> None:
        self._transport = transport
        self._address = address
        self._handler = handler
        self._tries: dict[socket.socket, None] = {}
        self._places: list[Place] = []
        self._pace_s = 0.0
        self._timers: list[TimerHandle] = []

    def begin(self) -> None:
        self._transport.open[self] = None
        try:
            self._start(self._transport.places(self._address, look_up=False))
        except ValueError as error:
            self.dispose(str(error))
        except socket.gaierror:  # a name: asking for it may take seconds, so not in this thread
            self._end_in(LOOK_UP_S, f"{self._address} was not found within {LOOK_UP_S:g} s")
            threading.Thread(target=self._ask, name="resolve", daemon=True).start()
        except OSError as error:
            self.dispose(f"{self._address} cannot be reached: {why(error)}")

    def dispose(self, reason: str) -> None:
        if self in self._transport.open:
            self._finish()
            self._handler.closed(reason)

    def _ask(self) -> None:
        loop = self._transport.loop
        try:
            places = self._transport.places(self._address, look_up=True)
        except OSError as error:
            reason = f"{self._address} cannot be found: {error.strerror or error}"
            loop.call_later(0.0, lambda: self.dispose(reason))
        else:
            loop.call_later(0.0, lambda: self._start(places))

    def _end_in(self, delay_s: float, late: str) -> None:
        for timer in self._timers:
            timer.cancel()
        self._timers = [self._transport.loop.call_later(delay_s, lambda: self.dispose(late))]

    def _start(self, places: list[Place]) -> None:
        if self not in self._transport.open:
            return  # too late
        dial_s = self._transport.dial_s
        # The time counts from now: a slow look-up must not use it up.
        self._end_in(dial_s, f"{self._address} did not answer within {dial_s:g} s")
        self._places, self._pace_s = by_turns(places), pace_s(len(places), dial_s)
        self._try()

    def _finish(self) -> None:
        del self._transport.open[self]
        for timer in self._timers:
            timer.cancel()
        for sock in list(self._tries):
            self._drop(sock)

    def _drop(self, sock: socket.socket) -> None:
        self._tries.pop(sock, None)
        self._transport.loop.forget(sock)
        sock.close()

    def _later(self, left: int) -> None:
        """Try the next place, unless a failure has already done so."""
        if self in self._transport.open and len(self._places) == left:
            self._try()

    def _try(self) -> None:
        """Try one more place, in addition to those without an answer yet."""
        family, place = self._places.pop(0)
        if left := len(self._places):
            self._timers.append(self._transport.loop.call_later(self._pace_s, lambda: self._later(left)))
        try:
            sock = socket.socket(family, socket.SOCK_STREAM)
        except OSError as error:  # this machine does not know the family
            self._failed(why(error))
            return
        self._tries[sock] = None
        try:
            sock.setblocking(False)
            self._transport.connect(sock, place)
        except BlockingIOError as error:
            if error.errno == errno.EAGAIN:  # within one machine a connection is open at once, or not at all
                self._drop(sock)
                self._failed("it has no room for one more that waits")
                return
            self._transport.loop.watch(sock, WRITE, lambda _events: self._ready(sock))
        except PancakesError as error:
            self._drop(sock)
            self._failed(str(error))
        except OSError as error:
            self._drop(sock)
            self._failed(why(error))
        else:
            self._ready(sock)

    def _ready(self, sock: socket.socket) -> None:
        error = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        failure = why(error) if error else ""
        try:
            # The kernel may give a dial to a free local port that very port, and join the socket to itself.
            if not error and sock.getsockname() == sock.getpeername():
                failure = "connection refused"
        except OSError as gone:  # the connection has already ended
            failure = why(gone)
        if failure:
            self._drop(sock)
            self._failed(failure)
            return
        del self._tries[sock]
        self._transport.loop.forget(sock)
        self._finish()
        _begin(self._transport, sock, self._address, self._address, self._handler)

    def _failed(self, failure: str) -> None:
        """Note a failed place: try the next one at once, or wait for those without an answer yet."""
        if self._places:
            self._try()
        elif not self._tries:
            self.dispose(f"{self._address} cannot be reached: {failure}")


def _begin(
    transport: StreamTransport, sock: socket.socket, dialled: str, remote: str, handler: ConnectionHandler
) -> None:
    """Begin the connection of a connected socket, unless the transport refuses it."""
    sock.setblocking(False)
    if not dialled:
        handler.comes_from(remote)
    refusal = transport.prepare(sock, dialled)
    if refusal:
        sock.close()
        handler.closed(refusal)
    else:
        transport.connection(sock, remote, handler, bool(dialled)).begin()
