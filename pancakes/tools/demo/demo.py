"""What a demo is: a mission as data (entry point group `pancakes.demos`)."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
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
        ended_because: why it ended early, as a sentence; empty if it did not.
        configs: the configurations of the agents as they ran, by agent, as plain mappings.
    """

    out: Path
    seed: int
    duration_s: float
    ended_s: float
    ended_because: str
    configs: Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Loss:
    """An agent that is killed in the course of a mission, and started again later, on its disk.

    Attributes:
        agent: the agent; not the world.
        earliest_s: it is killed at a time that is drawn from the run's seed, in mission seconds: not before this, ...
        latest_s: ... and not after this.
        away_s: so long after that it is started again, in mission seconds.
    """

    agent: str
    earliest_s: float
    latest_s: float
    away_s: float

    def at_s(self, seed: int) -> float:
        """Return when the agent is killed in the run with this seed."""
        return random.Random(f"loss/{seed}").uniform(self.earliest_s, self.latest_s)


@dataclass(frozen=True, slots=True)
class Demo:
    """A mission that is installed, ready to run.

    Attributes:
        name: its name, as in `pancakes demo NAME`.
        title: what it shows, in a few words.
        agents: its agents. The world comes first.
        configs: the folder with a configuration file for each agent, of the agent's name. It is part of the demo's own
            package, so that it is there wherever the demo is installed.
        duration_s: how long it lasts, in mission seconds.
        judge: returns the summary of a run; its `verdict` is `PASS` where all went well, else its `reasons` say what
            did not.
        draw: draws the pictures of a run from its summary; None: it has none.
        circled: the body that robots circle, for the live view's distance to the circle; empty: none.
        radius_m: the radius of that circle.
        records: the files that tasks of the world write, by the task's name.
        arrange: takes the folder of a run, and whether it is live; returns what is to be set in each agent's file for
            that, as `--set` takes it, by agent. None: nothing.
        virtual: whether it runs in virtual time if nothing else is asked for.
        loss: the agent that is killed on the way; None: none is, and one that ends by itself ends the mission.
        fastest: the most mission seconds a second that it can run with live, where something that it shows takes its
            time on the host's clock, as leases do.
        live_only: why it cannot run in virtual time, as a clause; empty: it can.
    """

    name: str
    title: str
    agents: tuple[str, ...]
    configs: Path
    duration_s: float
    judge: Callable[[Run], dict[str, Any]]
    draw: Callable[[Run, Mapping[str, Any]], None] | None = None
    circled: str = ""
    radius_m: float = 0.0
    records: Mapping[str, str] = field(default_factory=lambda: {"Trajectory": "trajectory.csv"})
    arrange: Callable[[Path, bool], Mapping[str, Sequence[str]]] | None = None
    virtual: bool = False
    loss: Loss | None = None
    fastest: float = math.inf
    live_only: str = ""


@dataclass(frozen=True, slots=True)
class Variant:
    """One of the missions of a comparison.

    Attributes:
        name: its name, and that of the folder with its results.
        title: what is different about it, in a few words.
        sets: what is different in its agents' configurations, as `--set` takes it.
    """

    name: str
    title: str
    sets: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Comparison:
    """A demo that runs one mission several times, each time with something else in its configurations.

    Attributes:
        name: its name, as in `pancakes demo NAME`.
        title: what it shows, in a few words.
        mission: the mission; each run of it is judged by itself.
        variants: what is compared; the first is what the others are measured by.
        judge: takes the folder with all results, and each variant's run and summary by its name; returns the summary
            of the whole, with `verdict`, `reasons` and, for the terminal, `said`.
        draw: takes the folder, the runs and the summary, and draws the picture.
        picture: the name of that picture.
        virtual: whether it runs in virtual time if nothing else is asked for; live, it takes as long as all of its
            missions together.
    """

    name: str
    title: str
    mission: Demo
    variants: tuple[Variant, ...]
    judge: Callable[[Path, Mapping[str, Run], Mapping[str, Mapping[str, Any]]], dict[str, Any]]
    draw: Callable[[Path, Mapping[str, Run], Mapping[str, Any]], None]
    picture: str
    virtual: bool = True
