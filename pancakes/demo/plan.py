"""How a demo's agents are configured for one run: their own files, and what a launcher changes of them."""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pancakes.config import Config, load
from pancakes.demo.demo import Demo
from pancakes.errors import PancakesError

ADDRESS = re.compile(r"^tcp://([^/]+):(\d+)$")
LAUNCHER = "launcher"


@dataclass(frozen=True, slots=True)
class Plan:
    """One run of a demo, before it starts.

    Attributes:
        demo: the demo.
        out: the folder that everything goes to.
        seed: the run's seed.
        speed: mission seconds for each second of host time.
        duration_s: how long the mission lasts.
        sets: what is changed of each agent's file, as `--set` takes it.
        files: each agent's file.
        configs: the configurations that follow from that.
    """

    demo: Demo
    out: Path
    seed: int
    speed: float
    duration_s: float
    sets: Mapping[str, tuple[str, ...]]
    files: Mapping[str, Path]
    configs: Mapping[str, Config]

    def peers(self) -> tuple[str, ...]:
        """Returns the addresses of all agents."""
        return tuple(config.agent.listen for config in self.configs.values())

    def buses(self) -> tuple[str, ...]:
        """Returns the addresses of the hardware buses, which no fault of the network concerns."""
        found = {
            str(device.settings["world"]): None
            for config in self.configs.values()
            for device in config.devices.values()
            if "world" in device.settings
        }
        return tuple(found)


def make_plan(
    demo: Demo, folder: Path, out: Path, seed: int, speed: float, duration_s: float, extra: tuple[str, ...], live: bool
) -> Plan:
    """Works out one run.

    Args:
        demo: the demo.
        folder: where the agents' files lie.
        out: where everything goes; agents get a fresh state directory below it.
        seed: the run's seed.
        speed: mission seconds for each second of host time.
        duration_s: how long the mission lasts.
        extra: `AGENT:table.key=value` or `table.key=value` (all agents) from the command line.
        live: whether ports are really taken; ports in use are then replaced by free ones.

    Raises:
        PancakesError: a file is missing or wrong.
    """
    files = {agent: folder / f"{agent}.toml" for agent in demo.agents}
    sets: dict[str, list[str]] = {}
    for agent in demo.agents:
        sets[agent] = [
            f"agent.seed={seed}",
            f'agent.state_dir="{out / "state" / agent}"',
            f"clock.speed={speed!r}",
            "clock.hold=true",
            "service.log.settings.console=false",
        ]
        if live:
            # In virtual time `events.jsonl` tells all that these would.
            sets[agent].append(f'service.log.settings.file="{out / "logs" / (agent + ".jsonl")}"')
    sets[demo.agents[0]].append(f'task.Trajectory.settings.path="{out / "trajectory.csv"}"')
    for one in extra:
        agent, colon, change = one.partition(":")
        if colon and agent in sets:
            sets[agent].append(change)
        else:
            for changes in sets.values():
                changes.append(one)
    if live:
        for agent, moved in _move_ports(files).items():
            sets[agent].extend(moved)
    configs = {agent: load(str(files[agent]), sets=sets[agent]) for agent in demo.agents}
    return Plan(
        demo, out, seed, speed, duration_s, {agent: tuple(changes) for agent, changes in sets.items()}, files, configs
    )


def _move_ports(files: Mapping[str, Path]) -> dict[str, list[str]]:
    """Replaces the ports of a fleet, where one of them is taken on this machine."""
    import tomllib

    tables: dict[str, Any] = {}
    for agent, path in files.items():
        try:
            tables[agent] = tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}  # whatever is wrong with it, reading it as a configuration says so better
    addresses = {text: None for table in tables.values() for _, text in _strings(table, ())}
    places = [(match[1], int(match[2])) for text in addresses if (match := ADDRESS.match(text))]
    if all(_is_free(host, port) for host, port in places):
        return {}
    taken = [_free_port(host) for host, _ in places]
    free = {place: port for place, (_, port) in zip(places, taken, strict=True)}
    for held, _ in taken:
        held.close()
    return {agent: _moved(table, free) for agent, table in tables.items()}


def _moved(table: Any, free: Mapping[tuple[str, int], int]) -> list[str]:
    """Returns what is to be set in one agent's file so that its addresses have other ports."""
    changes: list[str] = []
    lists: dict[tuple[str, ...], list[str]] = {}
    for keys, text in _strings(table, ()):
        match = ADDRESS.match(text)
        if match is None:
            continue
        address = f'"tcp://{match[1]}:{free[match[1], int(match[2])]}"'
        if keys[-1] == "*":
            lists.setdefault(keys[:-1], []).append(address)
        else:
            changes.append(f"{'.'.join(keys)}={address}")
    changes.extend(f"{'.'.join(keys)}=[{', '.join(items)}]" for keys, items in lists.items())
    return changes


def _strings(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yields all strings of a table with the keys that lead to them; `*` stands for a place in a list."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _strings(inner, (*path, key))
    elif isinstance(value, list):
        for inner in value:
            yield from _strings(inner, (*path, "*"))
    elif isinstance(value, str):
        yield path, value


def _is_free(host: str, port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError:
            return False
        return True


def _free_port(host: str) -> tuple[socket.socket, int]:
    """Takes a free port; the socket holds it until it is closed, so that no two calls return the same."""
    held = socket.socket()
    held.bind((host, 0))
    return held, held.getsockname()[1]


def find_configs(name: str, given: str) -> Path:
    """Returns the folder with the configurations of a demo.

    Args:
        name: the demo's name.
        given: the folder that was named on the command line; empty: `configs/NAME` here, or beside the package.

    Raises:
        PancakesError: there is no such folder.
    """
    if given:
        places = [Path(given)]
    else:
        places = [Path("configs") / name, Path(__file__).resolve().parents[2] / "configs" / name]
    for place in places:
        if place.is_dir():
            return place
    raise PancakesError(
        f"the configurations of the demo {name!r} are not in {' nor in '.join(map(str, places))}:"
        " say where they are with --configs"
    )
