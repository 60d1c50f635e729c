"""What the tasks of an agent are, for what looks at them from outside their services."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any, Protocol

import msgspec

from pancakes.packet import Fence
from pancakes.runtime.kernel.mailbox import Mailbox
from pancakes.runtime.life.life import Life


class Slotted(Protocol):
    """What a service keeps of a task, as far as others may know it."""

    name: str
    address: str
    life: Life
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
        task_id: its identity for life; empty where it cannot move.
        life: how far it is.
        mailbox: where packets wait for it.
        rest: of a task that can move and does not run: why, in a word.
        device: of the task of a device its type; else empty.
    """

    service: str
    name: str
    address: str
    type: str
    requires: tuple[str, ...]
    task_id: str
    life: Life
    mailbox: Mailbox
    rest: str
    device: str

    @classmethod
    def of(cls, service: str, slot: Slotted) -> TaskEntry:
        """Returns the entry of a task of a service."""
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
        """Enters a task, or what has become of it."""
        with self._lock:
            self._services.setdefault(entry.service, {})[entry.name] = entry

    def strike_out(self, service: str, name: str = "") -> None:
        """Strikes a task out, which has left its service; without a name all tasks of a service that has ended."""
        with self._lock:
            if name:
                self._services.get(service, {}).pop(name, None)
            else:
                self._services.pop(service, None)

    def get(self, service: str, name: str) -> TaskEntry | None:
        """Returns a task of a service; None: it has none of this name."""
        with self._lock:
            return self._services.get(service, {}).get(name)

    def of(self, service: str) -> list[TaskEntry]:
        """Returns the tasks of a service, in the order in which they came."""
        with self._lock:
            return list(self._services.get(service, {}).values())

    def all(self) -> list[TaskEntry]:
        """Returns all tasks, in the order in which their services started."""
        with self._lock:
            return [entry for entries in self._services.values() for entry in entries.values()]

    def note_settings(self, address: str, note: SettingsNote | None) -> None:
        """Learns the settings of a task that runs; None: it has ended."""
        with self._lock:
            if note is not None:
                self._settings[address] = note
            else:
                self._settings.pop(address, None)

    def settings_of(self, address: str) -> SettingsNote | None:
        """Returns the settings of a task; None: it does not run."""
        with self._lock:
            return self._settings.get(address)
