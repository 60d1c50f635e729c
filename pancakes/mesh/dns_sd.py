"""Announce an agent by DNS-SD over multicast DNS, and find others. Needs `zeroconf`, whose threads do the work.

What is found is only a list of addresses to dial (`pancakes.mesh.announcements`). It has at most `MOST_FOUND` agents,
and at most `MOST_ASKED` questions about others are open at a time, however many services are announced.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Sequence
from ipaddress import ip_interface
from typing import TYPE_CHECKING, Final

from pancakes.errors import needing_extra
from pancakes.mesh.announcements import (
    SERVICE,
    Announcement,
    Interface,
    announced_at,
    host_of,
    label_of,
    read,
    texts_of,
)

if TYPE_CHECKING:
    import asyncio

    from zeroconf import ServiceBrowser, ServiceInfo, ServiceStateChange, Zeroconf

MOST_FOUND: Final = 256
"""Most agents that are remembered; further ones are counted. A mesh has no more."""
MOST_ASKED: Final = 8
"""Most services that are asked for the rest of their announcement at a time."""
ANSWER_S: Final = 2.0
"""How long such a service has for that, in seconds of the host."""


def check_installed(what: str) -> None:
    """Check that the extra is installed.

    Args:
        what: what does not work without it, as the beginning of a sentence.

    Raises:
        PancakesError: it is not; the sentence says what to install.
    """
    with needing_extra(what):
        import zeroconf  # noqa: F401


def own_interfaces() -> tuple[Interface, ...]:
    """Return the addresses of this machine in networks that can carry multicast; none of the loopback."""
    import psutil

    found = []
    stats = psutil.net_if_stats()
    for name, addresses in psutil.net_if_addrs().items():
        flags = stats[name].flags.split(",") if name in stats and stats[name].isup else ()
        if "multicast" not in flags or "loopback" in flags:
            continue
        for it in addresses:
            if it.family in (socket.AF_INET, socket.AF_INET6) and it.netmask:
                with contextlib.suppress(ValueError):
                    found.append(_interface(it.address.partition("%")[0], it.netmask))
    return tuple(sorted(found, key=lambda it: (it.version, it)))


class DnsServiceDiscovery:
    """Browse for agents in the networks that this machine is in now, and announce one of them.

    All methods may be called from any thread but zeroconf's; making and closing it block, for up to some seconds.

    Args:
        own: the addresses of this machine, at least one.

    Attributes:
        own: the same.

    Raises:
        OSError: the network does not let it.
    """

    def __init__(self, own: Sequence[Interface]) -> None:
        from zeroconf import IPVersion, Zeroconf

        self.own = tuple(own)
        self._found: dict[str, Announcement] = {}  # by label; only zeroconf's threads write it
        self._asked: dict[str, ServiceInfo] = {}  # by label; zeroconf's loop adds to it
        self._questions: set[asyncio.Future[bool]] = set()  # only zeroconf's loop touches it
        self._ignored = 0
        self._left_out = False
        four = [str(it.ip) for it in own if it.version == 4]
        version = IPVersion.V4Only if four else IPVersion.V6Only
        self._zeroconf = Zeroconf(four or [str(it.ip) for it in own], ip_version=version, use_asyncio=False)
        try:
            self._browser = self._browse()
        except BaseException:
            self._zeroconf.close()
            raise

    def announce(self, name: str, fleet: str, version: str, listen: Sequence[str]) -> tuple[str, ...]:
        """Announce an agent until this is closed; return its addresses, none if nobody could dial it.

        Args:
            name: its name.
            fleet: its fleet.
            version: the version of Pancakes.
            listen: where it listens.

        Raises:
            OSError: the network does not let it.
        """
        from zeroconf import Error, ServiceInfo

        port, hosts = announced_at(listen, self.own)
        if port:
            label = f"{label_of(name, fleet)}.{SERVICE}"
            texts, server = texts_of(name, fleet, version), host_of(name, fleet)
            info = ServiceInfo(SERVICE, label, port, properties=texts, server=server, parsed_addresses=list(hosts))
            try:
                self._zeroconf.register_service(info, allow_name_change=True)
            except (Error, TimeoutError) as error:
                raise OSError(f"multicast DNS does not take the announcement: {error!r}") from None
        return tuple(f"tcp://{f'[{it}]' if ':' in it else it}:{port}" for it in hosts)

    def found(self) -> list[Announcement]:
        """Return what is announced now, by label."""
        return [it for _, it in sorted(self._found.copy().items())]

    def look_again(self) -> None:
        """Look again at all that is announced, if some of it found no room and there may be room now."""
        if self._left_out and len(self._found) < MOST_FOUND:
            self._left_out = False
            before, self._browser = self._browser, self._browse()  # in this order: one of them hears of each that goes
            before.cancel()

    @property
    def ignored(self) -> int:
        """How many announcements were ignored so far: not of an agent, or too many at a time."""
        return self._ignored

    def close(self) -> None:
        """Take back what was announced, and end."""
        self._browser.cancel()  # its thread would outlive the other
        if self._zeroconf.loop is not None:
            self._zeroconf.loop.call_soon_threadsafe(self._give_up)
        self._zeroconf.close()

    def _give_up(self) -> None:
        """In zeroconf's loop: end the questions, of which asyncio would else complain on the terminal."""
        for it in self._questions:
            it.cancel()

    def _browse(self) -> ServiceBrowser:
        from zeroconf import ServiceBrowser

        return ServiceBrowser(self._zeroconf, SERVICE, handlers=[self._changed])

    def _changed(self, zeroconf: Zeroconf, service_type: str, name: str, state_change: ServiceStateChange) -> None:
        """In the browser's thread: one service was announced, has changed or has gone."""
        from zeroconf import BadTypeInNameException, ServiceInfo, ServiceStateChange

        if state_change is ServiceStateChange.Removed:
            self._found.pop(name, None)
            self._asked.pop(name, None)
            return
        if name not in self._found and len(self._found) >= MOST_FOUND:
            self._leave_out()
            return
        try:
            info = ServiceInfo(service_type, name)
        except BadTypeInNameException:  # anyone may announce any name, and an error would end this thread
            self._ignored += 1
            return
        if info.load_from_cache(zeroconf):
            self._take(name, info)
        elif zeroconf.loop is not None:
            zeroconf.loop.call_soon_threadsafe(self._ask, zeroconf, name, info)

    def _ask(self, zeroconf: Zeroconf, name: str, info: ServiceInfo) -> None:
        """In zeroconf's loop: ask for the rest of an announcement."""
        import asyncio  # zeroconf has imported it, and no other agent should

        if name in self._asked:
            return
        if len(self._questions) >= MOST_ASKED:
            self._leave_out()
            return
        self._asked[name] = info
        task = asyncio.ensure_future(info.async_request(zeroconf, 1000.0 * ANSWER_S))

        def answered(done: asyncio.Future[bool]) -> None:
            self._questions.discard(done)
            if self._asked.get(name) is not info:
                return  # it has gone meanwhile
            del self._asked[name]
            if not done.cancelled() and done.exception() is None and done.result():
                self._take(name, info)

        self._questions.add(task)
        task.add_done_callback(answered)

    def _leave_out(self) -> None:
        self._ignored += 1
        self._left_out = True

    def _take(self, name: str, info: ServiceInfo) -> None:
        try:
            it = read(info.port or 0, info.properties, info.parsed_addresses(), self.own)
        except ValueError:
            self._found.pop(name, None)
            self._ignored += 1
            return
        if name in self._found or len(self._found) < MOST_FOUND:
            self._found[name] = it
        else:
            self._leave_out()


def _interface(address: str, netmask: str) -> Interface:
    if ":" not in address:
        return ip_interface(f"{address}/{netmask}")
    length = bin(int(ip_interface(netmask).ip)).count("1")
    return ip_interface(f"{address}/{length}")
