"""The configuration of an agent: read from TOML, checked as a whole, given as frozen structures."""

from pancakes.config.checks import check_plugins
from pancakes.config.reader import load, parse, read_task
from pancakes.config.tables import (
    DEFAULT_SERVICES,
    SCHEMA,
    AccessConfig,
    AgentConfig,
    ChannelConfig,
    ClockConfig,
    Config,
    DeviceConfig,
    FilterConfig,
    ServiceConfig,
    TaskConfig,
)
from pancakes.mesh.address import Address, parse_address

__all__ = [
    "AccessConfig",
    "Address",
    "AgentConfig",
    "ChannelConfig",
    "ClockConfig",
    "Config",
    "DEFAULT_SERVICES",
    "DeviceConfig",
    "FilterConfig",
    "SCHEMA",
    "ServiceConfig",
    "TaskConfig",
    "check_plugins",
    "load",
    "parse",
    "parse_address",
    "read_task",
]
