"""Kill real agents during migrations of their tasks, at random moments and between the effects of the protocol.

An oracle outside of the agents judges the tasks by a file lock that each running task holds, a file in which it counts
its ticks, and a stream of numbered packets to it from an agent that is never killed.
"""

from __future__ import annotations

import random
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from torture.gates import BALLAST_BYTES
from torture.live import LiveFleet
from torture.points import POINTS, Point
from torture.proxy import Verdict
from torture.roads import MakeRoads, over_tcp
from torture.tally import Tally, total
from torture.traps import Field, Trap
from torture.waits import Waits

from pancakes.client import Client, Target
from pancakes.control import Migrate
from pancakes.durable.record import TaskId
from pancakes.errors import PancakesError

NAMES = ("a", "b", "c")
TELLER = "teller"
"""The agent that is never killed, and sends packets to the tasks."""
BORN = {"One": "a", "Two": "b", "Three": "c"}
DURABILITY = {"One": "lazy", "Two": "each", "Three": "lazy"}
LAZY = [task for task, durability in DURABILITY.items() if durability == "lazy"]
TOLD = ("One", "Two")
"""The tasks that get packets, one of each durability."""
HEALS_WITHIN_S = 30.0
REACHED_WITHIN_S = 12.0
"""How long to wait for an agent to reach a point, in seconds; a source takes its task back after 2 s."""
BACK_WITHIN_S = 40.0
"""The same for an agent that must be started first: at the longest, others dial it every 10 s."""
TRIES = 5
"""How often to try again if an agent did not reach its point."""
ROADS_SHARE = 0.4
"""The share of faults of the connections, if these can fail."""
ROUND = 50
"""After this many faults, all agents are left alone until each task runs."""


class _Mover(threading.Thread):
    """Request one migration of a task after the other, wherever it runs, even while agents are dead."""

    def __init__(self, fleet: LiveFleet, task: str, count: Path, source: random.Random, calm: threading.Event) -> None:
        super().__init__(daemon=True)
        self._fleet, self._task, self._count, self._random, self._calm = fleet, task, count, source, calm
        self.ended = threading.Event()
        self.asking = threading.Event()
        self.resting = threading.Event()
        self.asked = 0

    def run(self) -> None:
        with Client(Target(tuple(self._fleet.addresses.values()), "torture"), 2.0) as client:
            while not self.ended.is_set():
                if self._calm.is_set():
                    self.resting.set()
                    self.ended.wait(0.05)
                    continue
                self.resting.clear()
                host = last_host(self._count)
                try:
                    self.asking.set()
                    # Sometimes to the lowest bid, which is always the same agent.
                    to = self._random.choice(["", *(name for name in NAMES if name != host)])
                    self.asked += client.request(host, Migrate(f"client/{self._task}", to=to)).ok
                except PancakesError:  # the agent is dead
                    pass
                self.ended.wait(self._random.uniform(0.0, 0.2))


def last_host(count: Path) -> str:
    """Return the agent on which a task ran last, by the task's own file."""
    with count.open("rb") as file:
        file.seek(max(0, count.stat().st_size - 200))
        return file.read().decode().splitlines()[-1].split()[2]


class Kills:
    """One fleet of three agents, each with a task of its own, and a proxy between each two.

    Args:
        directory: all files.
        seed: the seed of the kills; their effects depend on the machine.
        waits: all waits of this fleet; breaking them off ends it.
        spoilt_by: Python that breaks the agents, see `LiveFleet`.
        make_roads: makes what leads from agent to agent.
    """

    def __init__(
        self,
        directory: Path,
        seed: int,
        waits: Waits | None = None,
        spoilt_by: str = "",
        make_roads: MakeRoads = over_tcp,
    ) -> None:
        self._waits = waits or Waits()
        self.random = random.Random(f"kills/{seed}")
        self.directory = directory
        self.counts = directory / "counts"
        self.counts.mkdir()
        rest = {
            agent: f'[task.{task}]\ntype = "torture.Holder"\ndurability = "{DURABILITY[task]}"\n'
            f'settings = {{directory = "{self.counts}", ballast_bytes = {BALLAST_BYTES}}}\n'
            '[service.log]\nsettings = {level = "warning"}\n'
            for task, agent in BORN.items()
        }
        to = ", ".join(f'"{BORN[task]}/{task}"' for task in TOLD)
        rest[TELLER] = (
            f'[task.Teller]\ntype = "torture.Teller"\nsettings = {{directory = "{self.counts}", to = [{to}]}}\n'
            '[service.log]\nsettings = {level = "warning"}\n'
        )
        names = (*NAMES, TELLER)
        roads = self._roads = make_roads(names, directory, self._watch)
        # An environment hosts no tasks, so it gets no bids.
        self.fleet = LiveFleet(
            directory,
            names,
            rest,
            roads.listen,
            roads.peers,
            roles={TELLER: "environment"},
            network=roads.network,
            spoilt_by=spoilt_by,
        )
        self.tally = Tally()
        self._trap: Trap | None = None
        self._calm = threading.Event()
        self._movers: list[_Mover] = []

    def run(
        self, random_kills: int, points: Sequence[Point] = (), told: Callable[[Tally], None] = lambda tally: None
    ) -> Tally:
        """Kill agents, at random moments and at points, in a drawn order.

        Args:
            random_kills: how many faults at random moments, including faults of the connections.
            points: the points at which to kill in addition; one may occur twice. A point with a second one makes
                two kills.
            told: called with the tally after each round.

        Returns:
            The tally.

        Raises:
            InterruptedError: its waits were broken off.
        """
        calm = self._calm
        movers = self._movers = [
            _Mover(self.fleet, task, self.counts / f"{task}.count", random.Random(self.random.random()), calm)
            for task in BORN
        ]
        faults = self._roads.faults
        of_roads = (
            [faults[number % len(faults)] for number in range(round(random_kills * ROADS_SHARE))] if faults else []
        )
        todo: list[Point | str | None] = [*points, *of_roads, *[None] * (random_kills - len(of_roads))]
        self.random.shuffle(todo)
        try:
            for name in self.fleet.names:
                self.fleet.start(name)
            self._heal()
            for mover in movers:
                mover.start()
            while todo and not self.tally.lost:
                calm.clear()
                left = max(0, len(todo) - ROUND)
                while len(todo) > left:
                    point = todo.pop()
                    if point is None:
                        self._kill_one(self.random.choice(movers))
                    elif isinstance(point, Point):
                        self._kill_at(point)
                    else:
                        self._roads.strike(point, self.random, self._waits)
                        self.tally.roads[point] += 1
                    # A killed agent comes back now or later, so that sometimes two or all three are dead.
                    for dead in NAMES:
                        if dead not in self.fleet.running and self.random.random() < 0.7:
                            self.fleet.start(dead)
                calm.set()
                self._heal()
                self.tally.asked = sum(mover.asked for mover in movers)
                told(self.tally)
            self.tally.count(self.counts, DURABILITY)
        finally:
            for mover in movers:
                mover.ended.set()
            for mover in movers:
                if mover.is_alive():
                    mover.join(10.0)
            self.fleet.close()
            self._roads.close()
        return self.tally

    def _watch(self, row: list[Any]) -> Verdict:
        trap = self._trap
        return trap.watch(row) if trap is not None else Verdict.PASS

    def _kill_at(self, point: Point) -> None:
        """Kill an agent at a point, and if that point has a second one after the restart, there, too."""
        victim = ""
        for _ in range(TRIES):
            task = self.random.choice(LAZY if point.lazy else ["Two"])
            self._start_all()
            if not point.word:
                self._rest()
            if self._lost(self._until_works([task])):
                return
            victim = self._spring(point, task, "" if point.word else last_host(self.counts / f"{task}.count"))
            self._calm.clear()
            if victim:
                break
        if not victim:
            self.tally.missed.append(f"no agent came to the point {point.name!r}")
        elif point.then is not None and not self._spring(point.then, task, victim, start=True):
            self.tally.missed.append(f"no agent came to the point {point.then.name!r}")

    def _spring(self, point: Point, task: str, victim: str, start: bool = False) -> str:
        """Kill the agent that reaches a point; return its name, or an empty string if none reached it.

        Args:
            point: the point.
            task: the task of the hand-off.
            victim: the only agent that may reach it; empty: any.
            start: whether that agent is dead and must be started first.
        """
        place = Field(TaskId(BORN[task], task), self.fleet.state, self.counts, self.fleet.strike, self._waits)
        trap = Trap(point, place, victim)
        self._trap = trap
        try:
            trap.begin(self.fleet.start if start else None)
            reached = trap.spring(BACK_WITHIN_S if start else REACHED_WITHIN_S)
        finally:
            self._trap = None
            trap.clear()
        self.tally.longest_no_disk_s = max(self.tally.longest_no_disk_s, trap.no_disk_s)
        if trap.dead:
            self.fleet.kill(trap.dead)
            self.tally.kills += 1
        if reached:
            self.tally.points[point.name] += 1
        return reached

    def _kill_one(self, mover: _Mover) -> None:
        """Kill one agent: just after a migration was requested, so in the middle of it, or at any moment."""
        draw = self.random
        if draw.random() < 0.8:
            self._waits.let(draw.uniform(0.0, 0.5))
            mover.asking.clear()
            self._waits.until(mover.asking.wait, 1.0)
            self._waits.let(draw.uniform(0.0, 0.06))
        else:
            self._waits.let(draw.uniform(0.0, 1.0))
        if all(name not in self.fleet.running for name in NAMES):
            self._start_all()
        self.fleet.kill(draw.choice([name for name in NAMES if name in self.fleet.running]))
        self.tally.kills += 1

    def _rest(self) -> None:
        """Request no migrations for a while: a task that stays less than a second never writes a checkpoint."""
        self._calm.set()
        for mover in self._movers:
            self._waits.until(mover.resting.wait, BACK_WITHIN_S)

    def _start_all(self) -> None:
        for name in NAMES:
            if name not in self.fleet.running:
                self.fleet.start(name)

    def _heal(self) -> None:
        """Start all dead agents, and wait until each task runs and has handled all packets sent to it."""
        self._start_all()
        began_s = time.monotonic()
        idle = self._until_works(list(BORN))
        if not self._lost(idle):
            told = {task: _number(self.counts / f"{task}.told") for task in TOLD}
            while deaf := [task for task in TOLD if self._heard(task) < told[task]]:
                if time.monotonic() - began_s > HEALS_WITHIN_S:
                    self.tally.lost += [
                        f"{task} did not hear packet {told[task]} within {HEALS_WITHIN_S:g} s, only"
                        f" {self._heard(task)}; {self._said()}"
                        for task in deaf
                    ]
                    break
                self._waits.let(0.1)
        dead = [name for name, running in self.fleet.running.items() if running.process.poll() is not None]
        self.tally.lost += [f"{name} has ended by itself" for name in dead]
        self.tally.heals_s.append(time.monotonic() - began_s)

    def _until_works(self, tasks: list[str]) -> list[str]:
        """Wait until tasks run; return those that do not."""
        until_s = time.monotonic() + HEALS_WITHIN_S
        before = {task: self._size(task) for task in tasks}
        # A task that has written something since then runs; the next round checks again.
        while waiting := [task for task in tasks if self._size(task) <= before[task] + 200]:
            if time.monotonic() > until_s:
                return waiting
            self._waits.let(0.05)
        return []

    def _lost(self, tasks: list[str]) -> bool:
        """Record the tasks that do not run; return whether there are any."""
        self.tally.lost += [f"{task} did not run within {HEALS_WITHIN_S:g} s; {self._said()}" for task in tasks]
        return bool(tasks)

    def _said(self) -> str:
        """Return the last lines of the agents' logs."""
        return "\n".join(line for running in self.fleet.running.values() for line in running.so_far()[-5:])

    def _heard(self, task: str) -> int:
        path = self.counts / f"{task}.heard"
        if not path.exists():
            return 0
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - 100))
            rows = file.read().decode().splitlines()
        return int(rows[-1].split()[0]) if rows else 0

    def _size(self, task: str) -> int:
        path = self.counts / f"{task}.count"
        return path.stat().st_size if path.exists() else 0


def plan(kills: int, at: str) -> tuple[int, list[Point]]:
    """Return how many agents to kill at random moments, and at which points.

    Args:
        kills: how many kills in all; possibly one more, as some points make two.
        at: `random`, `effects` or `both`: half of them each.
    """
    between = {"random": 0, "effects": kills, "both": kills // 2}[at]
    points: list[Point] = []
    planned = 0
    while planned < between:
        point = POINTS[len(points) % len(POINTS)]
        points.append(point)
        planned += 1 if point.then is None else 2
    return max(0, kills - planned), points


def run_fleets(
    random_kills: int,
    points: Sequence[Point],
    seed: int,
    fleets: int,
    told: Callable[[Tally], None] = lambda tally: None,
    make_roads: MakeRoads = over_tcp,
) -> Tally:
    """Kill agents of several fleets at once.

    Args:
        random_kills: how many to kill at random moments, in all.
        points: the points at which to kill agents in addition.
        seed: the seed of the first fleet; the others have the following ones.
        fleets: how many fleets.
        told: called with the tally after each round, in any thread.
        make_roads: makes the connections of each fleet.

    Raises:
        PancakesError: a fleet could not be set up.
    """
    shares = [
        (random_kills // fleets + (number < random_kills % fleets), points[number::fleets]) for number in range(fleets)
    ]
    tallies: dict[int, Tally] = {}
    lock = threading.Lock()
    waits = Waits()

    def run(number: int) -> Tally:
        with tempfile.TemporaryDirectory(prefix="pancakes-kills-") as directory:
            return Kills(Path(directory), seed + number, waits, make_roads=make_roads).run(
                *shares[number], partial(tell, number)
            )

    def tell(number: int, tally: Tally) -> None:
        with lock:
            tallies[number] = tally
            told(total(tallies.values()))

    with ThreadPoolExecutor(fleets) as pool:
        try:
            return total(pool.map(run, range(fleets)))
        finally:
            waits.break_off()  # after an interrupt, the other fleets end, too


def _number(path: Path) -> int:
    """Read a number from a file that is rewritten again and again."""
    while True:
        text = path.read_text() if path.exists() else "0"
        if text:
            return int(text)
