"""Real agents that guard a task, of which one after the other is killed, stopped or ended, also while the task moves.

The oracle is outside of the agents: a file in which whoever runs the task counts. Of two lines the later one is under
the epoch that is not lower, but for one line of a process that was stopped between its look at the clock and the act.
"""

from __future__ import annotations

import random
import signal
import statistics
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from torture.live import LiveFleet

from pancakes.client import Client, Where
from pancakes.control import Migrate
from pancakes.errors import PancakesError

NAMES = ("a", "b", "c", "d")
LEASE_S = 2.0
KINDS = ("kill", "end", "short stop", "long stop")
STOPPED_S = {"short stop": 0.5, "long stop": 2.5 * LEASE_S}
GOES_ON_WITHIN_S = 20.0


@dataclass
class GuardedTally:
    """What happened.

    Attributes:
        faults: how many of each kind.
        late: acts under an epoch that had ended.
        doubled: how often two such acts, or more, followed each other.
        gaps_s: from each loss of the owner to the first act of another, in seconds.
        standstills: faults after which no agent acted for too long.
        acts: all acts.
    """

    faults: Counter[str] = field(default_factory=Counter)
    late: int = 0
    doubled: int = 0
    gaps_s: list[float] = field(default_factory=list)
    standstills: list[str] = field(default_factory=list)
    acts: int = 0

    def add(self, other: GuardedTally) -> None:
        """Adds what happened to another fleet."""
        self.faults += other.faults
        self.late += other.late
        self.doubled += other.doubled
        self.gaps_s += other.gaps_s
        self.standstills += other.standstills
        self.acts += other.acts

    def judge(self, epochs: Sequence[int]) -> None:
        """Counts the acts that came late."""
        self.acts = len(epochs)
        highest, before = -1, False
        for epoch in epochs:
            late = epoch < highest
            self.late += late
            self.doubled += late and before
            highest, before = max(highest, epoch), late

    def told(self) -> str:
        """Returns it as a line."""
        gaps = sorted(self.gaps_s)
        middle = f"p50 {statistics.median(gaps):.2f} s, max {gaps[-1]:.2f} s" if gaps else "none"
        kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(self.faults.items()))
        return f"{kinds}; {self.acts} acts, {self.late} late; gaps: {middle}; {len(self.standstills)} standstills"


class GuardedFaults:
    """One fleet of four agents with one task, guarded by three.

    Args:
        directory: all files.
        seed: draws the faults; the machine draws the rest.
        spoilt_by: Python that breaks the agents, see `LiveFleet`.
    """

    def __init__(self, directory: Path, seed: int, spoilt_by: str = "") -> None:
        self._random = random.Random(f"guarded/{seed}")
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._count = directory / "One.count"
        task = f'[task.One]\ntype = "torture.Holder"\nguard = 3\nlease_s = {LEASE_S}\ncheckpoint_s = 0.5\n'
        task += f'settings = {{directory = "{directory}"}}\n'
        listen = {name: f"local://{directory}/{name}" for name in NAMES}
        log = '[service.log]\nsettings = {level = "warning"}\n'
        rest = dict.fromkeys(NAMES, log)
        self._fleet = LiveFleet(directory, NAMES, {**rest, "a": task + log}, listen, spoilt_by=spoilt_by)
        self.tally = GuardedTally()

    def run(self, faults: int) -> GuardedTally:
        """Runs the fleet through so many faults, half of them while the task is asked to move."""
        fleet = self._fleet
        try:
            for name in NAMES:
                fleet.start(name)
            self._goes_on("the start", since=0)
            time.sleep(2.0)  # its guardians are chosen
            for _ in range(faults):
                self._fault(self._random.choice(KINDS))
                if self.tally.standstills:
                    break
        finally:
            fleet.close()
        self.tally.judge([int(line.split()[1]) for line in self._lines()])
        return self.tally

    def _fault(self, kind: str) -> None:
        fleet, owner = self._fleet, self._last()[2]
        hit = owner if self._random.random() < 0.8 else self._random.choice(NAMES)
        self.tally.faults[kind] += 1
        if self._random.random() < 0.5:
            self._move(owner)
            time.sleep(self._random.uniform(0.0, 0.05))
        since, at_s = self._count.stat().st_size, time.monotonic()
        process = fleet.running[hit].process
        if kind == "kill":
            fleet.kill(hit)
        elif kind == "end":
            process.terminate()
            process.wait(20.0)
            fleet.kill(hit)
        else:
            process.send_signal(signal.SIGSTOP)
        stopped_s = STOPPED_S.get(kind, 0.0)
        if kind != "short stop":
            self._goes_on(f"{kind} of {hit}, where {owner} had the task", since, at_s if hit == owner else None, hit)
        time.sleep(max(0.0, stopped_s - (time.monotonic() - at_s)))
        if kind in STOPPED_S:
            process.send_signal(signal.SIGCONT)
        else:
            fleet.start(hit)
        time.sleep(self._random.uniform(1.0, 2.0))
        self._goes_on(f"the end of {kind} of {hit}", self._count.stat().st_size)

    def _move(self, owner: str) -> None:
        with Client(Where(tuple(self._fleet.addresses.values()), "torture"), 0.2) as client:
            try:
                client.request(owner, Migrate("client/One"))
            except PancakesError:  # the answer comes later than it is waited for
                pass

    def _goes_on(self, after: str, since: int, lost_s: float | None = None, lost: str = "") -> None:
        """Waits until the task acts again; on another agent than the one that is lost."""
        deadline_s = time.monotonic() + GOES_ON_WITHIN_S
        while time.monotonic() < deadline_s:
            acts = [line.split()[2] for line in self._lines(since)]
            if any(agent != lost for agent in acts):
                if lost_s is not None:
                    self.tally.gaps_s.append(time.monotonic() - lost_s)
                return
            time.sleep(0.01)
        self.tally.standstills.append(after)

    def _last(self) -> list[str]:
        return self._lines(max(0, self._count.stat().st_size - 200))[-1].split()

    def _lines(self, since: int = 0) -> list[str]:
        if not self._count.exists():
            return []
        with self._count.open("rb") as file:
            file.seek(since)
            lines = file.read().decode().splitlines(keepends=True)
        return [line for line in lines if line.endswith("\n") and len(line.split()) == 4]


def run_guarded_fleets(directory: Path, faults: int, fleets: int, seed: int = 1, spoilt_by: str = "") -> GuardedTally:
    """Runs several fleets at once, each through so many faults; returns what happened to all of them."""
    made = [GuardedFaults(directory / str(number), seed + number, spoilt_by) for number in range(fleets)]
    total = GuardedTally()
    with ThreadPoolExecutor(fleets) as pool:
        for tally in pool.map(lambda one: one.run(faults), made):
            total.add(tally)
    return total
