"""Tasks that are created in tests, and what to ask for."""

from __future__ import annotations

from dataclasses import dataclass

from pancakes.control import Create
from pancakes.task import Task, Tick, every
from pancakes.testing import AgentHandle


class Count(Task):
    """Counts its ticks."""

    @dataclass
    class Settings:
        step: int = 1

    @dataclass
    class State:
        n: int = 0

    @every(hz=10)
    def tick(self, tick: Tick) -> None:
        self.state.n += self.settings.step


class Drive(Count):
    """Needs what an agent may lack."""

    requires = ("motors",)


COUNT = Create("Count", "test.Count", {"step": 2}, rate_hz=5.0)


def count_of(agent: AgentHandle) -> int:
    task = agent.task("Count")
    assert isinstance(task, Count)
    n = task.state.n
    assert isinstance(n, int)
    return n
