"""The effective configuration: all keys with values and origins, and tasks that were created at run time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

import msgspec
from msgspec.structs import asdict

from pancakes.config.tables import SCHEMA, AccessConfig, Config, DeviceConfig
from pancakes.durable.record import Record
from pancakes.durable.register import Wanted
from pancakes.durable.snapshot import Snapshot
from pancakes.errors import MigrationError, PluginError
from pancakes.settings import SettingsError, make_settings, plain_settings
from pancakes.util.arrays import without_arrays
from pancakes.util.plugins import Plugins


def created_tables(agent: str, records: Iterable[Record]) -> dict[str, dict[str, Any]]:
    """Return the tables `[task.NAME]` of the tasks that were created on an agent and still exist, by name.

    They include tasks in its file that have records.

    Args:
        agent: the agent's name.
        records: its records.
    """
    tables: dict[str, dict[str, Any]] = {}
    for record in sorted(records, key=lambda it: it.task_id):
        here = record.owned and record.task_id.birthplace == agent
        if here and record.snapshot:
            try:
                snapshot = Snapshot.decode(record.snapshot)
            except MigrationError:
                continue  # its service has reported that
            tables[record.task_id.name] = table_of(snapshot, record.wanted is Wanted.RUNNING)
    return tables


def table_of(snapshot: Snapshot, start: bool) -> dict[str, Any]:
    """Return the table `[task.NAME]` of a task as it is now; `start`: whether it runs from the start.

    It has the present settings and the present rate. A key without a value is None.
    """
    return {
        "type": snapshot.type,
        "service": snapshot.service,
        "start": start,
        "rate_hz": _rate_hz(snapshot),
        "settings": without_arrays(snapshot.settings),
        "restart": dict(snapshot.restart),
        "durability": snapshot.durability,
        "migrate": snapshot.migrate,
        "guard": snapshot.guard,
    }


def _rate_hz(snapshot: Snapshot) -> float | None:
    """Return the rate of its first timer; None: that of its class."""
    period_s = next(iter(snapshot.periods_s.values()), None)
    if period_s is None or not period_s > 0.0:
        return snapshot.rate_hz
    return round(1.0 / period_s, 9)


DEFAULT: Final = "default"
"""The origin of a value that neither the file nor `--set` gives."""


def effective(config: Config, plugins: Plugins) -> dict[str, Any]:
    """Return all keys of a configuration as plain values, in the form of a file.

    A key without a value is None, because TOML has no such value. For a plug-in that cannot be imported, only the given
    settings are included.

    Args:
        config: the configuration.
        plugins: where the defaults of settings come from.
    """
    return {
        "schema": SCHEMA,
        "agent": asdict(config.agent),
        **({"access": msgspec.to_builtins(config.access)} if config.access != AccessConfig() else {}),
        "clock": asdict(config.clock),
        **({"record": asdict(config.record)} if config.record is not None else {}),
        "channel": {name: {} for name in config.channels},
        "device": {
            name: _device(device, _part(device, "pancakes.drivers", device.driver, plugins), plugins)
            for name, device in config.devices.items()
        },
        **({"filter": _filters(config, plugins)} if config.filters else {}),
        "service": {
            name: _part(service, "pancakes.services", service.type, plugins)
            for name, service in config.services.items()
        },
        "task": {name: _part(task, "pancakes.tasks", task.type, plugins) for name, task in config.tasks.items()},
    }


def origin(config: Config, keys: tuple[str, ...]) -> str:
    """Return where the value of a key comes from: `agent1.toml:12`, `--set ...`, or `DEFAULT`."""
    return config.places.where(*keys) if config.places.has(*keys) else DEFAULT


def _part(part: Any, group: str, type_name: str, plugins: Plugins) -> dict[str, Any]:
    plain: dict[str, Any] = msgspec.to_builtins(part)
    del plain["name"]
    plain["settings"] = _settings(part.settings, group, type_name, plugins)
    return plain


def _filters(config: Config, plugins: Plugins) -> dict[str, Any]:
    return {name: _part(filter_, "pancakes.filters", filter_.type, plugins) for name, filter_ in config.filters.items()}


def _device(device: DeviceConfig, plain: dict[str, Any], plugins: Plugins) -> dict[str, Any]:
    from pancakes.devices.driver import Actuator

    try:
        driver = plugins.get("pancakes.drivers", device.driver)
    except PluginError:
        return plain
    if not issubclass(driver, Actuator):
        for key in ("hold_after_mission_s", "drive_stop_s"):  # they are only for actuators, and not allowed for others
            del plain[key]
    return plain


def _settings(given: Mapping[str, Any], group: str, type_name: str, plugins: Plugins) -> dict[str, Any]:
    try:
        settings = make_settings(plugins.get(group, type_name).Settings, given)
    except (PluginError, SettingsError, AttributeError):
        return dict(given)
    plain: dict[str, Any] = without_arrays(plain_settings(settings))  # TOML has no arrays but lists
    return plain
