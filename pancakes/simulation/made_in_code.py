"""Configurations that tests make in code, and the classes that these name."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from msgspec.structs import replace

from pancakes.bodies.devices.driver import Driver
from pancakes.mesh.migration.cost import Cost
from pancakes.runtime.config import Config, DeviceConfig, ServiceConfig, TaskConfig, parse
from pancakes.runtime.foundation import codecs
from pancakes.runtime.plugins import Plugins
from pancakes.service import Service
from pancakes.task import Task

_HEAD = 'schema = 1\n[agent]\nname = "{name}"\n'
_QUIET = ServiceConfig("log", "log", {"console": False})


@dataclass(frozen=True)
class AgentParts:
    """A configuration, and the classes that it names: what `parts` makes of its arguments."""

    config: Config
    classes: dict[str, type] = field(default_factory=dict)


def config_of(
    name: str,
    text: str = "",
    *,
    tasks: Mapping[str, Any] | None = None,
    devices: Mapping[str, Any] | None = None,
    services: Mapping[str, Any] | None = None,
    **agent: Any,
) -> Config:
    """Returns the configuration of an agent in a test; see `FleetInTest.start` for the arguments."""
    return parts(name, text, tasks, devices, services, agent).config


def parts(
    name: str,
    text: str,
    tasks: Mapping[str, Any] | None,
    devices: Mapping[str, Any] | None,
    services: Mapping[str, Any] | None,
    agent: Mapping[str, Any],
) -> AgentParts:
    """Returns a configuration made of text and of classes; see `FleetInTest.start` for the arguments."""
    config = parse(text if "[agent]" in text else _HEAD.format(name=name) + text, f"{name}.toml")
    classes: dict[str, type] = {}

    def tables(given: Mapping[str, Any] | None, kind: Any, key: str) -> dict[str, Any]:
        made = {}
        for table, what in (given or {}).items():
            fields = {"type": what} if isinstance(what, (type, str)) else dict(what)
            cls = fields.pop("type", "" if kind is ServiceConfig else None)
            if isinstance(cls, type):
                classes[f"test.{cls.__qualname__.rpartition('.')[2]}"] = cls
                cls = f"test.{cls.__qualname__.rpartition('.')[2]}"
            made[table] = codecs.convert({"name": table, key: cls or table, **fields}, kind)
        return made

    clock = {key: agent[key] for key in ("speed", "hold", "join_s") if key in agent}
    others = {key: value for key, value in agent.items() if key not in clock}
    if isinstance(at := others.get("listen"), str):
        others["listen"] = (at,) if at else ()
    others.setdefault("folders", config.agent.folders or (tempfile.gettempdir(),))  # where pytest's tmp_path lies
    config = replace(
        config,
        agent=replace(config.agent, **{"seed": 1 if config.agent.seed is None else config.agent.seed, **others}),
        clock=replace(config.clock, **clock),
        tasks={**config.tasks, **tables(tasks, TaskConfig, "type")},
        devices={**config.devices, **tables(devices, DeviceConfig, "driver")},
        services={**config.services, **tables(services, ServiceConfig, "type")},
    )
    return AgentParts(config if "log" in (services or {}) else silent(config), classes)


def silent(config: Config) -> Config:
    """Returns a configuration whose Log Service writes nothing, unless it says itself what that should do."""
    if config.services["log"].settings:
        return config
    return replace(config, services={**config.services, "log": _QUIET})


def registered(classes: Mapping[str, type], extra: Mapping[tuple[str, str], Any] | None = None) -> Plugins:
    """Returns plug-ins that know classes under names of a test's own, besides all that is installed.

    Args:
        classes: tasks, services, drivers and cost functions, by the name that a configuration uses.
        extra: anything else, by (entry point group, name).
    """
    found: dict[tuple[str, str], Any] = {(_group_of(cls), name): cls for name, cls in classes.items()}
    return Plugins({**found, **(extra or {})})


def _group_of(cls: type) -> str:
    for base, group in ((Task, "tasks"), (Service, "services"), (Driver, "drivers"), (Cost, "costs")):
        if issubclass(cls, base):
            return f"pancakes.{group}"
    raise TypeError(f"{cls.__qualname__} is no task, service, driver or cost function")
