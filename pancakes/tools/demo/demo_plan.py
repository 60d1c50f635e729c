"""How a demo's agents are configured for one run: their own files, and what a launcher changes of them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pancakes.errors import PancakesError
from pancakes.runtime.config import Config, load
from pancakes.runtime.foundation.toml_values import toml_values
from pancakes.runtime.plugins import Plugins
from pancakes.tools.demo.demo import Demo
from pancakes.tools.launch.overrides import whose
from pancakes.tools.launch.ports import Claim, claim_ports
from pancakes.tools.launch.within_machine import within_machine

LAUNCHER = "launcher"


@dataclass(frozen=True, slots=True)
class DemoPlan:
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
        claim: what keeps other demos from the ports of this one, where they are those of the files.
    """

    demo: Demo
    out: Path
    seed: int
    speed: float
    duration_s: float
    sets: Mapping[str, tuple[str, ...]]
    files: Mapping[str, Path]
    configs: Mapping[str, Config]
    claim: Claim | None

    def peers(self, within_machine: bool) -> tuple[str, ...]:
        """Returns an address of each agent: the one within its machine, or else another."""
        return tuple(config.agent.addresses[0 if within_machine else -1] for config in self.configs.values())

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
    demo: Demo,
    folder: Path,
    out: Path,
    seed: int,
    speed: float,
    duration_s: float,
    extra: tuple[str, ...],
    live: bool,
    plugins: Plugins | None = None,
    local: bool = False,
) -> DemoPlan:
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
        plugins: where drivers and tasks come from, None for what is installed. What they ask of the configurations
            is checked here, before anything starts.
        local: whether the agents of a live demo speak within this machine alone, and take no TCP port.

    Raises:
        PancakesError: a file is missing or wrong.
    """
    files = {agent: folder / f"{agent}.toml" for agent in demo.agents}
    # A fleet of its own: two demos on one machine, or a demo beside a real robot, must not become neighbours.
    fleet = f"{demo.name}-{os.getpid()}" if live else demo.name
    sets: dict[str, list[str]] = {}
    for agent in demo.agents:
        sets[agent] = [
            f'agent.fleet="{fleet}"',
            f"agent.seed={seed}",
            f'agent.state_dir="{out / "state" / agent}"',
            f"clock.speed={speed!r}",
            "clock.hold=true",
            "agent.birth_wait_s=0",  # a fleet of its own, and each disk empty: there is no agent that could know more
            "service.log.settings.console=false",
        ]
        if live:
            # In virtual time `events.jsonl` tells all that these would.
            sets[agent].append(f'service.log.settings.file="{out / "logs" / (agent + ".jsonl")}"')
    for task, name in demo.records.items():
        sets[demo.agents[0]].append(f'task.{task}.settings.path="{out / name}"')
    for agent, changes in (demo.arrange(out, live) if demo.arrange is not None else {}).items():
        sets[agent].extend(changes)
    for one in extra:
        agents, change = whose(one, demo.agents)
        for agent in agents:
            sets[agent].append(change)
    plugins = plugins or Plugins()
    claim, elsewhere = _places(files, fleet, local) if live else (None, {})
    for agent, changes in elsewhere.items():
        sets[agent].extend(changes)
    try:
        configs = {agent: load(str(files[agent]), sets[agent], plugins) for agent in demo.agents}
    except PancakesError:
        if claim is not None:
            claim.release()
        raise
    frozen = {agent: tuple(changes) for agent, changes in sets.items()}
    return DemoPlan(demo, out, seed, speed, duration_s, frozen, files, configs, claim)


def _places(files: Mapping[str, Path], fleet: str, local: bool) -> tuple[Claim | None, Mapping[str, list[str]]]:
    """Returns what keeps other demos from the ports of a live one, and what is to be set where it has others."""
    try:
        tables = {agent: toml_values(path.read_text(encoding="utf-8")) for agent, path in files.items()}
    except (OSError, ValueError):
        return None, {}  # whatever is wrong with it, reading it as a configuration says so better
    if not local:
        return claim_ports(tables)
    claim, elsewhere = claim_ports(tables, ("udp",))
    within = within_machine(tables, dict.fromkeys(files, fleet))
    return claim, {agent: [*elsewhere.get(agent, ()), *within.get(agent, ())] for agent in files}


def find_configs(demo: Demo, given: Path | None = None) -> Path:
    """Returns the folder with the configurations of a demo.

    Args:
        demo: the demo.
        given: the folder that was named on the command line; None: the one that comes with the demo.

    Raises:
        PancakesError: there is no such folder.
    """
    folder = demo.configs if given is None else given
    if not folder.is_dir():
        raise PancakesError(
            f"the configurations of the demo {demo.name!r} are not in {folder}: say where they are with --configs"
        )
    return folder
