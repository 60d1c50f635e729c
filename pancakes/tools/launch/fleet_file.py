"""A fleet file: which agents are launched together, and how, as frozen dataclasses; or all that is wrong with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar

from pancakes.errors import ConfigError
from pancakes.runtime.config.config_schema import closed, named_tables, schema_document
from pancakes.runtime.config.key_places import KeyPlaces
from pancakes.runtime.config.scanner import KeyPath
from pancakes.runtime.config.toml_source import fault_of_schema, read_tables, text_of
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.schema import schema_of
from pancakes.runtime.foundation.suggestion import suggestion
from pancakes.runtime.life.restart import fault_of_pauses
from pancakes.settings import check_settings
from pancakes.tools.launch.member import ProcessRestart
from pancakes.tools.launch.ssh import fault_of_host

FLEET_FILE: Final = "fleet.toml"
"""The name of a folder's fleet file."""

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class FleetTable:
    """The table `[fleet]`: the settings that all of its agents share.

    Attributes:
        name: the fleet that they belong to; empty: each says so in its own file.
        set: what is changed of each agent's file: tables and keys as in that file, such as `{ clock.speed = 5 }`.
        restart: what happens when one of their processes ends, where its own table does not say.
    """

    name: str = ""
    set: Mapping[str, Any] = field(default_factory=dict)
    restart: ProcessRestart = field(default_factory=ProcessRestart)


@dataclass(frozen=True, slots=True)
class MemberTable:
    """A table `[agent.NAME]`: one agent of the fleet. It bears this name, whatever its configuration file says.

    Attributes:
        config: its configuration file, counted from the folder of the fleet file; empty: `NAME.toml`.
        set: what is changed of that file, besides what `[fleet]` says.
        restart: what happens when its process ends; None: what `[fleet]` says.
        after: the agents that must be ready before it is started, and that end after it.
        host: where it runs, as `ssh` takes it: `pi@robot1`, or a name of `~/.ssh/config`; empty: on this machine.
    """

    config: str = ""
    set: Mapping[str, Any] = field(default_factory=dict)
    restart: ProcessRestart | None = None
    after: tuple[str, ...] = ()
    host: str = ""


@dataclass(frozen=True, slots=True)
class FleetFile:
    """All that a fleet file says.

    Attributes:
        fleet: the table `[fleet]`.
        agents: its agents by name, in the order of the file.
        places: where each key stands, for messages.
    """

    fleet: FleetTable
    agents: Mapping[str, MemberTable]
    places: KeyPlaces = field(repr=False, compare=False)


def is_fleet(values: Mapping[str, Any]) -> bool:
    """Returns whether a file's values are those of a fleet file, and not an agent's configuration."""
    return "fleet" in values


def load_fleet(path: str) -> FleetFile:
    """Reads a fleet file.

    Raises:
        ConfigError: it cannot be read, or is not sound; it carries every fault.
    """
    tables = read_tables(text_of(path), path, named=("agent",))
    reader = _FleetReader(tables.values, tables.places)
    found = reader.read()
    if faults := tables.with_faults(reader.faults):
        raise ConfigError(reader.places.in_order(faults))
    return found


def fleet_schema() -> dict[str, Any]:
    """Returns the JSON Schema (draft 2020-12) of a fleet file."""
    fleet, agent = closed(schema_of(FleetTable)), closed(schema_of(MemberTable))
    definitions = {**fleet.pop("$defs", {}), **agent.pop("$defs", {})}
    properties = {"fleet": fleet, "agent": named_tables(agent)}
    return schema_document("A fleet", properties, ["schema", "fleet", "agent"], definitions)


class _FleetReader:
    """Makes a `FleetFile` and collects faults."""

    def __init__(self, values: dict[str, Any], places: KeyPlaces) -> None:
        self._values = values
        self.places = places
        self.faults: list[Any] = []

    def read(self) -> FleetFile:
        self._check_top()
        fleet = self._make(FleetTable, self._values.get("fleet", {}), ("fleet",))
        self._check_pauses(("fleet",), fleet.restart)
        tables = self._values.get("agent", {})
        if not isinstance(tables, dict) or not tables:
            self._fault(("agent",), "expected a table for each agent, such as [agent.NAME]")
            tables = {}
        agents = {name: self._make(MemberTable, table, ("agent", name)) for name, table in tables.items()}
        for name, table in agents.items():
            self._check_after(name, table, agents)
            self._check_pauses(("agent", name), table.restart)
            if table.host and (fault := fault_of_host(table.host)):
                self._fault(("agent", name, "host"), fault)
        if not self.faults:
            self._check_circles(agents)
        return FleetFile(fleet, agents, self.places)

    def _fault(self, key: KeyPath, problem: str, near: str = "") -> None:
        self.faults.append(self.places.fault(key, problem, near))

    def _check_top(self) -> None:
        known = ("schema", "fleet", "agent")
        for key in self._values:
            if key not in known:
                self._fault((key,), "unknown key in a fleet file", suggestion(key, known))
        fault = fault_of_schema(self._values)
        if fault:
            self._fault(("schema",), fault)
        if "fleet" not in self._values:
            self._fault(("fleet",), "is missing: a fleet file has a table [fleet], which may be empty")

    def _make(self, cls: type[_T], values: Any, key: KeyPath) -> _T:
        problems = check_settings(cls, values)
        for problem in problems:
            self._fault((*key, *problem.path), problem.text, problem.suggestion)
        return codecs.convert({} if problems else values, cls)

    def _check_pauses(self, key: KeyPath, restart: ProcessRestart | None) -> None:
        fault = fault_of_pauses(restart.pause_s, restart.pause_max_s) if restart is not None else ""
        if fault:
            self._fault((*key, "restart", "pause_max_s"), fault)

    def _check_after(self, name: str, table: MemberTable, agents: Mapping[str, MemberTable]) -> None:
        for index, other in enumerate(table.after):
            key = ("agent", name, "after", index)
            if other == name:
                self._fault(key, "an agent cannot wait for itself")
            elif other not in agents:
                self._fault(key, f"there is no agent {other!r} in this fleet", suggestion(other, agents))

    def _check_circles(self, agents: Mapping[str, MemberTable]) -> None:
        """Takes away the agents that wait for none, over and over; those that are left wait in a circle."""
        waiting = {name: list(table.after) for name, table in agents.items()}
        while free := [name for name, after in waiting.items() if not after]:
            waiting = {
                name: [other for other in after if other not in free]
                for name, after in waiting.items()
                if name not in free
            }
        if waiting:
            first = next(iter(waiting))
            circle = " and ".join(waiting)
            self._fault(("agent", first, "after"), f"{circle} would wait for each other for ever")
