"""Keys for one run of a fleet on this machine: an authority that is there for the run alone."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pancakes.errors import needing_extra
from pancakes.mesh.security.key_folders import keys_of_agent
from pancakes.mesh.security.rules import EVERY, AccessRule
from pancakes.runtime.config import Config
from pancakes.runtime.config.toml_text import value_text
from pancakes.runtime.plugins import Plugins
from pancakes.runtime.transport_settings import TCP, keyed_addresses


@contextmanager
def keys_of_run(configs: Mapping[str, Config]) -> Iterator[Mapping[str, tuple[str, ...]]]:
    """Makes keys for the agents of a run that speak to other machines, and removes them at its end.

    A fleet of which an agent has keys already gets no others: they would not believe each other. An agent that its file
    calls `insecure` gets none.

    Args:
        configs: the agents' configurations, by name.

    Yields:
        What is to be set in each agent's file, as `--set` takes it.

    Raises:
        PancakesError: the library that makes keys is not installed.
    """
    wanting = _wanting(configs)
    if not wanting:
        yield dict.fromkeys(configs, ())
        return
    with needing_extra("no keys can be made for this run (without --local)"):
        from pancakes.mesh.security.fleet_office import FleetOffice
    with tempfile.TemporaryDirectory(prefix="pancakes-keys-") as directory:
        offices: dict[str, FleetOffice] = {}
        found: dict[str, tuple[str, ...]] = dict.fromkeys(configs, ())
        for name in wanting:
            agent = configs[name].agent
            there = Path(directory) / agent.fleet
            if (office := offices.get(agent.fleet)) is None:
                office = offices[agent.fleet] = FleetOffice.founded(agent.fleet, there / "office")
                office.allow(AccessRule((EVERY,), (EVERY,)))  # all of them run for the person who launches them
            folder = there / "keys" / name
            if agent.role == "client":
                office.enrol_with_key("operator", name.partition(".")[0]).write(folder)
            else:
                office.enrol_with_key(agent.role, name).write(folder)
            found[name] = (f"service.network.settings.keys={value_text(str(folder))}",)
        yield found


def _wanting(configs: Mapping[str, Config]) -> list[str]:
    """Returns the agents that are to get keys."""
    open_ = {name: config for name, config in configs.items() if not _network(config).get("insecure")}
    plugins = Plugins()
    if not any(_is_keyed(config, plugins) for config in open_.values()):
        return []
    have = {config.agent.fleet for config in open_.values() if _has_keys(config)}
    return [name for name, config in open_.items() if config.agent.fleet not in have]


def _network(config: Config) -> Mapping[str, Any]:
    network = config.services.get("network")
    return network.settings if network is not None else {}


def _has_keys(config: Config) -> bool:
    return bool(_network(config).get("keys")) or keys_of_agent(config.agent.fleet, config.agent.name) is not None


def _is_keyed(config: Config, plugins: Plugins) -> bool:
    """Returns whether an agent, or a driver of it, is to connect by a way that is encrypted where there are keys."""
    devices = (value for device in config.devices.values() for value in device.settings.values())
    tasks = (value for task in config.tasks.values() for value in task.settings.values())
    return bool(keyed_addresses(config.agent, plugins)) or any(
        isinstance(value, str) and value.startswith(f"{TCP}://") for value in (*devices, *tasks)
    )
