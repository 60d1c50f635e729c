"""A fleet in virtual time whose robots share tasks by the team's allocation, while packets are lost and robots die."""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final
from unittest import mock

from pancakes.devices import Pose
from pancakes.durable.market import Row
from pancakes.migration import Cost, CostFacts
from pancakes.packet import SYSTEM
from pancakes.task import Task
from pancakes.testing import Fleet

LOOK_S: Final = 0.1
LEASE_S: Final = 2.0
SIDE_M: Final = 10.0


@dataclass
class PlaceSettings:
    x_m: float = 0.0
    y_m: float = 0.0


class Watch(Task[PlaceSettings, None]):
    """Watches a place, and does nothing: what counts is who has it."""

    requires = ("pose",)


class Distance(Cost):
    """The distance from a robot to the place, in m."""

    name = "trial.distance"
    reads = ("pose",)

    def terms(self, facts: CostFacts) -> Mapping[str, float]:
        pose = facts.reading("pose")
        return {"metres": math.hypot(pose.x_m - facts.settings["x_m"], pose.y_m - facts.settings["y_m"])}


@dataclass
class Told:
    """What a run showed.

    Attributes:
        settled_s: virtual time until the tasks had their first places.
        hours: virtual hours of steady state.
        moves: migrations in that time.
        most_moves: those of the task that migrated most often.
        without_owner_s: the longest time in which a task ran nowhere, after each death.
        moved_after: migrations after the death until the end.
        gaps: how far the rounds were from the optimum that moved something, as shares.
        lost: tasks that run nowhere, or twice, at the end.
    """

    settled_s: float = 0.0
    hours: float = 0.0
    moves: int = 0
    most_moves: int = 0
    without_owner_s: list[float] = field(default_factory=list)
    moved_after: int = 0
    gaps: list[float] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)


class Trial:
    """A fleet of robots at random places with tasks at random places; used in a `with` statement.

    Args:
        seed: what the places, losses and deaths are drawn from.
        robots: how many robots.
        tasks: how many tasks.
        loss: the share of the packets of rounds that is lost.
    """

    def __init__(self, seed: int, robots: int, tasks: int, loss: float) -> None:
        self._draw = random.Random(f"allocation/{seed}")
        self._names = [f"robot{number}" for number in range(robots)]
        self._fleet = Fleet(seed, classes={"trial.Watch": Watch, "trial.distance": Distance})
        self._tasks: list[str] = []
        self._moved: dict[str, Counter[str]] = {}
        self._poses = {name: self._place() for name in self._names}
        self._loss = loss
        per_robot = math.ceil(1.3 * tasks / robots)
        settings = {"allocation": {"at_most": per_robot, "crowding": 0.2}}
        guard = {"copies": 3, "lease_s": LEASE_S}
        rule = {"when": "allocation", "cost": "trial.distance", "value": 20.0, "move_price": 1.0}
        mine: dict[str, dict[str, Any]] = {name: {} for name in self._names}
        for number in range(tasks):
            task = f"Watch{number}"
            x_m, y_m = self._place()
            table = {"type": Watch, "guard": guard, "migrate": rule, "settings": {"x_m": x_m, "y_m": y_m}}
            mine[self._draw.choice(self._names)][task] = table
            self._tasks.append(task)
        for name in self._names:
            devices = {"pose": "null.pose"}
            self._fleet.start(name, services={"network": {"settings": settings}}, tasks=mine[name], devices=devices)

    def _place(self) -> tuple[float, float]:
        return self._draw.uniform(0.0, SIDE_M), self._draw.uniform(0.0, SIDE_M)

    def __enter__(self) -> Trial:
        # The fleet's faults lose nothing on the channels by which agents coordinate, unless they are told to.
        self._patch = mock.patch("pancakes.simulation.fleet.NEVER_LOST", ())
        self._patch.start()
        self._fleet.connect()
        self._fleet.faults.lose(self._loss, Row)
        return self

    def __exit__(self, *error: object) -> None:
        self._fleet.close()
        self._patch.stop()

    def run(self, hours: float, deaths: int) -> Told:
        """Runs it: the tasks find their places, an eventless time, then deaths. Returns what it showed."""
        told = Told(hours=hours)
        began_s = self._fleet.now()
        before: Counter[str] | None = None
        while before is None or self._moves() != before:
            before = self._moves()
            self._pass(20.0)
        told.settled_s = self._fleet.now() - began_s
        self._pass(hours * 3600.0)
        steady = self._moves() - before
        told.moves, told.most_moves = steady.total(), max(steady.values(), default=0)
        for _ in range(deaths):
            self._moves()
            victim = self._draw.choice([name for name in self._names if name in self._fleet.agents])
            self._fleet.crash(victim)
            told.without_owner_s.append(self._watch(60.0))
        told.moved_after = (self._moves() - before - steady).total()
        told.gaps = [
            event["gap"]
            for agent in self._fleet.agents.values()
            for event in agent.events("allocation")
            if event["gap"] is not None
        ]
        places = self._places()
        told.lost = [task for task in self._tasks if places.get(task, 0) != 1]
        return told

    def _pass(self, for_s: float) -> None:
        """Let time pass; robots measure their poses, which are a little wrong."""
        until_s = self._fleet.now() + for_s
        while self._fleet.now() < until_s:
            for name, (x_m, y_m) in self._poses.items():
                if name in self._fleet.agents:
                    noise = self._draw.gauss(0.0, 0.02), self._draw.gauss(0.0, 0.02)
                    self._fleet.agents[name].publish(SYSTEM, Pose(x_m + noise[0], y_m + noise[1], 0.0))
            self._fleet.run_for(min(10.0, until_s - self._fleet.now()))

    def _watch(self, for_s: float) -> float:
        """Let time pass, and look who has what; return the longest time in which a task ran nowhere."""
        since: dict[str, float] = {}
        longest_s = 0.0
        until_s = self._fleet.now() + for_s
        while self._fleet.now() < until_s:
            self._fleet.run_for(LOOK_S)
            places = self._places()
            for task in self._tasks:
                if places.get(task):
                    since.pop(task, None)
                else:
                    longest_s = max(longest_s, self._fleet.now() - since.setdefault(task, self._fleet.now() - LOOK_S))
        return longest_s

    def _places(self) -> dict[str, int]:
        found: dict[str, int] = {}
        for agent in self._fleet.agents.values():
            for task in agent.running():
                found[task] = found.get(task, 0) + 1
        return found

    def _moves(self) -> Counter[str]:
        """Returns how often each task has migrated so far, also from robots that have died since; no take-overs."""
        for name, agent in self._fleet.agents.items():
            moved = agent.events("migration", outcome="moved")
            self._moved[name] = Counter(event["task"] for event in moved if event["asked_by"] != "guardians")
        return sum(self._moved.values(), Counter())
