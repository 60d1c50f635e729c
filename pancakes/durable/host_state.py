"""Whether this agent can take a task now, and how busy it is; with the load meter and the class importer.

`HostState` is shared by the services, the Task Migrator and the guardian, in any thread. `LoadMeter` measures
processor time and how late tasks tick. The `Importer` actor imports task classes in a thread of its own, because an
import takes seconds on a small computer.
"""

from __future__ import annotations

import math
import os
import sys
import threading
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import msgspec

from pancakes.control import Refusal
from pancakes.durable.installed import Installed
from pancakes.durable.messages import Solicit
from pancakes.durable.negotiation import HOST_ROLE, Capability
from pancakes.durable.record import Record, TaskId
from pancakes.durable.store import Records
from pancakes.durable.times import Times
from pancakes.errors import PancakesError, describe
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import Reference, tell
from pancakes.kernel.timer import TaskTimer
from pancakes.migration import TAKE_PART, HostLoad
from pancakes.packet import Packet, join

if TYPE_CHECKING:
    import psutil

    from pancakes.durable.reload_types import NewVersion


class MeasuredLoad(msgspec.Struct, frozen=True):
    """How busy an agent was between two looks; `pancakes.migration.HostLoad` has the units."""

    agent_share: float
    host_share: float
    lateness_share: float


IDLE = MeasuredLoad(0.0, 0.0, 0.0)
"""What an agent in virtual time says, where one thread does the work of all agents, and nothing is ever late."""


def processor_time_s() -> float:
    """Returns the processor time that this process has used so far, all its threads together."""
    times = os.times()
    return times.user + times.system


def host_share() -> float:
    """Returns how many processes ran or waited to run in the last minute, for each processor."""
    return os.getloadavg()[0] / (os.cpu_count() or 1)


def describe_process(uptime_s: float) -> dict[str, Any]:
    """Returns what this process is and has used so far, as plain values."""
    import platform

    from pancakes import __version__

    process = _process(os.getpid())
    return {
        "host": platform.node(),
        "pid": process.pid,
        "version": __version__,
        "build": deployed_build(),
        "python": platform.python_version(),
        "processor_s": processor_time_s(),
        "memory_mib": process.memory_info().rss / 2**20,
        "threads": process.num_threads(),
        "uptime_s": uptime_s,
    }


@lru_cache(maxsize=1)
def deployed_build() -> str:
    """Returns which build of Pancakes and its plug-ins `pancakes deploy` has put into this environment; empty: none."""
    try:
        with open(os.path.join(sys.prefix, "pancakes-build")) as file:
            return file.read().strip()
    except OSError:
        return ""


@lru_cache(maxsize=1)
def _process(pid: int) -> psutil.Process:
    # To make one takes a third of all that is asked of it, which a page asks once a second.
    import psutil

    return psutil.Process(pid)


class LoadMeter:
    """Measures the load between one look and the next. Never waits; in one thread.

    Args:
        used_s: returns the processor time used so far.
        host: returns the load of the computer, for each processor.
    """

    def __init__(self, used_s: Callable[[], float] = processor_time_s, host: Callable[[], float] = host_share) -> None:
        self._used_s = used_s
        self._host = host
        self._before: tuple[float, float] | None = None
        self._ticks: dict[TaskTimer, tuple[int, int, float]] = {}

    def look(self, now_s: float, timers: Iterable[TaskTimer]) -> MeasuredLoad | None:
        """Returns the load since the look before; None at the first, which has nothing to compare with.

        Args:
            now_s: host time.
            timers: the timers whose ticks count.
        """
        before, self._before = self._before, (now_s, self._used_s())
        lateness_share = self._lateness(timers)
        if before is None or now_s <= before[0]:
            return None
        agent_share = max(0.0, self._before[1] - before[1]) / (now_s - before[0])
        return MeasuredLoad(agent_share, self._host(), lateness_share)

    def _lateness(self, timers: Iterable[TaskTimer]) -> float:
        late, count = 0.0, 0
        ticks: dict[TaskTimer, tuple[int, int, float]] = {}
        for timer in timers:
            now = ticks[timer] = (timer.ticks, timer.missed_total, timer.lateness_sum_s)
            was = self._ticks.get(timer, (0, 0, 0.0))
            late += (now[2] - was[2]) / timer.period_s + (now[1] - was[1])
            count += now[0] - was[0] + now[1] - was[1]
        # Those of actors that have ended are forgotten with it.
        self._ticks = ticks
        return late / count if count else 0.0


IMPORTER: Final = "kernel/Importer"


class Import(msgspec.Struct, frozen=True):
    """Asks the importer for a task type.

    Attributes:
        asker: the actor that gets the answer, `Imported`.
        type: the task type.
        waiting: what waits for it; data.
    """

    asker: Reference
    type: str
    waiting: object


class Imported(msgspec.Struct, frozen=True):
    """A task type is imported, or cannot be: what is asked about it is answered at once from now on.

    Attributes:
        waiting: what has waited for it.
    """

    waiting: Any


class ImportAgain(msgspec.Struct, frozen=True):
    """Asks the importer for the version of a task type that is on disk.

    Attributes:
        asker: the actor that gets the answer, `ImportedAgain`.
        type: the task type.
    """

    asker: Reference
    type: str


class ImportedAgain(msgspec.Struct, frozen=True):
    """The version that is on disk is imported beside the one in use, or cannot be.

    Attributes:
        version: it; None: it cannot be had.
        refusal: why not; None: it is there.
    """

    version: NewVersion | None
    refusal: Refusal | None


def import_again(installed: Installed, type_name: str) -> ImportedAgain:
    """Import the version of a task type that is on disk. May take long."""
    try:
        return ImportedAgain(installed.prepare(type_name), None)
    except PancakesError as error:
        return ImportedAgain(None, Refusal.of(error))
    except Exception as error:  # finders and metadata of others may raise anything
        return ImportedAgain(None, Refusal("failed", f"{type_name} cannot be imported again: {describe(error)}"))


class Importer(ActorCore):
    """Imports task types in a thread of its own: the actors that answer other agents, and keep leases, wait for none.

    It belongs to no service. In virtual time there is none.

    Args:
        installed: what is installed.
    """

    blocking = True

    def __init__(self, *args: Any, installed: Installed, **others: Any) -> None:
        super().__init__(*args, **others)
        self._installed = installed

    def take_message(self, message: Any) -> Any:
        if isinstance(message, ImportAgain):
            tell(message.asker, import_again(self._installed, message.type))
            return None
        if not isinstance(message, Import):
            return super().take_message(message)
        self._installed.version_of(message.type)
        tell(message.asker, Imported(message.waiting))
        return None


RESERVE_FRESH_S: Final = 60.0
"""A reserve that is older does not count: the robot may have used it up."""
MOST_SLOTS: Final = 64
"""Most slots that are kept for the tasks of one peer."""


class OwnReadings:
    """Keeps the newest reading of each device type that this agent publishes. Any thread.

    It is a tap of `system`, not a subscription: what a bid needs now and then must not cost a turn for each reading.

    Args:
        agent: the agent's name.

    Attributes:
        newest: the body of the newest reading, by device type.
        reserve_s: when the newest `reserve` was published, in mission time.
    """

    def __init__(self, agent: str) -> None:
        self._prefix = f"{agent}/"
        self.newest: dict[str, Any] = {}
        self.reserve_s = 0.0

    def take(self, packet: Packet) -> None:
        """Keep a reading, unless it is from another agent. In its publisher's thread."""
        if packet.source.startswith(self._prefix):
            if packet.type == "reserve":
                self.reserve_s = packet.stamp_s
            self.newest[packet.type] = packet.body


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
        readings: the newest readings of this agent's devices; the Task Migrator says of which types.
        measured: how busy the agent was lately; None before the first look.
        negotiated: the tasks for which the Task Migrator compares bids.
        shortest_lease: the task with the shortest lease that this agent guards, as the guardian says; None: it guards
            none.
        unplaced: the tasks here for which the allocation has found no robot, and why, as the Allocator says.
        allocates: whether an Allocator runs here.
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
        self._hosting: dict[str, None] = {}  # the services that host tasks, also those that are stopped now
        self._reserved: dict[TaskId, tuple[str, float]] = {}  # for a task of which agent, and until when
        self.readings = OwnReadings(kernel.agent)
        self.measured: MeasuredLoad | None = None
        self.negotiated: tuple[TaskId, ...] = ()
        self.unplaced: dict[str, str] = {}
        self.allocates = False
        self.shortest_lease: Record | None = None

    @property
    def battery_level(self) -> float | None:
        """What is left of this agent's battery, from 0 to 1, as it last said; None before that."""
        battery = self.readings.newest.get("battery")
        return battery.level if battery is not None else None

    @property
    def energy_reserve(self) -> Any:
        """The newest `Reserve` of this agent; None: there has been none for a minute of mission time."""
        fresh = abs(self._kernel.now() - self.readings.reserve_s) <= RESERVE_FRESH_S  # a clock that was set back
        return self.readings.newest.get("reserve") if fresh else None

    def known_readings(self) -> dict[str, Any]:
        """Return the newest readings by device type, without a reserve that is too old."""
        readings = dict(self.readings.newest)
        if self.energy_reserve is None:
            readings.pop("reserve", None)
        return readings

    # What the services keep true -------------------------------------------------------------------------------

    def begin(self, service: str) -> None:
        """A service begins that takes tasks in."""
        with self._lock:
            self._hosting[service] = None

    def reserve(self, peer: str, request: Solicit) -> Refusal | None:
        """Keep a slot for a task that is about to come; return why it cannot, None if it does.

        No safety hangs on it, and a crash empties it.
        """
        task_id = request.task_id
        if (other_peer := self._kept().get(task_id, peer)) != peer:
            return Refusal("conflict", f"keeps room for it for {other_peer}")
        self.free(task_id)
        if refusal := self.refusal_of(peer, request):
            return refusal
        kept = self._kept()
        if sum(it == peer for it in kept.values()) >= MOST_SLOTS:
            return Refusal("busy", f"keeps room for {MOST_SLOTS} tasks of {peer} already", Times().slot_s)
        with self._lock:
            # Another service may have kept the name since.
            for other in self._reserved:
                if other.name == task_id.name and other != task_id:
                    return Refusal("conflict", f"has a task named {task_id.name} already ({other})")
            self._reserved[task_id] = (peer, self._kernel.host.now() + Times().slot_s)
        return None

    def is_expected(self, peer: str, task_id: TaskId) -> bool:
        """Return whether room is kept for a task of an agent."""
        return self._kept().get(task_id) == peer

    def free(self, task_id: TaskId) -> None:
        """Gives the slot for a task up, if there is one: it has arrived, or does not come."""
        with self._lock:
            self._reserved.pop(task_id, None)

    def _kept(self) -> dict[TaskId, str]:
        """Return the tasks that a slot is kept for, in order, and for which agent; drop what has expired."""
        now_s = self._kernel.host.now()
        with self._lock:
            self._reserved = {task_id: it for task_id, it in sorted(self._reserved.items()) if it[1] > now_s}
            return {task_id: peer for task_id, (peer, _) in self._reserved.items()}

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

    def refusal_of(self, peer: str, request: Solicit) -> Refusal | None:
        """Returns why this agent cannot take a task of a peer now; None if it can."""
        if fault := self._kernel.access.fault(peer, "host", request.type):
            return Refusal("forbidden", fault)
        registry = self._kernel.registry
        reserve = self.energy_reserve
        capability = Capability(
            role=self._role,
            devices=tuple(registry.device_types()),
            version=self._installed.version_of(request.type),
            fault=self._installed.fault_of(request.type),
            services=tuple(self._running()),
            recorded=self._records.service_of(request.task_id),
            holder=self._holder_of(request.task_id.name),
            costs=tuple(self.costs()),
            battery_level=self.battery_level,
            reserve_s=reserve.seconds if reserve is not None else None,
        )
        return capability.refusal_of(request) or Refusal.if_any(self._taken(request), "conflict")

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
            if (loan := registry.loan(device.name)) is not None:
                return loan.why
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
        told = self.energy_reserve
        reserve = msgspec.to_builtins(told) if told is not None else None
        return {
            "load": load,
            "battery_level": self.battery_level,
            "reserve": reserve,
            "disk": disk,
            "unplaced": self.unplaced if self.allocates else self._not_allocated(),
        }

    def _not_allocated(self) -> dict[str, str]:
        """Return the tasks here that wait for an allocation, although no Allocator runs, and what to do."""
        why = f"{self._kernel.agent} takes no part in the allocation: {TAKE_PART} of its configuration"
        return {
            entry.task_id: why
            for entry in self._kernel.tasks.all()
            if entry.rule is not None and entry.rule.allocated and entry.task_id
        }
