"""What a demo is: a mission as data (entry point group `pancakes.demos`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class Run:
    """One run of a demo, for its judge.

    Attributes:
        out: the folder with `events.jsonl` and `trajectory.csv`, and where pictures go.
        seed: the run's seed.
        duration_s: how long the mission was to last, in mission seconds.
        ended_s: when it ended.
        ended_because: why it ended early, as a sentence; empty where it did not.
        configs: the configurations of the agents as they ran, by agent, as plain mappings.
    """

    out: Path
    seed: int
    duration_s: float
    ended_s: float
    ended_because: str
    configs: Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Demo:
    """A mission that anybody can run.

    Attributes:
        name: its name, as in `pancakes demo NAME`; its configurations lie in a folder of this name.
        title: what it shows, in a few words.
        agents: its agents; each has a configuration file of its name. The world comes first.
        duration_s: how long it lasts, in mission seconds.
        judge: returns the summary of a run; its `verdict` is `PASS` where all went well, else its `reasons` say what
            did not.
        draw: draws the pictures of a run from its summary.
        circled: the body that robots circle, for the live view's distance to the circle; empty: none.
        radius_m: the radius of that circle.
    """

    name: str
    title: str
    agents: tuple[str, ...]
    duration_s: float
    judge: Callable[[Run], dict[str, Any]]
    draw: Callable[[Run, Mapping[str, Any]], None]
    circled: str = ""
    radius_m: float = 0.0
