"""Tasks that are created, moved and removed while agents crash and links break."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterable
from typing import Any

from seeded import for_each
from services.created import Count

from pancakes.control import Create, Migrate, Remove
from pancakes.testing import Fleet

STEPS = 20
GUARD = {"guard": {"copies": 3, "lease_s": 2.0}}
ACTS = ("create", "create", "remove", "remove", "migrate", "migrate", "crash", "cut")


class Storm:
    """Does things to three agents, and looks what runs meanwhile.

    Args:
        fleet: the agents.
        seed: draws what is done.
        keys: other keys of the tasks.
    """

    def __init__(self, fleet: Fleet, seed: int, keys: dict[str, object]) -> None:
        self._fleet = fleet
        self._random = random.Random(seed)
        self._keys = keys
        self._gone: set[str] = set()
        self._epochs: dict[str, int] = {}
        self.done: Counter[str] = Counter()

    def act(self) -> None:
        act, name = self._random.choice(ACTS), self._random.choice(sorted(self._fleet.agents))
        if act == "create":
            self._create(name)
        elif act == "crash":
            self._fleet.crash(name)
            self.look(self._random.choice([0.1, 1.0, 4.0]))
            self._fleet.restart(name)
        elif act == "cut":
            self._fleet.faults.cut(name, for_s=self._random.choice([0.5, 3.0]))
        elif running := [name for name, agent in self._fleet.agents.items() if agent.running()]:
            self._remove(running[0]) if act == "remove" else self._migrate(running[0])
        self.look(self._random.choice([0.1, 0.5, 3.0, 8.0]))

    def _create(self, name: str) -> None:
        task_id = f"{name}/X"
        reply = self._fleet.agents[name].ask(Create("X", "test.Count", keys=self._keys))
        if reply.ok:
            assert reply.result["epoch"] > self._epochs.get(task_id, 0)
            self._gone.discard(task_id)
            self._epochs[task_id] = reply.result["epoch"]
            self.done["created"] += 1

    def _remove(self, name: str) -> None:
        agent = self._fleet.agents[name]
        fence = agent.slot("X").fence
        if fence is not None and agent.ask(Remove("X"), timeout_s=60.0).ok:
            self._gone.add(fence.task_id)
            self._epochs[fence.task_id] = fence.epoch[0]
            self.done["removed"] += 1

    def _migrate(self, name: str) -> None:
        self.done["moved"] += self._fleet.agents[name].ask(Migrate("X"), timeout_s=60.0).ok

    def look(self, duration_s: float) -> None:
        """Looks again and again what runs."""
        until_s = self._fleet.now() + duration_s
        while self._fleet.now() < until_s:
            self._fleet.run_for(0.05)
            acting = Counter(self._acting())
            assert not [task_id for task_id, copies in acting.items() if copies > 1], "it runs twice"
            assert not self._gone.intersection(acting), "it was removed, and runs"

    def _acting(self) -> list[str]:
        slots = [agent.slot(task) for agent in self._fleet.agents.values() for task in agent.running()]
        cores: list[Any] = [slot.task for slot in slots if slot.task is not None]
        guarded = [it for it in cores if isinstance(it.facade, Count) and it.fence is not None]
        return [it.fence.task_id for it in guarded if it.facade.may_act()]


def creation_storms(seeds: Iterable[int], keys: dict[str, object]) -> None:
    """Check that no task runs twice, or after its removal, and that enough was done."""
    done: Counter[str] = Counter()

    def storm_of(seed: int) -> None:
        with Fleet(seed, classes={"test.Count": Count}) as fleet:
            for name in "abc":
                fleet.start(name)
            fleet.connect()
            storm = Storm(fleet, seed, keys)
            for _ in range(STEPS):
                storm.act()
            fleet.connect(60.0)
            storm.look(10.0)
            done.update(storm.done)

    for_each(seeds, storm_of)
    assert all(done[what] > 2 for what in ("created", "removed", "moved")), done
