"""What keeps an agent of a sound configuration from running on this machine, or from being reached there."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from pancakes.errors import ConfigError, Fault

if TYPE_CHECKING:
    from pancakes.runtime.config import Config
    from pancakes.runtime.plugins import Plugins

NOT_HERE: Final = "on this machine it does not start"


def machine_doubts(config: Config, plugins: Plugins) -> list[Fault]:
    """Returns what `pancakes config check` and `pancakes-agent --check` warn of: both say the same.

    The configuration may be for another machine, so none of it is a fault.

    Args:
        config: a sound configuration.
        plugins: where transports come from.
    """
    from pancakes.runtime.config.doubts import doubts_of
    from pancakes.runtime.transport_settings import keys_for, network_settings
    from pancakes.tools.cli.start_doubts import start_doubts

    found = doubts_of(config)
    found += [config.places.fault(key, f"{NOT_HERE}: {why}") for key, why in start_doubts(config)]
    try:
        keys_for(config, network_settings(config), plugins)
    except ConfigError as error:
        found += [fault._replace(problem=f"{NOT_HERE}: {fault.problem}") for fault in error.faults]
    return found
