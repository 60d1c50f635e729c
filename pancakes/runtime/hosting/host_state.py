"""What an agent could be to a task from elsewhere, as its services, devices and tasks have it at the moment."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Any, Final

import msgspec

from pancakes.mesh.guarding.guardian_core import GuardRegister
from pancakes.mesh.migration.capability import HOST_ROLE, Capability
from pancakes.mesh.migration.cost import HostLoad
from pancakes.mesh.migration.messages import Reserve, Solicit
from pancakes.mesh.migration.record import TaskId
from pancakes.mesh.migration.reservations import Reservation, Reservations
from pancakes.mesh.migration.times import Times
from pancakes.packet import join
from pancakes.runtime.hosting.importer import IMPORTER, Import
from pancakes.runtime.hosting.load import MeasuredLoad
from pancakes.runtime.hosting.records import Records
from pancakes.runtime.installed import Installed
from pancakes.runtime.kernel.kernel import Kernel
from pancakes.runtime.kernel.reference import Reference

MOST_SLOTS: Final = 64
"""Most slots that are kept for the tasks of one peer."""


class HostState:
    """Says whether this agent can take a task, and how busy it is. Any thread.

    It reads the records and the kernel's tables, which the services keep true, so none of them reads another. What is
    in neither of these, the Task Migrator and the guardian set. Its lock is held for its own tables alone.

    Args:
        kernel: the kernel, whose registry has the devices and all components.
        role: the agent's role.
        installed: the task types and cost functions that are installed.
        records: says which service has the record of a task.

    Attributes:
        costs: returns the cost functions that are installed, by name.
        battery_level: what is left of this agent's battery, from 0 to 1, as it last said; None before that.
        measured: how busy the agent was lately; None before the first look.
        negotiated: the tasks for which the Task Migrator compares bids.
        shortest_lease: the task with the shortest lease that this agent guards, as the guardian says; None: it guards
            none.
        register_of: returns what this agent has on disk as a guardian of a task; None: nothing.
    """

    def __init__(
        self,
        kernel: Kernel,
        role: str,
        installed: Installed,
        records: Records,
    ) -> None:
        self._kernel = kernel
        self._role = role
        self._installed = installed
        self.costs = installed.costs
        self._records = records
        self._lock = threading.Lock()
        self._hosting: dict[str, None] = {}  # the services that host tasks, also where they are stopped now
        self._reservations = Reservations()
        self.battery_level: float | None = None
        self.measured: MeasuredLoad | None = None
        self.negotiated: tuple[TaskId, ...] = ()
        self.shortest_lease: GuardRegister | None = None
        self.register_of: Callable[[TaskId], GuardRegister | None] = lambda task_id: None

    # What the services keep true -------------------------------------------------------------------------------

    def begin(self, service: str) -> None:
        """A service begins that takes tasks in."""
        with self._lock:
            self._hosting[service] = None

    def reserve(self, peer: str, message: Reserve) -> str:
        """Keeps a slot for a task that is about to come; says why that cannot be."""
        now_s, task_id = self._kernel.host.now(), message.task_id
        if message.request.task_id != task_id:
            return f"was asked for a place for {task_id} and told of {message.request.task_id}"
        with self._lock:
            other_peer = self._reservations.peer_of(task_id, now_s)
            if other_peer not in ("", peer):
                return f"keeps a place for it for {other_peer}"
        self.free(task_id)
        if refusal := self.refusal_of(peer, message.request):
            return refusal
        with self._lock:
            if self._reservations.number(peer, now_s) >= MOST_SLOTS:
                return f"keeps {MOST_SLOTS} places for tasks of {peer} already"
            # Another service may have kept the name since.
            for other in self._reservations.kept(now_s):
                if other.name == task_id.name and other != task_id:
                    return f"has a task named {task_id.name} already ({other})"
            self._reservations.keep(task_id, Reservation(peer, message.offer, now_s + Times().slot_s))
        return ""

    def free(self, task_id: TaskId) -> None:
        """Gives the slot for a task up, if there is one: it has arrived, or does not come."""
        with self._lock:
            self._reservations.free(task_id)

    # What others ask -------------------------------------------------------------------------------------------

    def under_way(self, service: str = "") -> list[TaskId]:
        """Returns the tasks of a service that are being handed over; empty: of all services that run."""
        services = [service] if service else self._running()
        records = self._records.all().values()
        return [record.task_id for record in records if record.under_way and record.service in services]

    def _running(self) -> list[str]:
        with self._lock:
            services = list(self._hosting)
        return [service for service in services if self._kernel.actor(service) is not None]

    def services(self) -> list[Reference]:
        """Returns the services that run and take tasks in."""
        services = map(self._kernel.actor, self._running())
        return [service for service in services if service is not None]

    def _kept(self) -> tuple[TaskId, ...]:
        with self._lock:
            return self._reservations.kept(self._kernel.host.now())

    def imports_first(self, asker: Reference, peer: str, type: str, waiting: object) -> bool:
        """Has the importer import a task type, unless it is at hand or the peer may have this agent host no such task.

        In virtual time an import takes no time, so there it is not needed.

        Args:
            asker: the actor that gets `Imported` then.
            peer: the agent that asks for such a task.
            type: the task type.
            waiting: what it then goes on with; data.

        Returns:
            Whether it does.
        """
        if self._kernel.virtual is not None or self._installed.at_hand(type):
            return False
        if self._kernel.access.fault(peer, "host", type):
            return False
        return self._kernel.tell(IMPORTER, Import(asker, type, waiting))

    def refusal_of(self, peer: str, request: Solicit) -> str:
        """Returns why this agent cannot take a task of a peer now, as a phrase; empty where it can."""
        if fault := self._kernel.access.fault(peer, "host", request.type):
            return fault
        registry = self._kernel.registry
        holder = self._holder_of(request.task_id.name)
        version, fault = self._installed.version_of(request.type), self._installed.fault_of(request.type)
        recorded = self._records.service_of(request.task_id)
        capability = Capability(
            role=self._role,
            devices=tuple(registry.device_types()),
            types={request.type: version} if version is not None else {},
            faults={request.type: fault} if fault else {},
            services=tuple(self._running()),
            records={request.task_id: recorded} if recorded else {},
            names={holder.name: holder} if holder is not None else {},
            costs=tuple(self.costs()),
            battery_level=self.battery_level,
        )
        return capability.refusal_of(request) or self._taken(request)

    def _holder_of(self, name: str) -> TaskId | None:
        """Returns the task that a name belongs to here: it has a slot, or one is kept for it. None: it is free."""
        if any(self._kernel.tasks.get(service, name) is not None for service in self._running()):
            return self._records.here(name) or TaskId(self._kernel.agent, name)
        return next((task_id for task_id in self._kept() if task_id.name == name), None)

    def hosts(self) -> bool:
        """Returns whether this agent runs tasks."""
        return self._role == HOST_ROLE and bool(self._running())

    def runs(self, type: str) -> bool:
        """Returns whether this agent runs tasks, and has this type of them."""
        return self.hosts() and self._installed.version_of(type) is not None

    def _taken(self, request: Solicit) -> str:
        registry = self._kernel.registry
        place = join(self._kernel.agent, request.service, request.task_id.name)
        for device in registry.devices():
            if not device.actuator or device.type not in request.requires:
                continue
            holder = registry.holder(device.name)
            if holder:
                return f"{device.name} is held by {holder}"
            taken = registry.taken(device.name, place)
            if taken:
                return taken
        return ""

    def load(self, rtt_s: float | None) -> HostLoad:
        """Returns how busy this agent is.

        Args:
            rtt_s: the round trip to the agent that asks, in seconds; None: it is not known.
        """
        level = self.battery_level
        if level is None and "battery" in self._kernel.registry.device_types():
            level = math.nan
        measured = self.measured
        return HostLoad(
            active_tasks=self._tasks() + len(self._kept()),
            battery_level=level,
            agent_share=measured.agent_share if measured is not None else None,
            host_share=measured.host_share if measured is not None else None,
            lateness_share=measured.lateness_share if measured is not None else None,
            rtt_s=rtt_s,
        )

    def _tasks(self) -> int:
        prefixes = tuple(join(self._kernel.agent, service) + "/" for service in self._running())
        return sum(component.address.startswith(prefixes) for component in self._kernel.registry.components())

    def describe(self) -> dict[str, Any]:
        """Returns what people may want to know, as plain values."""
        measured = self.measured
        load = msgspec.to_builtins(measured) if measured is not None else None
        syncs, written_bytes = self._kernel.disk_use()
        disk = {"syncs": syncs, "written_bytes": written_bytes}
        return {"load": load, "battery_level": self.battery_level, "disk": disk}
