"""The task that announces its agent by multicast DNS and dials the agents of its fleet that it finds so.

It is a task of the Network Service if `[agent] mdns` is true. What it finds it gives to the mesh as addresses, within
the bounds for addresses that a peer names: the links, their certificates and the roster decide the rest.
"""

from __future__ import annotations

from typing import Any, Final

from pancakes import __version__
from pancakes.mesh.announcements import Announcement
from pancakes.mesh.dns_sd import DnsServiceDiscovery, check_installed, own_interfaces
from pancakes.mesh.mesh import Mesh
from pancakes.mesh.messages import AgentSeen
from pancakes.task import Task

LOOK_S: Final = 1.0
"""How often it looks at what was found and at this machine's own addresses, in seconds of the host. So an agent that
floods the network costs one look a second."""
AGAIN_S: Final = 10.0
"""After this time it tries again if the network did not let it, and looks at what found no room, in host seconds."""
MOST_LOGGED: Final = 256
"""Most agents that the log names."""
FOUND_BY: Final = "mdns:"
"""Who names these addresses. It is no name that a peer could have, so it has its own share of the bounds."""


class Mdns(Task):
    """Announces the agent on each network that its machine is in, also on those that it joins later.

    Args:
        mesh: the mesh, which dials what is found.
    """

    blocking = True  # making and closing the sockets takes up to a second

    def __init__(self, *args: Any, mesh: Mesh, **others: Any) -> None:
        super().__init__(*args, **others)
        self._mesh = mesh
        self._discovery: DnsServiceDiscovery | None = None
        self._logged: set[tuple[str, tuple[str, ...]]] = set()
        self._fault = ""
        self._ignored = 0

    def on_start(self) -> None:
        check_installed("no agent is announced or found by mDNS")
        self.call(self._look)
        self.after_host(AGAIN_S, self._look_again)

    def on_stop(self) -> None:
        if self._discovery is not None:
            self._discovery.close()
            self._discovery = None

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        self.on_stop()

    def _look(self) -> None:
        wait_s = LOOK_S
        try:
            own = own_interfaces()
            if self._discovery is not None and self._discovery.own != own:
                self.on_stop()
            if self._discovery is None and own:
                self._discovery = DnsServiceDiscovery(own)
                self._announce(self._discovery)
        except OSError as error:
            self.on_stop()
            self._warn(f"cannot use mDNS, and tries again: {error.strerror or error}")
            wait_s = AGAIN_S
        if self._discovery is not None:
            self._take(self._discovery)
        self.after_host(wait_s, self._look)

    def _look_again(self) -> None:
        if self._discovery is not None:
            self._discovery.look_again()
        self.after_host(AGAIN_S, self._look_again)

    def _announce(self, discovery: DnsServiceDiscovery) -> None:
        identity = self._mesh.identity
        at = discovery.announce(identity.name, identity.fleet, __version__, self._mesh.listen)
        self._fault, self._ignored = "", 0
        if at:
            self.log("info", f"is announced by mDNS at {', '.join(at)}")
        else:
            why = "it listens at no tcp:// address of the networks of its machine"
            self._warn(f"is not announced by mDNS, because {why}; it only finds others")

    def _take(self, discovery: DnsServiceDiscovery) -> None:
        identity = self._mesh.identity
        found = [it for it in discovery.found() if it.fleet == identity.fleet and it.name != identity.name]
        for it in found:
            self._log_once(it)
        # Again each time: an address that was forgotten after many failures is tried again while it is announced.
        self._mesh.hear_of([AgentSeen(it.name, address) for it in found for address in it.addresses], FOUND_BY)
        if discovery.ignored and not self._ignored:
            self._ignored = discovery.ignored
            self.log("warning", "ignores announcements by mDNS that are not of agents it could dial, or too many")

    def _log_once(self, it: Announcement) -> None:
        key = (it.name, it.addresses)
        if key not in self._logged and len(self._logged) < MOST_LOGGED:
            self._logged.add(key)
            self.log("info", f"{it.name} (Pancakes {it.version}) announces itself by mDNS at {', '.join(it.addresses)}")

    def _warn(self, text: str) -> None:
        if text != self._fault:
            self._fault = text
            self.log("warning", text)
