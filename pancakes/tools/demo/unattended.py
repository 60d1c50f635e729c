"""One mission in virtual time with nothing but its results: no view, no page, no picture."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pancakes.runtime.plugins import Plugins
from pancakes.tools.demo.conductor import Mission
from pancakes.tools.demo.demo import Comparison, Demo, Run
from pancakes.tools.demo.demo_plan import DemoPlan, find_configs, make_plan
from pancakes.tools.demo.launcher import (
    RECORDING,
    NetworkFaults,
    fresh,
    judge,
    run_of,
    run_virtual,
    write_results,
)


@dataclass(frozen=True, slots=True)
class MissionWishes:
    """What is asked for besides a seed; it travels to other processes.

    Attributes:
        demo: the demo's name.
        duration_s: mission seconds; None: the demo's own length.
        configs: the folder with the agents' configurations; None: those that come with the demo.
        sets: what is changed of them, as `--set` takes it.
        faults: whether the network has faults.
        record: whether what all agents say is recorded.
    """

    demo: str
    duration_s: float | None = None
    configs: Path | None = None
    sets: tuple[str, ...] = ()
    faults: bool = False
    record: bool = False


def plan_of(found: Demo, out: Path, seed: int, wishes: MissionWishes, plugins: Plugins) -> DemoPlan:
    """Works out a mission.

    Raises:
        PancakesError: a file is missing or wrong.
    """
    duration_s = found.duration_s if wishes.duration_s is None else wishes.duration_s
    recording = (f'record.path="{out / RECORDING}/{{agent}}.mcap"',) if wishes.record else ()
    configs = find_configs(found, wishes.configs)
    return make_plan(found, configs, out, seed, 1.0, duration_s, (*recording, *wishes.sets), False, plugins)


def fly_unattended(seed: int, out: Path, wishes: MissionWishes, said: list[str]) -> Mapping[str, Any]:
    """Runs a mission, or all of a comparison, and judges it. The same seed writes the same bytes as `pancakes demo`.

    Args:
        seed: its seed.
        out: the folder for its results, without pictures.
        wishes: what else is asked for.
        said: gets a sentence on each recording that is not as it should be.

    Returns:
        The summary.

    Raises:
        PancakesError: it cannot be run.
    """
    plugins = Plugins()
    found: Demo | Comparison = plugins.get("pancakes.demos", wishes.demo)
    if isinstance(found, Demo):
        return _fly(found, seed, out, wishes, plugins, said)[1]
    fresh(out, (found.picture,))
    runs: dict[str, Run] = {}
    summaries: dict[str, Mapping[str, Any]] = {}
    timings: dict[str, Mapping[str, Any]] = {}
    for variant in found.variants:
        own = replace(wishes, sets=(*variant.sets, *wishes.sets))
        flown = _fly(found.mission, seed, out / variant.name, own, plugins, said)
        runs[variant.name], summaries[variant.name], timings[variant.name] = flown
    summary = found.judge(out, runs, summaries)
    write_results(out, summary, timings)
    return summary


def _fly(
    found: Demo, seed: int, out: Path, wishes: MissionWishes, plugins: Plugins, said: list[str]
) -> tuple[Run, Mapping[str, Any], Mapping[str, Any]]:
    plan = plan_of(found, out, seed, wishes, plugins)
    fresh(out, (*found.records.values(), "paths.png"))
    mission = Mission(plan.demo.agents, plan.duration_s)
    faults = NetworkFaults(seed) if wishes.faults else None
    timing = run_virtual(plan, mission, threading.Event(), faults, None, said.append)
    run = run_of(plan, mission)
    return run, judge(plan, run, timing), timing
