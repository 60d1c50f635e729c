"""The interface of transports: how bytes travel between agents, whatever the scheme of an address.

`Transport` is what an agent uses. `SocketTransport` is the real one: it hands each address to the transport of its
scheme (`SchemeTransport`, entry point group `pancakes.transports`). In tests and simulations it is
`pancakes.mesh.memory_network.MemoryTransport`.

All callbacks run one at a time in the transport's own thread (in virtual time: in the only thread), and never from
within a call to the transport or to a connection. Any thread may call `Connection.send` and `Connection.close`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec

from pancakes.errors import PancakesError, PluginError
from pancakes.kernel.dispatchers import Guest
from pancakes.mesh.address import Reach, TransportFacts, reach_of
from pancakes.mesh.event_loop import Loop
from pancakes.security.roster import Certified
from pancakes.settings import make_settings
from pancakes.util.clock import Clock
from pancakes.util.plugins import Plugins

if TYPE_CHECKING:
    from pancakes.security.keys import Keys  # it imports OpenSSL, which an agent without keys does not need


UNSAID: Final = "the other side closed the connection, and did not say who it is"
"""Why a connection was never opened: a terminal that ends closes it, or the side of a second dial."""


class Connection(ABC):
    """One open connection: a first-in, first-out stream of bytes each way."""

    remote: str
    """Address of the other end, for messages to people."""
    certified: Certified | None = None
    """The contents of the certificate at the other end; None: the connection has none."""

    @abstractmethod
    def send(self, data: bytes) -> int:
        """Send `data`, at once if that needs no waiting, else as soon as there is room. Never blocks.

        Returns:
            As `unsent`.
        """

    @abstractmethod
    def unsent(self) -> int:
        """Return how many bytes still wait for room."""

    @abstractmethod
    def close(self, reason: str = "") -> None:
        """Close the connection; `reason` goes to this side's handler. A second call does nothing."""


class ConnectionHandler(Protocol):
    """What a user of a connection implements."""

    def comes_from(self, remote: str) -> None:
        """A connection came in from `remote`; called before it is known whether it will be opened."""
        return

    def opened(self, connection: Connection) -> None:
        """The connection is open."""
        ...

    def received(self, data: bytes) -> None:
        """Bytes have come in, in whatever pieces the network delivers."""
        ...

    def closed(self, reason: str) -> None:
        """The connection is gone; called last, once. Also called if it was never opened."""
        ...

    def last_words(self, fault: str) -> bytes:
        """Return the last message to a peer whose certificate is of the fleet but not trusted.

        Args:
            fault: why, as a clause. The connection ends without having been `opened`.
        """
        return b""

    def drained(self) -> None:
        """All waiting bytes of the connection were taken: `unsent` is 0, and more may be sent.

        Most handlers need not know.
        """
        return


class Scheduled(Protocol):
    """A call that is due later."""

    def cancel(self) -> None:
        """Prevent the call, if it has not begun."""
        ...


class SchemeTransport(ABC):
    """Connections of one scheme (entry point group `pancakes.transports`).

    The name of the entry point is the scheme of its addresses, of the form `SCHEME://HOST:PORT` or `SCHEME:///PATH`.
    All that it calls, it calls in the loop's thread: what a thread of its own finds, it hands over with
    `loop.call_later`.

    Args:
        loop: the transport's thread.
        settings: the table `transports.SCHEME` in the settings of `[service.network]`.
        keys: the certificate of this agent or person, and the authorities that it trusts; None: no keys.
    """

    class Settings(msgspec.Struct):
        """No settings. A transport that encrypts if there are keys has `insecure`: to connect also without keys."""

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
    def facts(cls, address: str, keyed: bool) -> TransportFacts:
        """Return the facts of an address of this scheme.

        Args:
            address: the address.
            keyed: whether the agent has keys.
        """
        return TransportFacts(reach_of(address))

    def may_be_named(self, address: str) -> bool:
        """See `Transport.may_be_named`."""
        return True

    @abstractmethod
    def close(self) -> None:
        """Close all connections and listeners, and notify the handlers. In the loop's thread."""


class Transport(ABC):
    """How one agent reaches other processes, whatever the schemes of their addresses, in one thread."""

    @abstractmethod
    def listen(self, address: str, accept: Callable[[], ConnectionHandler]) -> str:
        """Take connections at `address` (`tcp://127.0.0.1:7401`; port 0 takes a free one).

        Args:
            address: where to listen; for the parts of an address see `pancakes.mesh.address`.
            accept: makes the handler for each connection that comes in.

        Returns:
            The address with the actual port.

        Raises:
            PancakesError: the address is in use, or is not an address; the sentence says which.
        """

    @abstractmethod
    def stop_listening(self, address: str) -> None:
        """Stop listening at `address`, which is free once this returns; open connections stay.

        Args:
            address: what `listen` returned. Nothing happens if nothing listens there.
        """

    @abstractmethod
    def dial(self, address: str, handler: ConnectionHandler) -> None:
        """Open a connection to `address`. Failure comes as `handler.closed(reason)`."""

    def may_be_named(self, address: str) -> bool:
        """Return whether a peer may name an address: it can be dialled, and no name must be looked up for that."""
        return True

    def facts(self, address: str) -> TransportFacts:
        """Return the facts of an address; if its scheme is unknown here, facts guessed from its text."""
        return TransportFacts(reach_of(address))

    def reach(self, address: str) -> Reach:
        """Return from how far away an address can be dialled."""
        return self.facts(address).reach

    @abstractmethod
    def call_later(self, delay_s: float, function: Callable[[], None]) -> Scheduled:
        """Run `function` in the transport's thread in `delay_s` seconds of host time. From any thread."""

    def lend_thread(self, make_guest: Callable[[Callable[[], None]], Guest], busy_poll_s: float = 0.0) -> None:
        """Let the transport's thread run turns of the actors that it brings packets.

        A transport without its own thread does nothing.

        Args:
            make_guest: makes the thread a guest of the kernel's pool; called with what relieves the thread.
            busy_poll_s: so long it may stay awake for the next packet where one comes after the other, in seconds of
                host time; 0: never.
        """

    @abstractmethod
    def close(self) -> None:
        """Close all connections and listeners, notify the handlers, and end the transport's thread."""


class SocketTransport(Transport):
    """All schemes of one agent. The transport of each is made when an address first names it.

    Args:
        clock: the host clock.
        name: the agent's name, which the thread is named after.
        plugins: where transports come from.
        settings: the settings of transports, by scheme, already checked.
        keys: the certificate of this agent or person, and the authorities that it trusts; None: no keys.
        insecure: the setting `insecure` for transports that have it; they encrypt if there are keys.
    """

    def __init__(
        self,
        clock: Clock,
        name: str,
        plugins: Plugins,
        settings: Mapping[str, Mapping[str, Any]] | None = None,
        keys: Keys | None = None,
        insecure: bool = False,
    ) -> None:
        self.loop = Loop(clock, f"net-{name}" if name else "net")
        self._plugins = plugins
        self._settings = settings or {}
        self._keys = keys
        self._insecure = insecure
        self._made: dict[str, SchemeTransport] = {}

    def listen(self, address: str, accept: Callable[[], ConnectionHandler]) -> str:
        try:
            return self._of(address).listen(address, accept)
        except PluginError as error:
            raise PancakesError(f"cannot listen at {address}: {error}") from None

    def stop_listening(self, address: str) -> None:
        made = self._made.get(address.partition("://")[0])
        if made is not None:
            made.stop_listening(address)

    def dial(self, address: str, handler: ConnectionHandler) -> None:
        try:
            transport = self._of(address)
        except PluginError as error:
            reason = f"{address} cannot be dialled: {error}"
            self.call_later(0.0, lambda: handler.closed(reason))
        else:
            transport.dial(address, handler)

    def may_be_named(self, address: str) -> bool:
        try:
            return self._of(address).may_be_named(address)
        except PluginError:
            return False

    def facts(self, address: str) -> TransportFacts:
        return facts_of(address, self._keys is not None, self._plugins)

    def call_later(self, delay_s: float, function: Callable[[], None]) -> Scheduled:
        return self.loop.call_later(delay_s, function)

    def lend_thread(self, make_guest: Callable[[Callable[[], None]], Guest], busy_poll_s: float = 0.0) -> None:
        self.loop.lend(make_guest, busy_poll_s)

    def close(self) -> None:
        self.loop.stop(self._close_all)

    def _close_all(self) -> None:
        for made in list(self._made.values()):
            made.close()

    def _of(self, address: str) -> SchemeTransport:
        """Return the transport that an address names.

        Raises:
            PluginError: no distribution offers it, or it cannot be made.
        """
        scheme = address.partition("://")[0]
        made = self._made.get(scheme)
        if made is None:
            cls: type[SchemeTransport] = self._plugins.get("pancakes.transports", scheme)
            given = self._settings.get(scheme, {})
            if self._insecure and "insecure" in cls.Settings.__struct_fields__:
                given = {"insecure": True, **given}
            made = cls(self.loop, make_settings(cls.Settings, given), self._keys)
            # Two threads that dial at once must not make two transports, one of which nothing would close.
            made = self._made.setdefault(scheme, made)
        return made


def facts_of(address: str, keyed: bool, plugins: Plugins) -> TransportFacts:
    """Return the facts of an address; if its scheme is unknown here, facts guessed from its text.

    Args:
        address: the address.
        keyed: whether the agent has keys.
        plugins: where transports come from.
    """
    try:
        cls: type[SchemeTransport] = plugins.get("pancakes.transports", address.partition("://")[0])
    except PluginError:
        return TransportFacts(reach_of(address))
    return cls.facts(address, keyed)
