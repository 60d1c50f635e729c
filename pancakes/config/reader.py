"""Read a configuration: from a TOML file to a `Config`, or report all faults at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from os import PathLike, fspath
from typing import Any, Final, TypeVar

from msgspec.structs import replace

from pancakes.config.checks import check_plugins, check_task, faults_of_rule
from pancakes.config.key_lines import NAMED_TABLES, KeyPath, KeyPlaces
from pancakes.config.tables import (
    DEFAULT_SERVICES,
    AccessConfig,
    AgentConfig,
    ChannelConfig,
    ClockConfig,
    Config,
    DeviceConfig,
    FilterConfig,
    RecordConfig,
    ServiceConfig,
    TaskConfig,
)
from pancakes.config.toml_reader import fault_of_schema, read_values, text_of
from pancakes.devices.health import MissRule
from pancakes.errors import ConfigError, Fault
from pancakes.mesh.address import fault_of_interface, in_fleet, parse_address
from pancakes.migration import TAKE_PART, GuardRule, MigrationRule
from pancakes.packet import CORE_CHANNELS
from pancakes.settings import check_settings, dotted, known_keys, required_keys
from pancakes.supervision.restart import RestartSpec, fault_of_pauses
from pancakes.util import codecs
from pancakes.util.plugins import Plugins
from pancakes.util.text import fault_of_name, nearest_name, suggestion

_T = TypeVar("_T")

_INNER: Final = {"guard": GuardRule, "migrate": MigrationRule, "missed": MissRule, "restart": RestartSpec}
"""The keys that are tables themselves."""


_SHORT: Final = {("guard",): "guard = { copies = 3 }", ("restart",): 'restart = { policy = "always" }'}
"""What to write in the place of a value that is no table."""


def _table_with(key: str | int, keys: Sequence[str]) -> str:
    """Return which of the keys is a table that has this key; empty: none, or several."""
    tables = [name for name, cls in _INNER.items() if name in keys and key in known_keys(cls)]
    return tables[0] if len(tables) == 1 else ""


_TABLES: Final = ("agent", "access", "clock", "record", *NAMED_TABLES)


def load(
    path: str | PathLike[str],
    sets: Sequence[str] = (),
    plugins: Plugins | None = None,
    *,
    must_load: bool = False,
    missing: set[str] | None = None,
) -> Config:
    """Read a configuration file.

    Args:
        path: the file.
        sets: overrides, each as `table.key=value`.
        plugins: where drivers, services and tasks come from. With it, plug-ins and their
            settings are checked too (see `check_plugins`); without it, only the format.
        must_load: whether it is a fault if a plug-in that the file names cannot be imported.
        missing: takes the names of plug-ins that are not installed here, which then are not faults: the configuration
            is for another machine.

    Raises:
        ConfigError: the file cannot be read, or is not valid; it carries every fault.
    """
    where = fspath(path)
    return parse(text_of(where), where, sets, plugins, must_load=must_load, missing=missing)


def parse(
    text: str,
    where: str,
    sets: Sequence[str] = (),
    plugins: Plugins | None = None,
    *,
    must_load: bool = False,
    missing: set[str] | None = None,
) -> Config:
    """Read a configuration from its text; see `load`.

    Args:
        text: the TOML text.
        where: the name of the text in messages.
        sets: overrides, each as `table.key=value`.
        plugins: where drivers, services and tasks come from; None leaves them unchecked.
        must_load: whether it is a fault if a plug-in that the text names cannot be imported.
        missing: see `load`.

    Raises:
        ConfigError: the text is not valid; it carries every fault.
    """
    tables = read_values(text, where, sets)
    values, places, _ = tables
    reader = _ConfigReader(values, places)
    config = reader.config()
    faults = reader.faults
    if plugins is not None:
        faults += check_plugins(config, plugins, must_load, missing)
    faults = tables.with_faults(faults)
    if faults:
        raise ConfigError(places.in_order(faults))
    return config


def read_task(name: str, table: Mapping[str, Any], config: Config, plugins: Plugins) -> TaskConfig:
    """Read the table of a task as if the file of an agent had it.

    Args:
        name: the task's name.
        table: the contents of its table `[task.NAME]`.
        config: the agent's configuration.
        plugins: where tasks and drivers come from.

    Raises:
        ConfigError: the table is not valid; it carries every fault.
    """
    places = KeyPlaces(name, "", {})
    reader = _ConfigReader({"task": {name: dict(table)}}, places)
    task = reader.task(name, config)
    faults = reader.faults + check_task(
        replace(config, tasks={**config.tasks, name: task}, places=places), task, plugins
    )
    if faults:
        raise ConfigError(faults)
    return task


class _ConfigReader:
    """Make a `Config` and collect faults. A faulty key gets its default, so that the rest is checked."""

    def __init__(self, values: dict[str, Any], places: KeyPlaces) -> None:
        self._values = values
        self._places = places
        self.faults: list[Fault] = []

    def config(self) -> Config:
        self._check_top()
        services = self._tables("service", ServiceConfig, {name: {"type": name} for name in DEFAULT_SERVICES})
        agent = self._single("agent", AgentConfig)
        config = Config(
            agent=replace(
                agent,
                listen=tuple(in_fleet(address, agent.fleet) for address in agent.listen),
                peers=tuple(in_fleet(address, agent.fleet) for address in agent.peers),
            ),
            access=self._single("access", AccessConfig),
            clock=self._single("clock", ClockConfig),
            record=self._single("record", RecordConfig) if "record" in self._values else None,
            channels=self._tables("channel", ChannelConfig),
            devices=self._tables("device", DeviceConfig),
            filters=self._tables("filter", FilterConfig),
            services=services,
            tasks=self._tables("task", TaskConfig),
            path=self._places.where(),
            places=self._places,
        )
        self._check_agent(config)
        for table, parts in (("device", config.devices), ("service", config.services), ("task", config.tasks)):
            for name, part in parts.items():
                self._check_restart((table, name, "restart"), part.restart)
        for name in config.channels:
            if name in CORE_CHANNELS:
                self._fault(("channel", name), f"the channel {name!r} is a core one and always there")
        for device in config.devices.values():
            self._check_service(("device", device.name, "service"), device.service, config)
        for filter_ in config.filters.values():
            self._check_filter(filter_, config)
        for task in config.tasks.values():
            self._check_task(task, config)
        return config

    def task(self, name: str, config: Config) -> TaskConfig:
        """Make one task in addition to those of a configuration."""
        task = self._tables("task", TaskConfig)[name]
        self._check_restart(("task", name, "restart"), task.restart)
        self._check_task(task, replace(config, tasks={**config.tasks, name: task}))
        return task

    def _fault(self, key: KeyPath, problem: str, near: str = "") -> None:
        self.faults.append(self._places.fault(key, problem, near))

    def _check_top(self) -> None:
        known = ("schema", *_TABLES)
        for key, value in self._values.items():
            if key not in known:
                near = suggestion(key, known)
                if isinstance(value, (dict, list)):
                    self._fault((key,), "unknown table", near)
                else:
                    self.faults.append(Fault(self._places.where(key), dotted((key,)), "unknown key", near))
        fault = fault_of_schema(self._values)
        if fault:
            self._fault(("schema",), fault)

    def _single(self, table: str, cls: type[_T]) -> _T:
        values = self._values.get(table, {})
        if not isinstance(values, dict):
            self._fault((table,), f"expected a table: [{table}]")
            values = {}
        if table == "agent" and isinstance(at := values.get("listen"), str):
            values = {**values, "listen": [at] if at else []}
        return self._make(cls, values, (table,))

    def _tables(
        self, table: str, cls: type[_T], implied: Mapping[str, Mapping[str, Any]] | None = None
    ) -> dict[str, _T]:
        """Return the tables `[table.NAME]` by name; `implied` has the tables that always exist."""
        implied = implied or {}
        entries = self._values.get(table, {})
        if not isinstance(entries, dict):
            self._fault((table,), f"expected tables with a name each, such as [{table}.NAME]")
            entries = {}
        made = {}
        for name, values in {**{name: {} for name in implied}, **entries}.items():
            key = (table, name)
            if not isinstance(values, dict):
                self._fault(key, f"expected a table with a name, such as [{table}.NAME]")
                continue
            self._check_name(key, name)
            if "name" in values:
                self._fault((*key, "name"), f"unknown key; the name belongs in the head of the table: [{table}.NAME]")
            for required in required_keys(cls):  # type: ignore[arg-type]
                if values.get(required) == "":
                    self._fault((*key, required), "is empty")
            given = {**implied.get(name, {}), **{k: v for k, v in values.items() if k != "name"}, "name": name}
            made[name] = self._make(cls, given, key)
        return made

    def _make(self, cls: type[_T], values: Mapping[str, Any], key: KeyPath) -> _T:
        own = known_keys(cls)  # type: ignore[arg-type]
        bad = set()
        for problem in check_settings(cls, values):
            text, near = problem.text, problem.suggestion
            if text == "unknown key" and len(problem.path) == 1 and (table := _table_with(problem.path[0], own)):
                text, near = f"unknown key; it belongs in the table `{table}`", f"{table}.{problem.path[0]}"
            elif text == "unknown key" and len(problem.path) == 1 and not near and "settings" in own:
                text = f"unknown key; the {key[0]}'s own settings belong in its key `settings`"
            if problem.path in _SHORT and not isinstance(values[str(problem.path[0])], dict):
                text += f": write {_SHORT[problem.path]}"
            if text == "is missing" and len(key) == 2 and self._places.is_set(*key):
                near = self._other_name(str(key[0]), str(key[1]))
            bad.add(problem.path[0] if problem.path else "")
            self._fault((*key, *problem.path), text, near)
        whole = "" not in bad  # else its parts are valid, but do not fit together
        sound = {name: value for name, value in values.items() if whole and name in own and name not in bad}
        return codecs.convert({**dict.fromkeys(required_keys(cls), ""), **sound}, cls)  # type: ignore[arg-type]

    def _other_name(self, table: str, name: str) -> str:
        """Return the table that a `--set` probably meant if it created a new one; empty: none."""
        others = {*self._values.get(table, ()), *(DEFAULT_SERVICES if table == "service" else ())} - {name}
        return suggestion(name, others)

    def _check_name(self, key: KeyPath, name: str, client: bool = False) -> bool:
        fault = fault_of_name(name, client)
        if fault:
            self._fault(key, fault, nearest_name(name))
        return not fault

    def _given(self, key: KeyPath) -> Any:
        """Return the value of a key in the file; None if it is missing."""
        value: Any = self._values
        for part in key:
            value = value.get(part) if isinstance(value, dict) else None
        return value

    def _check_agent(self, config: Config) -> None:
        agent = config.agent
        if isinstance(self._given(("agent", "name")), str):
            self._check_name(("agent", "name"), agent.name, client=agent.role == "client")
        self._check_name(("agent", "fleet"), agent.fleet)
        for index, address in enumerate(agent.listen):
            self._check_listen(config, index, address)
        for index, peer in enumerate(agent.peers):
            key = ("agent", "peers", index)
            try:
                if parse_address(peer).any_port:
                    self._fault(key, f"{peer!r} has the port 0, at which no agent can be reached")
                if fault := fault_of_interface(peer):
                    self._fault(key, fault)
            except ValueError as error:
                self._fault(key, str(error))
            if peer in agent.peers[:index]:
                self._fault(key, f"{peer!r} is in the list twice")

    def _check_listen(self, config: Config, index: int, text: str) -> None:
        key: KeyPath = ("agent", "listen")
        if isinstance(self._given(key), list):
            key = (*key, index)
        if text in config.agent.listen[:index]:
            self._fault(key, f"{text!r} is in the list twice")
        try:
            if fault := fault_of_interface(text):
                self._fault(key, fault)
        except ValueError as error:
            self._fault(key, str(error))

    def _check_restart(self, key: KeyPath, spec: RestartSpec) -> None:
        if spec.at_most < 0:
            self._fault((*key, "at_most"), f"expected an integer >= 0, not {spec.at_most}")
        if not 0 < spec.within_s < inf:
            self._fault((*key, "within_s"), f"expected a number of seconds > 0, not {spec.within_s:g}")
        for name in ("pause_s", "pause_max_s", "again_s"):
            value = getattr(spec, name)
            if not 0 <= value < inf:
                self._fault((*key, name), f"expected a number of seconds >= 0, not {value:g}")
        fault = fault_of_pauses(spec.pause_s, spec.pause_max_s)
        if fault:
            self._fault((*key, "pause_max_s"), fault)

    def _check_service(self, key: KeyPath, service: str, config: Config) -> None:
        if service not in config.services:
            self._fault(key, f"there is no service {service!r}", suggestion(service, config.services))

    def _check_filter(self, filter_: FilterConfig, config: Config) -> None:
        key = ("filter", filter_.name)
        if not filter_.name.isidentifier():  # it is a key of the device's settings: filters.NAME.KEY
            self._fault(key, f"{filter_.name!r} is no name for a filter: use letters, digits and _, no digit first")
        if filter_.device and filter_.device not in config.devices:
            near = suggestion(filter_.device, config.devices)
            self._fault((*key, "device"), f"there is no device {filter_.device!r} here", near)

    def _check_task(self, task: TaskConfig, config: Config) -> None:
        key = ("task", task.name)
        self._check_service((*key, "service"), task.service, config)
        device = config.devices.get(task.name)
        if device is not None and device.service == task.service:
            self._fault(key, f"has the same address as [device.{task.name}]: give one of them another name")
        self._check_guard(task, config)
        if task.migrate:
            for name, problem, near in faults_of_rule(task.migrate, task.name, config.tasks):
                path = name.split(".", 1) if name else ()
                self._fault((*key, "migrate", *path), problem, near)
            if task.migrate.allocated and config.services["network"].settings.get("allocation") is None:
                self._fault((*key, "migrate", "when"), f"this agent takes no part in the allocation: {TAKE_PART}")

    def _check_guard(self, task: TaskConfig, config: Config) -> None:
        key = ("task", task.name, "guard")
        rule = task.guard
        if rule is None:
            return
        if task.service in ("device", "network", "log"):
            self._fault(key, f"is for tasks that can migrate, not for the service {task.service}")
        others = [name for name in rule.guardians if name != config.agent.name]
        if len(others) != len(set(rule.guardians)) or len(others) != len(rule.guardians):
            self._fault((*key, "guardians"), "expected the names of other agents, each once")
        elif len(others) >= rule.copies:
            text = f"names {len(others)} agents, but besides this one there are {rule.copies - 1} guardians"
            self._fault((*key, "guardians"), text)
