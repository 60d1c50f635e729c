"""Make keys for one run of a fleet: an authority in a temporary folder that is removed at the end of the run."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from pancakes.agent.transport_settings import TCP, keyed_addresses
from pancakes.config import Config
from pancakes.config.toml_writer import value_text
from pancakes.errors import needing_extra
from pancakes.security.key_store import keys_of_agent
from pancakes.security.roster import EVERY, AccessRule
from pancakes.util.plugins import Plugins

_NONE: Final[Mapping[str, bool]] = {}


@contextmanager
def keys_of_run(configs: Mapping[str, Config], elsewhere: Mapping[str, bool] = _NONE) -> Iterator[Mapping[str, Path]]:
    """Make keys for the agents of a run that connect to other machines, and remove them at its end.

    A fleet in which an agent already has keys gets no temporary ones: the agents would not trust each other. An agent
    whose file says `insecure` gets none.

    Args:
        configs: the agents' configurations, by name.
        elsewhere: the agents that run on other hosts, and whether each has keys there.

    Yields:
        The folder with the keys of each agent that gets keys.

    Raises:
        PancakesError: the library that makes keys is not installed.
    """
    wanting = without_keys(configs, elsewhere)
    if not wanting:
        yield {}
        return
    with needing_extra("keys for this run cannot be made (--local needs none)"):
        from pancakes.security.authority import Authority
    with tempfile.TemporaryDirectory(prefix="pancakes-keys-") as directory:
        authorities: dict[str, Authority] = {}
        found: dict[str, Path] = {}
        for name in wanting:
            agent = configs[name].agent
            fleet_folder = Path(directory) / agent.fleet
            if (authority := authorities.get(agent.fleet)) is None:
                authority = authorities[agent.fleet] = Authority.founded(agent.fleet, fleet_folder / "authority")
                authority.allow(AccessRule((EVERY,), (EVERY,)))  # all of them run for the person who launches them
            folder = fleet_folder / "keys" / name
            if agent.role == "client":
                authority.enrol_with_key("operator", name.partition(".")[0]).write(folder)
            else:
                authority.enrol_with_key(agent.role, name).write(folder)
            found[name] = folder
        yield found


def set_keys(folder: Path | None) -> tuple[str, ...]:
    """Return the `--set` changes that give an agent the keys of a folder."""
    return (f"service.network.settings.keys={value_text(str(folder))}",) if folder is not None else ()


def without_keys(configs: Mapping[str, Config], elsewhere: Mapping[str, bool] = _NONE) -> list[str]:
    """Return the agents that need keys for this run; see `keys_of_run`."""
    open_ = {name: config for name, config in configs.items() if not _network(config).get("insecure")}
    plugins = Plugins()
    if not any(_is_keyed(config, plugins) for config in open_.values()):
        return []
    have = {config.agent.fleet for name, config in open_.items() if _has_keys(config, elsewhere.get(name))}
    return [name for name, config in open_.items() if config.agent.fleet not in have]


def _network(config: Config) -> Mapping[str, Any]:
    network = config.services.get("network")
    return network.settings if network is not None else {}


def _has_keys(config: Config, there: bool | None) -> bool:
    if _network(config).get("keys") or there is not None:
        return bool(_network(config).get("keys") or there)
    return keys_of_agent(config.agent.fleet, config.agent.name) is not None


def _is_keyed(config: Config, plugins: Plugins) -> bool:
    """Return whether an agent, or a driver or task of it, uses a transport that is encrypted if the agent has keys."""
    devices = (value for device in config.devices.values() for value in device.settings.values())
    tasks = (value for task in config.tasks.values() for value in task.settings.values())
    return bool(keyed_addresses(config.agent, plugins)) or any(
        isinstance(value, str) and value.startswith(f"{TCP}://") for value in (*devices, *tasks)
    )
