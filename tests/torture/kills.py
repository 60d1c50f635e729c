"""Real agents that are killed at random moments while their tasks move; a file lock says whether one ran twice."""

from __future__ import annotations

import random
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from torture.live import LiveFleet

from pancakes.cli.client import Client
from pancakes.control import Migrate
from pancakes.errors import PancakesError

NAMES = ("a", "b", "c")
BORN = {"One": "a", "Two": "b", "Three": "c"}
HEALS_WITHIN_S = 30.0
ROUND = 50
"""After so many kills all agents are left alone until each task runs."""


@dataclass
class Tally:
    """What happened.

    Attributes:
        kills: how many agents were killed.
        moves: how many hand-overs have come to an end with a task at its new agent, by the tasks' own files.
        asked: how many moves were answered with success to whoever asked.
        ticks: how often the tasks have worked.
        doubled: a sentence for each time that a task ran beside itself.
        lost: a sentence for each time that a task did not run after all was well again.
        backwards: a sentence for each time that a task ran under an epoch that had passed.
        worst_step_back: by how many ticks a task was set back by a crash, at most.
        heals_s: how long each healing took.
    """

    kills: int = 0
    moves: int = 0
    asked: int = 0
    ticks: int = 0
    doubled: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    backwards: list[str] = field(default_factory=list)
    worst_step_back: int = 0
    heals_s: list[float] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Adds what happened to another fleet."""
        self.kills += other.kills
        self.moves += other.moves
        self.asked += other.asked
        self.ticks += other.ticks
        self.doubled += other.doubled
        self.lost += other.lost
        self.backwards += other.backwards
        self.worst_step_back = max(self.worst_step_back, other.worst_step_back)
        self.heals_s += other.heals_s


class _Mover(threading.Thread):
    """Asks for one move of a task after the other, wherever it is, and whoever is dead just then."""

    def __init__(self, fleet: LiveFleet, task: str, count: Path, source: random.Random, calm: threading.Event) -> None:
        super().__init__(daemon=True)
        self._fleet, self._task, self._count, self._random, self._calm = fleet, task, count, source, calm
        self.ended = threading.Event()
        self.asking = threading.Event()
        self.asked = 0

    def run(self) -> None:
        with Client(at=list(self._fleet.addresses.values()), timeout_s=2.0) as client:
            while not self.ended.is_set():
                if self._calm.is_set():
                    self.ended.wait(0.05)
                    continue
                host = last_host(self._count)
                try:
                    self.asking.set()
                    self.asked += client.request(host, Migrate(f"client/{self._task}")).ok
                except PancakesError:  # it is dead
                    pass
                self.ended.wait(self._random.uniform(0.0, 0.2))


def last_host(count: Path) -> str:
    """Returns the agent on which a task has worked last, by its own file."""
    with count.open("rb") as file:
        file.seek(max(0, count.stat().st_size - 200))
        return file.read().decode().splitlines()[-1].split()[2]


class Kills:
    """One fleet of three agents, each of which has given birth to a task.

    Args:
        directory: all files.
        seed: draws who is killed, and when; the machine draws the rest.
    """

    def __init__(self, directory: Path, seed: int) -> None:
        self.random = random.Random(f"kills/{seed}")
        self.directory = directory
        self.counts = directory / "counts"
        self.counts.mkdir()
        durabilities = {"One": "lazy", "Two": "each", "Three": "lazy"}
        rest = {
            agent: f'[task.{task}]\ntype = "torture.Holder"\ndurability = "{durabilities[task]}"\n'
            f'settings = {{directory = "{self.counts}"}}\n[service.log]\nsettings = {{level = "warning"}}\n'
            for task, agent in BORN.items()
        }
        self.fleet = LiveFleet(directory, NAMES, rest)
        self.tally = Tally()

    def run(self, kills: int, told: Callable[[Tally], None] = lambda tally: None) -> Tally:
        """Kills so many agents; what happened is returned, and told after each round."""
        calm = threading.Event()
        movers = [
            _Mover(self.fleet, task, self.counts / f"{task}.count", random.Random(self.random.random()), calm)
            for task in BORN
        ]
        try:
            for name in NAMES:
                self.fleet.start(name)
            self._heal()
            for mover in movers:
                mover.start()
            while self.tally.kills < kills and not self.tally.lost:
                calm.clear()
                until = min(self.tally.kills + ROUND, kills)
                while self.tally.kills < until:
                    self._kill_one(self.random.choice(movers))
                calm.set()
                self._heal()
                self.tally.asked = sum(mover.asked for mover in movers)
                told(self.tally)
            self._count()
        finally:
            for mover in movers:
                mover.ended.set()
            for mover in movers:
                if mover.is_alive():
                    mover.join(10.0)
            self.fleet.close()
        return self.tally

    def _kill_one(self, mover: _Mover) -> None:
        """Kills one agent: just after a move was asked for, so that it is in the middle of it, or at any moment."""
        draw = self.random
        if draw.random() < 0.8:
            time.sleep(draw.uniform(0.0, 0.5))
            mover.asking.clear()
            mover.asking.wait(1.0)
            time.sleep(draw.uniform(0.0, 0.06))
        else:
            time.sleep(draw.uniform(0.0, 1.0))
        name = draw.choice(NAMES)
        if name in self.fleet.running:
            self.fleet.kill(name)
            self.tally.kills += 1
        # Who was killed before comes back now or later, so that now and then two are dead, or all three.
        for dead in NAMES:
            if dead not in self.fleet.running and draw.random() < 0.7:
                self.fleet.start(dead)

    def _heal(self) -> None:
        """Starts all that are dead, and waits until each task runs."""
        for name in NAMES:
            if name not in self.fleet.running:
                self.fleet.start(name)
        began_s = time.monotonic()
        before = {task: self._size(task) for task in BORN}
        waiting = list(BORN)
        while waiting:
            time.sleep(0.1)
            # A task that has written something since has run; in the next round that is looked at again.
            waiting = [task for task in waiting if self._size(task) <= before[task] + 200]
            if time.monotonic() - began_s > HEALS_WITHIN_S:
                said = "\n".join(line for running in self.fleet.running.values() for line in _heard(running))
                self.tally.lost += [f"{task} did not run within {HEALS_WITHIN_S:g} s; {said}" for task in waiting]
                break
        dead = [name for name, running in self.fleet.running.items() if running.process.poll() is not None]
        self.tally.lost += [f"{name} has ended by itself" for name in dead]
        self.tally.heals_s.append(time.monotonic() - began_s)

    def _size(self, task: str) -> int:
        path = self.counts / f"{task}.count"
        return path.stat().st_size if path.exists() else 0

    def _count(self) -> None:
        """Reads what the tasks have written themselves."""
        for task in BORN:
            doubled = self.counts / f"{task}.doubled"
            if doubled.exists():
                self.tally.doubled += [f"{task}: {line}" for line in doubled.read_text().splitlines()]
            n = epoch = 0
            for line in (self.counts / f"{task}.count").read_text().splitlines():
                now, under, agent, pid = line.split()
                if int(under) < epoch:
                    self.tally.backwards.append(f"{task} ran on {agent} ({pid}) under {under}, after {epoch}")
                self.tally.moves += max(0, int(under) - epoch)
                self.tally.worst_step_back = max(self.tally.worst_step_back, n - int(now))
                n, epoch = int(now), max(epoch, int(under))
                self.tally.ticks += 1


def _heard(running: object) -> list[str]:
    said = getattr(running, "said", [])
    lines = getattr(running, "_lines", None)
    while lines is not None and not lines.empty():
        line = lines.get()
        if line is not None:
            said.append(line)
    return said[-5:]


def run_kills(kills: int, seed: int, told: Callable[[Tally], None] = lambda tally: None) -> Tally:
    """Kills so many agents of one fleet, in a directory that is removed afterwards."""
    with tempfile.TemporaryDirectory(prefix="pancakes-kills-") as directory:
        return Kills(Path(directory), seed).run(kills, told)


def run_fleets(kills: int, seed: int, fleets: int, told: Callable[[Tally], None] = lambda tally: None) -> Tally:
    """Kills so many agents of several fleets at once.

    Args:
        kills: how many in all.
        seed: the first fleet's; the others have those that follow.
        fleets: how many fleets.
        told: is told what has happened so far after each round, in any thread.

    Raises:
        PancakesError: a fleet could not be set up.
    """
    shares = [kills // fleets + (number < kills % fleets) for number in range(fleets)]
    tallies: dict[int, Tally] = {}
    lock = threading.Lock()

    def tell(number: int, tally: Tally) -> None:
        with lock:
            tallies[number] = tally
            told(_sum(tallies.values()))

    with ThreadPoolExecutor(fleets) as pool:
        jobs = [
            pool.submit(run_kills, share, seed + number, partial(tell, number)) for number, share in enumerate(shares)
        ]
        return _sum([job.result() for job in jobs])


def _sum(tallies: Iterable[Tally]) -> Tally:
    total = Tally()
    for tally in tallies:
        total.add(tally)
    return total
