"""Whether an agent can take a task at all: what it has, against what the task asks for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import msgspec

from pancakes.mesh.migration.cost import fault_of_choice, names_of
from pancakes.mesh.migration.messages import Solicit
from pancakes.mesh.migration.record import TaskId

HOST_ROLE: Final = "agent"
"""The one role whose agents are asked to take a task: no simulated world, no terminal."""

BATTERY_MARGIN: Final = 0.10
"""A candidate's battery must lie at least this much above the level where the task would move on: no ping-pong."""


class Capability(msgspec.Struct, frozen=True):
    """What an agent has to offer to a task, at the moment of asking.

    Attributes:
        role: its role on the mesh.
        devices: the types of its devices.
        types: the task types that it knows, with the version of the distribution they come from.
        faults: for each task type that is installed and cannot be loaded, why.
        services: the services that run here and take tasks in.
        records: for each task of which there is a record here, the service that has it.
        names: which task each name here belongs to: those that run, are stopped, or are about to arrive.
        costs: the cost functions that it knows.
        battery_level: what is left of its battery, 0 to 1; None where it has none.
    """

    role: str = HOST_ROLE
    devices: tuple[str, ...] = ()
    types: Mapping[str, str] = msgspec.field(default_factory=dict)
    faults: Mapping[str, str] = msgspec.field(default_factory=dict)
    services: tuple[str, ...] = ("client",)
    records: Mapping[TaskId, str] = msgspec.field(default_factory=dict)
    names: Mapping[str, TaskId] = msgspec.field(default_factory=dict)
    costs: tuple[str, ...] = ("tasks",)
    battery_level: float | None = None

    def refusal_of(self, request: Solicit) -> str:
        """Returns why this agent cannot take the task, all reasons in one phrase; empty where it can."""
        return "; ".join(reason for reason in self._reasons(request) if reason)

    def _reasons(self, request: Solicit) -> tuple[str, ...]:
        return (
            "" if self.role == HOST_ROLE else f"is no host of tasks but in the role {self.role!r}",
            self._service(request),
            self._devices(request),
            self._type(request),
            self._name(request),
            self._cost(request),
            self._battery(request),
        )

    def _service(self, request: Solicit) -> str:
        if request.service not in self.services:
            there = f"only {', '.join(self.services)}" if self.services else "nor any other"
            return f"runs no service {request.service!r} that takes tasks in, {there}"
        record = self.records.get(request.task_id, request.service)
        if record != request.service:
            return f"has a record of {request.task_id} in its service {record!r}, not in {request.service!r}"
        return ""

    def _devices(self, request: Solicit) -> str:
        lacking = [device for device in request.requires if device not in self.devices]
        if not lacking:
            return ""
        kind = "device type" if len(lacking) == 1 else "device types"
        return f"lacks the {kind} {', '.join(lacking)}"

    def _type(self, request: Solicit) -> str:
        here = self.types.get(request.type)
        if here is None:
            return self.faults.get(request.type, f"knows no task type {request.type!r}")
        if not compatible(request.version, here):
            return f"has {request.type} in version {here}, not {request.version}"
        return ""

    def _name(self, request: Solicit) -> str:
        holder = self.names.get(request.task_id.name)
        if holder is None or holder == request.task_id:
            return ""
        return f"has a task named {request.task_id.name} already ({holder})"

    def _cost(self, request: Solicit) -> str:
        unknown = [name for name in names_of(request.cost) if name not in self.costs]
        if unknown:
            kind = "cost function" if len(unknown) == 1 else "cost functions"
            return f"knows no {kind} {', '.join(repr(name) for name in unknown)}"
        return fault_of_choice(request.cost)

    def _battery(self, request: Solicit) -> str:
        level, below = self.battery_level, request.moves_on_below
        if level is None or below is None or level >= below + BATTERY_MARGIN:
            return ""
        return f"has {level:.0%} of its battery, too near to the {below:.0%} at which the task would move on"


def compatible(offered: str, here: str) -> bool:
    """Returns whether a task of the version `offered` may be built from the version `here`.

    It may where both have the same number up to the first that is not 0, as semantic versioning promises.
    """
    return _line_of(offered) == _line_of(here)


def _line_of(version: str) -> tuple[str, ...]:
    line: list[str] = []
    for part in version.split("."):
        line.append(part)
        if part != "0":
            break
    return tuple(line)
