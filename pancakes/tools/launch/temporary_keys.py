"""Keys for one run of a fleet: an authority in a temporary folder that is removed at the end of the run."""

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
    """Make keys for the agents of a run that speak to other machines, and remove them at its end.

    A fleet of which an agent has keys already gets no others: they would not believe each other. An agent that its file
    calls `insecure` gets none.

    Args:
        configs: the agents' configurations, by name.
        elsewhere: the agents that run on other hosts, and whether each has keys there.

    Yields:
        The folder with the keys of each agent that gets some.

    Raises:
        PancakesError: the library that makes keys is not installed.
    """
    wanting = _wanting(configs, elsewhere)
    if not wanting:
        yield {}
        return
    with needing_extra("no keys can be made for this run (without --local)"):
        from pancakes.security.authority import Authority
    with tempfile.TemporaryDirectory(prefix="pancakes-keys-") as directory:
        authorities: dict[str, Authority] = {}
        found: dict[str, Path] = {}
        for name in wanting:
            agent = configs[name].agent
            there = Path(directory) / agent.fleet
            if (authority := authorities.get(agent.fleet)) is None:
                authority = authorities[agent.fleet] = Authority.founded(agent.fleet, there / "authority")
                authority.allow(AccessRule((EVERY,), (EVERY,)))  # all of them run for the person who launches them
            folder = there / "keys" / name
            if agent.role == "client":
                authority.enrol_with_key("operator", name.partition(".")[0]).write(folder)
            else:
                authority.enrol_with_key(agent.role, name).write(folder)
            found[name] = folder
        yield found


def set_keys(folder: Path | None) -> tuple[str, ...]:
    """Return what is to be set in an agent's file so that it has the keys of a folder, as `--set` takes it."""
    return (f"service.network.settings.keys={value_text(str(folder))}",) if folder is not None else ()


def _wanting(configs: Mapping[str, Config], elsewhere: Mapping[str, bool]) -> list[str]:
    """Return the agents that are to get keys."""
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
    """Return whether an agent, or a driver of it, is to connect by a way that is encrypted if there are keys."""
    devices = (value for device in config.devices.values() for value in device.settings.values())
    tasks = (value for task in config.tasks.values() for value in task.settings.values())
    return bool(keyed_addresses(config.agent, plugins)) or any(
        isinstance(value, str) and value.startswith(f"{TCP}://") for value in (*devices, *tasks)
    )
