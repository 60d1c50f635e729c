"""Whether an agent's tasks run as they should after a restart: pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from pancakes.client import TaskRow

GOOD: Final = frozenset({"running", "stopped"})
"""A task that is stopped was told so, or is elsewhere: that is for its agent to know."""
HOPELESS: Final = frozenset({"failed", "stuck"})
GIVEN_UP: Final = "failed"
"""Why a task rests that was given up in an earlier life of its agent; its state is `stopped` then."""


@dataclass
class Steadiness:
    """Looks at an agent's tasks until they have run for a while.

    Args:
        before: the states of its tasks before, by name; what did not run then need not now.
        calm_s: so long nothing may have begun anew.
    """

    before: Mapping[str, str]
    calm_s: float
    _seen: dict[str, int] = field(default_factory=dict)
    _since_s: float | None = None

    def look(self, tasks: Sequence[TaskRow], now_s: float) -> bool:
        """Takes how they are; returns whether they have run for long enough."""
        seen = {str(row): row.incarnation for row in tasks}
        if self.faults(tasks) or seen != self._seen:
            self._since_s = None if self.faults(tasks) else now_s
            self._seen = seen
            return False
        self._since_s = now_s if self._since_s is None else self._since_s
        return now_s - self._since_s >= self.calm_s

    def faults(self, tasks: Sequence[TaskRow]) -> list[str]:
        """Returns a clause for each task that does not run, and did before, or is new."""
        return [
            f"{row.service}/{row.task} is {_state(row)}" + (f": {row.reason}" if row.reason else "")
            for row in tasks
            if _state(row) not in GOOD and self._ran(row)
        ]

    def is_hopeless(self, tasks: Sequence[TaskRow]) -> bool:
        """Returns whether one of them has been given up."""
        return any(_state(row) in HOPELESS and self._ran(row) for row in tasks)

    def _ran(self, row: TaskRow) -> bool:
        return self.before.get(f"{row.service}/{row.task}", "running") in GOOD


def is_given_up(row: TaskRow) -> bool:
    """Returns whether a task was given up, now or in an earlier life of its agent."""
    return _state(row) == GIVEN_UP


def _state(row: TaskRow) -> str:
    return GIVEN_UP if row.rest == GIVEN_UP else row.state
