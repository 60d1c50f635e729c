"""What a configuration comes to: all keys with their values, defaults among them, and where each was said."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import msgspec
from msgspec.structs import asdict

from pancakes.errors import PluginError
from pancakes.runtime.config.tables import SCHEMA, AccessConfig, Config, DeviceConfig
from pancakes.runtime.foundation.arrays import without_arrays
from pancakes.runtime.plugins import Plugins
from pancakes.settings import SettingsError, make_settings, plain_settings

DEFAULT: Final = "default"
"""Where a value comes from that neither the file nor `--set` gives."""


def effective(config: Config, plugins: Plugins) -> dict[str, Any]:
    """Returns all keys of a configuration as plain values, as its file could have them.

    What has no value, as TOML has none for it, is None. Of a plug-in that cannot be imported, only those settings are
    there that were given.

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
        "service": {
            name: _part(service, "pancakes.services", service.type, plugins)
            for name, service in config.services.items()
        },
        "task": {name: _part(task, "pancakes.tasks", task.type, plugins) for name, task in config.tasks.items()},
    }


def origin(config: Config, keys: tuple[str, ...]) -> str:
    """Returns where the value of a key comes from: `agent1.toml:12`, `--set ...`, or `DEFAULT`."""
    return config.places.where(*keys) if config.places.has(*keys) else DEFAULT


def _part(part: Any, group: str, type_name: str, plugins: Plugins) -> dict[str, Any]:
    plain: dict[str, Any] = msgspec.to_builtins(part)
    del plain["name"]
    plain["settings"] = _settings(part.settings, group, type_name, plugins)
    return plain


def _device(device: DeviceConfig, plain: dict[str, Any], plugins: Plugins) -> dict[str, Any]:
    from pancakes.bodies.devices.driver import Actuator

    try:
        driver = plugins.get("pancakes.drivers", device.driver)
    except PluginError:
        return plain
    if not issubclass(driver, Actuator):
        del plain["hold_after_s"]  # which is for actuators only, and may not be said of others
    return plain


def _settings(given: Mapping[str, Any], group: str, type_name: str, plugins: Plugins) -> dict[str, Any]:
    try:
        settings = make_settings(plugins.get(group, type_name).Settings, given)
    except (PluginError, SettingsError, AttributeError):
        return dict(given)
    plain: dict[str, Any] = without_arrays(plain_settings(settings))  # TOML has no arrays but lists
    return plain
