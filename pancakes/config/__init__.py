"""The configuration of an agent: read from TOML, checked as a whole, given out as frozen structures."""

from pancakes.address import Address, parse_address
from pancakes.config.model import (
    DEFAULT_SERVICES,
    SCHEMA,
    AgentConfig,
    ChannelConfig,
    ClockConfig,
    Config,
    DeviceConfig,
    ServiceConfig,
    TaskConfig,
)
from pancakes.config.plugin_check import check_plugins
from pancakes.config.reader import load, parse

__all__ = [
    "DEFAULT_SERVICES",
    "SCHEMA",
    "Address",
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
]
