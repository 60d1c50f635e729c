"""Storms of guarded tasks in virtual time, with a separate clock for each agent: two agents must never act at once.

The epochs of the acts never decrease, so the environment sees a single task. After the last mishap, exactly one agent
must act at the end.
"""

from __future__ import annotations

import itertools
import multiprocessing
import random
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from pancakes.control import Migrate
from pancakes.task import Task, Tick, every
from pancakes.testing import Fleet

LEASES_S: Final = (3.0, 20.0)
"""The leases to draw from. A longer lease has more time between the ends of a permit by two clocks."""
CALM: Final = 7.0
"""How many leases without mishaps pass before the end of a storm is judged."""
AT_THE_END: Final = 0.7
"""For how many leases the end is watched."""
PAUSE: Final = 0.48
"""The mean time between two mishaps, in leases."""
ACTS: Final = 60
"""How often the task acts per lease."""
LEFT: Final = 2
"""How many agents run at any time."""
DONE: Final[list[tuple[str, tuple[int, str]]]] = []
"""All acts of the storm: the agent, and the epoch."""


class Act(Task):
    """Records its acts: the time, the agent and the epoch."""

    @dataclass
    class State:
        n: int = 0

    @every(hz=20)
    def tick(self, tick: Tick) -> None:
        self.state.n += 1
        fence = self._actor.fence
        assert fence is not None
        DONE.append((self.agent, fence.epoch))


@dataclass
class StormEnd:
    """The result of one storm.

    Attributes:
        seed: its seed.
        violation: the broken promise, as a clause; empty: none.
        two: whether the violation is that two agents acted.
        counts: the mishaps, by kind; `act`: the acts; `taken`: how often another agent took over.
    """

    seed: int
    violation: str = ""
    two: bool = False
    counts: Counter[str] = field(default_factory=Counter)


class Storm:
    """One storm: a number of mishaps, drawn from a seed.

    Args:
        seed: the seed of the mishaps and the rates.
        apart: how much the rate of each agent's clock may differ from the true one, as a share; in half of the storms,
            one clock is as slow, and all others are as fast as allowed.
    """

    def __init__(self, seed: int, apart: float = 0.0) -> None:
        self._seed = seed
        self._random = random.Random(seed)
        self._names = "abcde"[: self._random.choice([3, 4, 5])]
        clocks = random.Random(f"clocks/{seed}")
        self._rates = {name: 1.0 + clocks.uniform(-apart, apart) for name in self._names}
        if clocks.random() < 0.5:
            self._rates = dict.fromkeys(self._names, 1.0 + apart) | {clocks.choice(self._names): 1.0 - apart}
        self._lease_s = self._random.choice(LEASES_S)
        self._fleet = Fleet(seed=seed, classes={"test.Act": Act})
        self._down: list[str] = []
        self._counts: Counter[str] = Counter()

    def run(self) -> StormEnd:
        """Run the storm."""
        DONE.clear()
        mishaps = (
            self._crash,
            self._stop,
            self._restart,
            self._cut,
            self._cut_owner,
            self._calm,
            self._move,
            self._break_links,
            self._spoil_disk,
        )
        with self._fleet as fleet:
            lease_s, rate_hz = self._lease_s, ACTS / self._lease_s
            guarded = {
                "type": Act,
                "guard": {"copies": 3, "lease_s": lease_s, "checkpoint_s": lease_s / 6},
                "rate_hz": rate_hz,
            }
            for name in self._names:
                tasks = {"Act": guarded} if name == "a" else {}
                fleet.start(name, tasks=tasks, clock_rate=self._rates[name])
            fleet.connect()
            fleet.run_for(lease_s * self._random.uniform(0.2, 1.3))
            for _ in range(self._random.randint(3, 12)):
                self._random.choice(mishaps)(self._random.choice(self._names))
                fleet.run_for(lease_s * PAUSE * self._random.expovariate(1.0))
            fleet.faults.calm()
            for name in self._down:
                fleet.restart(name)
            fleet.run_for(CALM * lease_s)
            before = len(DONE)
            fleet.run_for(AT_THE_END * lease_s)
            return self._judged(before)

    def _judged(self, before_the_end: int) -> StormEnd:
        epochs = [epoch for _, epoch in DONE]
        self._counts["act"] = len(epochs)
        self._counts["taken"] = len(set(epochs)) - 1
        late = next((two for two in itertools.pairwise(epochs) if two[1] < two[0]), None)
        last = {agent for agent, _ in DONE[before_the_end:]}
        if late is not None:
            violation = f"two agents act: after one under the epoch {late[0]} comes one under {late[1]}"
        else:
            violation = f"at the end {len(last) or 'no'} agents act" if len(last) != 1 else ""
        return StormEnd(self._seed, violation, late is not None, self._counts)

    def _may_leave(self, name: str) -> bool:
        return name in self._fleet.agents and len(self._fleet.agents) > LEFT

    def _crash(self, name: str) -> None:
        if self._may_leave(name):
            self._fleet.crash(name)
            self._down.append(name)
            self._counts["kill"] += 1

    def _stop(self, name: str) -> None:
        if self._may_leave(name):
            self._fleet.stop(name)
            self._down.append(name)
            self._counts["end"] += 1

    def _restart(self, name: str) -> None:
        if self._down:
            self._fleet.restart(self._down.pop(self._random.randrange(len(self._down))))
            self._counts["restart"] += 1

    def _cut(self, name: str) -> None:
        self._fleet.faults.cut(name, for_s=self._lease_s * self._random.uniform(0.2, 2.7))
        self._counts["cut"] += 1

    def _cut_owner(self, name: str) -> None:
        self._cut(DONE[-1][0] if DONE else name)

    def _calm(self, name: str) -> None:
        self._fleet.faults.calm()

    def _move(self, name: str) -> None:
        for agent in self._fleet.agents.values():
            if "Act" in agent.running():
                agent.publish("sysctrl", Migrate("Act"))
                self._counts["move"] += 1

    def _break_links(self, name: str) -> None:
        self._fleet.faults.break_links(3, 1.0)
        self._counts["break"] += 1

    def _spoil_disk(self, name: str) -> None:
        if name not in self._fleet.agents:
            return
        if self._random.random() < 0.5:
            self._fleet.faults.fill_disk(name)
            self._counts["full disk"] += 1
        else:
            self._fleet.faults.slow_disk(name, self._random.uniform(0.0, 0.5))
            self._counts["slow disk"] += 1


def run_storm(seed: int, apart: float = 0.0) -> StormEnd:
    """Run one storm; the same seed gives the same run."""
    return Storm(seed, apart).run()


def run_storms(seeds: Sequence[int], apart: float = 0.0, jobs: int = 1) -> Iterator[StormEnd]:
    """Run a storm for each seed, several at once, and yield their results as they end."""
    if jobs == 1:
        yield from (run_storm(seed, apart) for seed in seeds)
        return
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        yield from pool.imap_unordered(partial(run_storm, apart=apart), seeds, chunksize=4)
