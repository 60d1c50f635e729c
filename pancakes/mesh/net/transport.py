"""How bytes travel between agents: one small interface, several ways.

All of a transport's callbacks run one at a time, in the transport's own thread (in virtual time: in the
one thread there is), and never from within a call to the transport or to a connection. `Connection.send`
and `Connection.close` may be called from any thread.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec

from pancakes.mesh.net.loop import Loop
from pancakes.mesh.security.certified import Certified
from pancakes.mesh.way_facts import Reach, WayFacts, reach_of
from pancakes.runtime.kernel.guest import Guest

if TYPE_CHECKING:
    from pancakes.mesh.security.keys import Keys  # and with it OpenSSL, for which an agent without keys has no use


UNSAID: Final = "the other side closed the connection, and did not say who it is"
"""Why a connection never came to stand that the other side gave up: a terminal that ends does so, or a second dial."""


class Connection(ABC):
    """One open connection: a first-in, first-out stream of bytes each way."""

    remote: str
    """Address of the other end, for messages to people."""
    certified: Certified | None = None
    """What the certificate at the other end says; None: the connection has none."""

    @abstractmethod
    def send(self, data: bytes) -> int:
        """Sends `data`, at once where that needs no waiting, else as soon as there is room. Never blocks.

        Returns:
            As `unsent`.
        """

    @abstractmethod
    def unsent(self) -> int:
        """Returns how many bytes still wait for room."""

    @abstractmethod
    def close(self, reason: str = "") -> None:
        """Closes the connection; `reason` is what this side's handler is told. A second call does nothing."""


class ConnectionHandler(Protocol):
    """What a user of a connection implements."""

    def comes_from(self, remote: str) -> None:
        """A connection came in from there; called before it is known whether it comes to stand."""
        return

    def opened(self, connection: Connection) -> None:
        """The connection stands."""
        ...

    def received(self, data: bytes) -> None:
        """Bytes have come in, however the network cut them."""
        ...

    def closed(self, reason: str) -> None:
        """The connection is gone; called last, once. Also called where it never came to stand."""
        ...

    def last_words(self, fault: str) -> bytes:
        """Returns what the other side is told whose certificate is of the fleet, and is not believed all the same.

        Args:
            fault: why, as a clause. The connection ends without having been `opened`.
        """
        return b""

    def drained(self) -> None:
        """All that waited in the connection was taken: `unsent` came down to 0, and more may be sent.

        Most handlers need not know.
        """
        return


class Scheduled(Protocol):
    """A call that was put off."""

    def cancel(self) -> None:
        """Makes sure that the call does not happen, if it has not begun."""
        ...


class SchemeTransport(ABC):
    """Connections of one scheme (entry point group `pancakes.transports`).

    The name of the entry point is the scheme of its addresses, which read `SCHEME://HOST:PORT` or `SCHEME:///PATH`. All
    that it calls, it calls in the loop's thread: what a thread of its own finds, it hands over with `loop.call_later`.

    Args:
        loop: the transport's thread.
        settings: what the configuration says under `transports.SCHEME` in the settings of `[service.network]`.
        keys: the certificate of this agent or person, and those that it believes; None: it has no keys.
    """

    class Settings(msgspec.Struct):
        """It has no settings. One that encrypts where there are keys has `insecure`: to connect without them too."""

    @abstractmethod
    def __init__(self, loop: Loop, settings: Any, keys: Keys | None) -> None: ...

    @abstractmethod
    def listen(self, address: str, accept: Callable[[], ConnectionHandler]) -> str:
        """See `Transport.listen`."""

    @abstractmethod
    def stop_listening(self, address: str) -> None:
        """See `Transport.stop_listening`."""

    @abstractmethod
    def dial(self, address: str, handler: ConnectionHandler) -> None:
        """See `Transport.dial`."""

    @classmethod
    def facts(cls, address: str, keyed: bool) -> WayFacts:
        """Returns what is known of the way to an address of this scheme.

        Args:
            address: the address.
            keyed: whether the agent has keys.
        """
        return WayFacts(reach_of(address))

    def may_be_named(self, address: str) -> bool:
        """See `Transport.may_be_named`."""
        return True

    @abstractmethod
    def close(self) -> None:
        """Closes all that is open, and tells the handlers. In the loop's thread."""


class Transport(ABC):
    """How one agent reaches other processes, whatever the schemes of their addresses, in one thread."""

    @abstractmethod
    def listen(self, address: str, accept: Callable[[], ConnectionHandler]) -> str:
        """Takes connections at `address` (`tcp://127.0.0.1:7401`; port 0 takes a free one).

        Args:
            address: where to listen; for the parts of an address see `pancakes.mesh.address`.
            accept: makes the handler for each connection that comes in.

        Returns:
            The address with the port that was really taken.

        Raises:
            PancakesError: the address is in use, or is no address; a sentence that says which.
        """

    @abstractmethod
    def stop_listening(self, address: str) -> None:
        """Takes no more connections at `address`, which is free once this returns; open connections stay.

        Args:
            address: what `listen` returned. One at which nothing listens is left alone.
        """

    @abstractmethod
    def dial(self, address: str, handler: ConnectionHandler) -> None:
        """Opens a connection to `address`. Failure comes as `handler.closed(reason)`."""

    def may_be_named(self, address: str) -> bool:
        """Returns whether a peer may name an address: it can be dialled, and no name must be looked up for that."""
        return True

    def facts(self, address: str) -> WayFacts:
        """Returns what is known of the way to an address; of one whose scheme is unknown here, what it looks like."""
        return WayFacts(reach_of(address))

    def reach(self, address: str) -> Reach:
        """Returns from how far an address can be dialled."""
        return self.facts(address).reach

    @abstractmethod
    def call_later(self, delay_s: float, function: Callable[[], None]) -> Scheduled:
        """Runs `function` in the transport's thread in `delay_s` seconds of host time. From any thread."""

    def lend_thread(self, make_guest: Callable[[Callable[[], None]], Guest], busy_poll_s: float = 0.0) -> None:
        """Lets the transport's thread give turns to the actors that it has brought something.

        Without a thread of its own there is nothing to lend.

        Args:
            make_guest: makes the thread a guest of the kernel's pool; called with what relieves the thread.
            busy_poll_s: so long it may stay awake for the next packet where one comes after the other, in seconds of
                host time; 0: never.
        """

    @abstractmethod
    def close(self) -> None:
        """Closes all that is open, tells the handlers, and ends the transport's thread."""
