"""What it would cost a neighbour to take a task: by plug-in (entry point group `pancakes.costs`; paper §3.4)."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class HostLoad:
    """What a cost function may know of the agent that is asked.

    Attributes:
        active_tasks: how many tasks run here in the Client Service, and how many slots are kept for arrivals.
    """

    active_tasks: int


class Cost(ABC):
    """A cost function. The entry point names the class, which is called without arguments.

    Attributes:
        name: its name in `migrate = { cost = "NAME" }`.
    """

    name: ClassVar[str]

    @abstractmethod
    def terms(self, load: HostLoad) -> Mapping[str, float]:
        """Returns what the cost is made of, by a name for people; their sum is the cost.

        Each must be finite and not negative, else the answer counts as a refusal.
        """

    def __call__(self, load: HostLoad) -> float:
        """Returns the cost."""
        return math.fsum(self.terms(load).values())


class ActiveTasks(Cost):
    """The number of active tasks (the paper's)."""

    name = "tasks"

    def terms(self, load: HostLoad) -> Mapping[str, float]:
        return {"active tasks": float(load.active_tasks)}


def fault_of(cost: float, terms: Mapping[str, float]) -> str:
    """Returns why an answer cannot be compared with others, or an empty string."""
    for name, value in (("cost", cost), *sorted(terms.items())):
        if not math.isfinite(value):
            return f"its {name} is {value}"
        if value < 0:
            return f"its {name} is negative ({value:g})"
    return ""
