"""The registry of an agent: its actors, its devices with their holders, and its tasks (paper §3.3).

Other threads read these tables instead of the actors themselves. pykka's own registry is global to the process and
scans a list; this one belongs to one agent and keeps its actors alive. A service enters its own tasks, and a task its
settings. Any thread.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any, Protocol

import msgspec

from pancakes.kernel.mailbox import Mailbox, Reference
from pancakes.packet import Fence


class DeviceEntry(msgspec.Struct, frozen=True):
    """A device that runs.

    Attributes:
        name: its name, as in `[device.NAME]`.
        type: its type, as in a task's `requires`.
        actuator: whether it takes commands, and therefore has one holder at a time.
        networked: whether its readings come from another agent.
        address: where it takes commands.
        watchdog_s: of an actuator: after this long without a fresh command, in mission seconds, its hardware
            goes to its safe hold even if no process tells it to; None: it keeps its last command.
    """

    name: str
    type: str
    actuator: bool = False
    networked: bool = False
    address: str = ""
    watchdog_s: float | None = None


class Loan(msgspec.Struct, frozen=True):
    """An actuator that somebody drives by hand.

    Attributes:
        device: the actuator's name.
        address: the task that has it meanwhile.
        by: who drives, an agent's or a terminal's name.
    """

    device: str
    address: str
    by: str

    @property
    def why(self) -> str:
        """Why no other task has the actuator, as a clause."""
        return f"{self.by} drives {self.device} by hand"


class Described(Protocol):
    """Tells how a device fares."""

    def describe(self, now_s: float) -> dict[str, Any]:
        """Return that as plain values.

        Args:
            now_s: mission time.
        """
        ...


class DescribedFilters(Protocol):
    """Tells what the filters of an actuator do."""

    def describe(self, now_s: float) -> list[dict[str, Any]]:
        """Return that as plain values, a mapping for each.

        Args:
            now_s: mission time.
        """
        ...


class Registry:
    """The components that run on this agent. All methods may be called from any thread.

    pykka's own registry is global to the process and scans a list; this one belongs to one agent and keeps its
    actors alive.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._components: dict[str, Reference] = {}
        self._devices: dict[str, DeviceEntry] = {}
        self._addresses: dict[
            str, str
        ] = {}  # of all devices that ever ran: one may be down, and is to hold all the same
        self._holders: dict[str, str] = {}
        self._reserved: dict[str, str] = {}
        self._loans: dict[str, Loan] = {}
        self._readings: dict[str, Described] = {}
        self._filters: dict[str, DescribedFilters] = {}
        self._moving: set[str] = set()

    def add(self, component: Reference) -> None:
        """Add an actor.

        Raises:
            ValueError: another one runs under this address.
        """
        with self._lock:
            if component.address in self._components:
                raise ValueError(f"{component.address} runs already")
            self._components[component.address] = component

    def remove(self, component: Reference) -> None:
        """Remove an actor, if it is in."""
        with self._lock:
            if self._components.get(component.address) is component:
                del self._components[component.address]

    def get(self, address: str) -> Reference | None:
        """Return the actor that runs at `address`."""
        return self._components.get(address)

    def components(self) -> list[Reference]:
        """Return all actors, in the order in which they started."""
        with self._lock:
            return list(self._components.values())

    def set_readings(self, device: str, readings: Described) -> None:
        """Add what tells how a device fares; it stays when the device stops."""
        with self._lock:
            self._readings[device] = readings

    def readings(self, device: str) -> Described | None:
        """Return what tells how a device fares; None: it was never opened."""
        with self._lock:
            return self._readings.get(device)

    def set_filters(self, device: str, filters: DescribedFilters) -> None:
        """Add what tells what the filters of an actuator do; it stays when the device stops."""
        with self._lock:
            self._filters[device] = filters

    def filters(self, device: str) -> DescribedFilters | None:
        """Return what tells what the filters of an actuator do; None: it has none, or was never opened."""
        with self._lock:
            return self._filters.get(device)

    def note_moving(self, device: str, moving: bool) -> None:
        """Take note whether an actuator carries out commands, or is in its safe hold."""
        with self._lock:
            if moving:
                self._moving.add(device)
            else:
                self._moving.discard(device)

    def moving(self) -> list[str]:
        """Return the names of the actuators that are not in their safe hold, sorted."""
        with self._lock:
            return sorted(self._moving)

    def is_actuator(self, device: str) -> bool:
        """Return whether a device runs and takes commands."""
        with self._lock:
            entry = self._devices.get(device)
            return entry is not None and entry.actuator

    def add_device(self, device: DeviceEntry) -> None:
        """Add a device that has come to run."""
        with self._lock:
            self._devices[device.name] = device
            self._addresses[device.name] = device.address

    def remove_device(self, name: str) -> None:
        """Remove a device."""
        with self._lock:
            self._devices.pop(name, None)

    def devices(self) -> list[DeviceEntry]:
        """Return the devices that run."""
        with self._lock:
            return list(self._devices.values())

    def device_types(self) -> list[str]:
        """Return the types of the devices that run, each once, sorted."""
        return sorted({device.type for device in self.devices()})

    def lacking(self, types: tuple[str, ...]) -> list[str]:
        """Return those of `types` of which no device runs."""
        present = self.device_types()
        return [type_name for type_name in types if type_name not in present]

    def hold(self, address: str, types: tuple[str, ...]) -> str:
        """Grant a task the actuators among the device types that it requires: all of them or none.

        Returns:
            An empty string, or the reason why not.
        """
        with self._lock:
            reason = self._claim(self._holders, address, types)
            if not reason:
                self._unreserve(address)
            return reason

    def reserve(self, address: str, types: tuple[str, ...]) -> str:
        """Keep the actuators among the device types for a task that arrives or is to start: all of them or none.

        It does not hold them yet, so that they obey no task. `hold` for the same address takes them, `unreserve` gives
        them back.

        Returns:
            An empty string, or the reason why not.
        """
        with self._lock:
            return self._claim(self._reserved, address, types)

    def _claim(self, claims: dict[str, str], address: str, types: tuple[str, ...]) -> str:
        """Note a task for all actuators of these types, or say why that cannot be. Under the lock."""
        names = self._actuators(types)
        reason = next((taken for name in names if (taken := self._taken(name, address))), "")
        if not reason:
            claims.update(dict.fromkeys(names, address))
        return reason

    def _actuators(self, types: tuple[str, ...]) -> list[str]:
        """Return the names of the actuators of these types. Under the lock."""
        return [device.name for device in self._devices.values() if device.actuator and device.type in types]

    def unreserve(self, address: str) -> None:
        """Give back what was kept for a task that does not arrive."""
        with self._lock:
            self._unreserve(address)

    def _unreserve(self, address: str) -> None:
        self._reserved = {name: kept_for for name, kept_for in self._reserved.items() if kept_for != address}

    def taken(self, device: str, address: str) -> str:
        """Return why the task at `address` cannot have an actuator now; empty if it can."""
        with self._lock:
            return self._taken(device, address)

    def _taken(self, device: str, address: str) -> str:
        holder = self._holders.get(device, "")
        if holder != address and (loan := self._loans.get(device)) is not None and loan.address != address:
            return loan.why
        if holder not in ("", address):
            return f"{device} is held by {holder}"
        kept_for = self._reserved.get(device, address)
        return "" if kept_for == address else f"{device} is kept for {kept_for}, which is about to start"

    def claim(self, device: str, address: str) -> str:
        """Grant an actuator that no task holds or is about to; return the address that does so then."""
        with self._lock:
            kept_for = self._reserved.get(device, address)
            return self._holders.setdefault(device, address) if kept_for == address else kept_for

    def address_of(self, device: str) -> str:
        """Return the address of a device that runs or has run; empty if it never did."""
        return self._addresses.get(device, "")

    def held_by(self, address: str) -> list[str]:
        """Return the names of the devices that a task holds, without those that somebody else drives."""
        with self._lock:
            held = [name for name, holder in self._holders.items() if holder == address]
            return [name for name in held if name not in self._loans]

    def without_dead_man(self, address: str) -> list[str]:
        """Return the names of the actuators that a task holds, and that keep their last command when it is gone."""
        with self._lock:
            held = (self._devices.get(name) for name, holder in self._holders.items() if holder == address)
            return [device.name for device in held if device is not None and device.watchdog_s is None]

    def release(self, address: str) -> None:
        """Take back what a task holds."""
        with self._lock:
            self._holders = {name: holder for name, holder in self._holders.items() if holder != address}

    def holder(self, device: str) -> str:
        """Return the address of the task that a device obeys; empty if there is none."""
        loan = self._loans.get(device)
        return loan.address if loan is not None else self._holders.get(device, "")

    def lend(self, loan: Loan) -> str:
        """Let a device obey another task than its holder until `end_loan`; return the holder's address, if any.

        A loan that lasts is replaced, as by one of another driver.
        """
        with self._lock:
            self._loans[loan.device] = loan
            return self._holders.get(loan.device, "")

    def end_loan(self, device: str) -> str:
        """Let a device obey its holder again; return the holder's address, if any."""
        with self._lock:
            self._loans.pop(device, None)
            return self._holders.get(device, "")

    def lender(self, device: str) -> str:
        """Return the address of the task that holds a device, lent or not; empty if none does."""
        return self._holders.get(device, "")

    def loan(self, device: str) -> Loan | None:
        """Return the loan of a device; None: it is not lent."""
        return self._loans.get(device)

    def waits_for(self, address: str) -> Loan | None:
        """Return the loan of an actuator that a task holds, and which it waits for; None: it does not wait."""
        if not self._loans:  # as nearly always
            return None
        with self._lock:
            return next((it for name, it in self._loans.items() if self._holders.get(name) == address), None)


class Slotted(Protocol):
    """What a service keeps of a task, as far as others may know it."""

    name: str
    address: str
    life: Any
    """How far it is, a `pancakes.supervision.lifecycle.Life`."""
    mailbox: Mailbox
    fence: Fence | None
    rest: str

    @property
    def spec(self) -> Any:
        """The task as data, a `pancakes.task.TaskSpec`."""


class TaskEntry(msgspec.Struct, frozen=True):
    """A task of a service, at rest or not.

    Attributes:
        service: the name of its service.
        name: its name.
        address: where it is.
        type: the name of its class's entry point, or of its class.
        requires: the device types that it depends on.
        task_id: its identity for life; empty if it cannot move.
        life: how far it is, a `pancakes.supervision.lifecycle.Life`.
        mailbox: where packets wait for it.
        rest: of a task that can move and does not run: why, in a word.
        device: of the task of a device its type; else empty.
        version: the version of the distribution that its class comes from; empty: it cannot move.
        rule: when it moves by itself, a `pancakes.migration.MigrationRule`; None: it does not.
    """

    service: str
    name: str
    address: str
    type: str
    requires: tuple[str, ...]
    task_id: str
    life: Any
    mailbox: Mailbox
    rest: str
    device: str
    version: str
    rule: Any

    @classmethod
    def of(cls, service: str, slot: Slotted) -> TaskEntry:
        """Return the entry of a task of a service."""
        spec = slot.spec
        return cls(
            service,
            slot.name,
            slot.address,
            spec.type or spec.cls.__name__,
            spec.cls.requires,
            slot.fence.task_id if slot.fence is not None else "",
            slot.life,
            slot.mailbox,
            slot.rest,
            spec.device,
            spec.version,
            spec.rule,
        )


class SettingsNote(msgspec.Struct, frozen=True):
    """The settings of a task that runs.

    Attributes:
        settings: an instance of the class's `Settings`; never changed, but replaced.
        plain: the same as plain values; None: they have not been written down yet.
    """

    settings: Any
    plain: Mapping[str, Any] | None = None


class TaskTable:
    """The tasks of all services that run. A service enters its own, and a task its settings. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._services: dict[str, dict[str, TaskEntry]] = {}
        self._settings: dict[str, SettingsNote] = {}

    def enter(self, entry: TaskEntry) -> None:
        """Add a task, or what has become of it."""
        with self._lock:
            self._services.setdefault(entry.service, {})[entry.name] = entry

    def strike_out(self, service: str, name: str = "") -> None:
        """Remove a task that has left its service; without a name all tasks of a service that has ended."""
        with self._lock:
            if name:
                self._services.get(service, {}).pop(name, None)
            else:
                self._services.pop(service, None)

    def get(self, service: str, name: str) -> TaskEntry | None:
        """Return a task of a service; None: it has none of this name."""
        with self._lock:
            return self._services.get(service, {}).get(name)

    def of(self, service: str) -> list[TaskEntry]:
        """Return the tasks of a service, in the order in which they came."""
        with self._lock:
            return list(self._services.get(service, {}).values())

    def all(self) -> list[TaskEntry]:
        """Return all tasks, in the order in which their services started."""
        with self._lock:
            return [entry for entries in self._services.values() for entry in entries.values()]

    def note_settings(self, address: str, note: SettingsNote | None) -> None:
        """Learn the settings of a task that runs; None: it has ended."""
        with self._lock:
            if note is not None:
                self._settings[address] = note
            else:
                self._settings.pop(address, None)

    def settings_of(self, address: str) -> SettingsNote | None:
        """Return the settings of a task; None: it does not run."""
        with self._lock:
            return self._settings.get(address)
