"""An agent's way to other processes over real sockets: each address by the transport of its scheme, in one thread."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from pancakes.errors import PancakesError, PluginError
from pancakes.mesh.net.loop import Loop
from pancakes.mesh.net.transport import ConnectionHandler, Scheduled, SchemeTransport, Transport
from pancakes.mesh.way_facts import WayFacts, reach_of
from pancakes.runtime.clock import Clock
from pancakes.runtime.kernel.guest import Guest
from pancakes.runtime.plugins import Plugins
from pancakes.settings import make_settings

if TYPE_CHECKING:
    from pancakes.mesh.security.keys import Keys


class SocketTransport(Transport):
    """All schemes of one agent. The transport of each is made when an address first names it.

    Args:
        clock: the host clock.
        name: the agent's name, which the thread bears.
        plugins: where transports are found.
        settings: the settings of transports, by scheme; they have been checked.
        keys: the certificate of this agent or person, and those that it believes; None: it has no keys.
        insecure: what the setting `insecure` of those transports is that have it; they encrypt where there are keys.
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

    def facts(self, address: str) -> WayFacts:
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
        """Returns the transport that an address names.

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
            # Two threads that dial at once must not have one each, which nothing would close.
            made = self._made.setdefault(scheme, made)
        return made


def facts_of(address: str, keyed: bool, plugins: Plugins) -> WayFacts:
    """Returns what is known of the way to an address; of one whose scheme is unknown here, what it looks like.

    Args:
        address: the address.
        keyed: whether the agent has keys.
        plugins: where transports are found.
    """
    try:
        cls: type[SchemeTransport] = plugins.get("pancakes.transports", address.partition("://")[0])
    except PluginError:
        return WayFacts(reach_of(address))
    return cls.facts(address, keyed)
