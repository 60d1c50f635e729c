"""The configuration of an agent: read from TOML, checked as a whole, given out as frozen structures."""

from pancakes.mesh.address import Address, parse_address
from pancakes.runtime.config.config_reader import load, parse, read_task
from pancakes.runtime.config.plugin_check import check_plugins
from pancakes.runtime.config.tables import (
    DEFAULT_SERVICES,
    SCHEMA,
    AccessConfig,
    AgentConfig,
    ChannelConfig,
    ClockConfig,
    Config,
    DeviceConfig,
    ServiceConfig,
    TaskConfig,
)

__all__ = [
    "DEFAULT_SERVICES",
    "SCHEMA",
    "Address",
    "AccessConfig",
    "AgentConfig",
    "ChannelConfig",
    "ClockConfig",
    "Config",
    "DeviceConfig",
    "ServiceConfig",
    "TaskConfig",
    "check_plugins",
    "load",
    "parse",
    "parse_address",
    "read_task",
]
