"""The data of a demo: its mission, agents and judge (entry point group `pancakes.demos`)."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple


@dataclass(frozen=True, slots=True)
class Run:
    """One run of a demo, for its judge.

    Attributes:
        out: the folder with `events.jsonl` and `trajectory.csv`, and for pictures.
        seed: the run's seed.
        duration_s: the planned length of the mission, in mission seconds.
        ended_s: the mission time at which it ended.
        ended_because: why it ended early, as a sentence; empty if it did not.
        configs: the configurations with which the agents ran, by agent, as plain mappings.
    """

    out: Path
    seed: int
    duration_s: float
    ended_s: float
    ended_because: str
    configs: Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Loss:
    """Agents that are killed during a mission, one at a time, and later started again on their disks.

    Which agent it is, and when, is drawn from the run's seed.

    Attributes:
        agents: the agents of which one is killed; not the world.
        earliest_s: the earliest time of its end, in mission seconds.
        latest_s: the latest time of its end, in mission seconds.
        away_s: the time from its end to its restart, in mission seconds.
        every_s: this is repeated in each such time of the mission. What is left of the mission at its end, and a
            mission that is shorter, have it in proportion. Infinity: it happens once, and never in proportion.
    """

    agents: tuple[str, ...]
    earliest_s: float
    latest_s: float
    away_s: float
    every_s: float = math.inf

    def __post_init__(self) -> None:
        if not self.agents:
            raise ValueError("a loss needs an agent")
        if not 0.0 <= self.earliest_s <= self.latest_s:
            raise ValueError(f"a loss cannot be between {self.earliest_s:g} and {self.latest_s:g} s")
        if not self.away_s >= 0.0:
            raise ValueError(f"a lost agent cannot be away for {self.away_s:g} s")
        if not (self.every_s > 0.0 and self.latest_s + self.away_s <= self.every_s):
            raise ValueError("a lost agent must be back before the next one is lost: every_s is too short")

    def times(self, seed: int, duration_s: float) -> list[Death]:
        """Return who is killed when, and when it comes back, in the run with this seed; in the order of time."""
        draw = random.Random(f"loss/{seed}")
        if math.isinf(self.every_s):
            at_s = draw.uniform(self.earliest_s, self.latest_s)
            return [Death(draw.choice(self.agents), at_s, at_s + self.away_s)]
        found = []
        for number in range(math.ceil(duration_s / self.every_s)):
            begin_s = number * self.every_s
            share = min(1.0, (duration_s - begin_s) / self.every_s)
            at_s = begin_s + share * draw.uniform(self.earliest_s, self.latest_s)
            found.append(Death(draw.choice(self.agents), at_s, at_s + share * self.away_s))
        return found


class Death(NamedTuple):
    """An agent that is killed in a mission.

    Attributes:
        agent: the agent.
        at_s: when it is killed, in mission seconds.
        back_s: when it is started again.
    """

    agent: str
    at_s: float
    back_s: float


@dataclass(frozen=True, slots=True)
class Demo:
    """An installed mission that is ready to run.

    Attributes:
        name: its name, as in `pancakes demo NAME`.
        title: what it shows, in a few words.
        agents: its agents. The world comes first.
        configs: the folder with a configuration file for each agent, `AGENT.toml`. It is part of the demo's package, so
            that it is installed with the demo.
        duration_s: its length, in mission seconds.
        judge: returns the summary of a run; its `verdict` is `PASS` or `FAIL`, and its `reasons` say what went wrong.
        draw: draws the pictures of a run from its summary; None: no pictures.
        circled: the body that robots circle, for the live view's distance to the circle; empty: none.
        radius_m: the radius of that circle.
        records: the files that tasks of the world write, by the task's name.
        arrange: takes the folder of a run, and whether it is live; returns the changes of each agent's file, as for
            `--set`, by agent. None: no changes.
        virtual: whether it runs in virtual time by default.
        loss: the agents that are killed during the mission. If None, an agent that ends ends the mission.
        fastest: the most mission seconds per second in a live run, if something in it takes time on the host's clock,
            such as leases.
        live_only: why it cannot run in virtual time, as a clause; empty if it can.
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
        name: its name, and the name of the folder with its results.
        title: how it differs, in a few words.
        sets: the changes of its agents' configurations, as for `--set`.
    """

    name: str
    title: str
    sets: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Comparison:
    """A demo that runs one mission several times, each time with other configurations.

    Attributes:
        name: its name, as in `pancakes demo NAME`.
        title: what it shows, in a few words.
        mission: the mission; each run of it is judged separately.
        variants: the variants to compare; the first one is the reference.
        judge: takes the folder with all results, and each variant's run and summary by its name; returns the summary
            of the comparison, with `verdict`, `reasons` and, for the terminal, `said`.
        draw: takes the folder, the runs and the summary, and draws the picture.
        picture: the name of that picture.
        virtual: whether it runs in virtual time by default. Live, it takes as long as all of its missions together.
    """

    name: str
    title: str
    mission: Demo
    variants: tuple[Variant, ...]
    judge: Callable[[Path, Mapping[str, Run], Mapping[str, Mapping[str, Any]]], dict[str, Any]]
    draw: Callable[[Path, Mapping[str, Run], Mapping[str, Any]], None]
    picture: str
    virtual: bool = True
