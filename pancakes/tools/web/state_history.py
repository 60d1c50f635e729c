"""The states that tasks were seen with in the last minutes. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

from pancakes.tools.short_state import ShortState
from pancakes.tools.web.history import SPAN_S

MOST_BYTES: Final = 8 * 1024 * 1024
"""How much memory all of them may take; then less is kept."""


@dataclass(slots=True)
class _SeenState:
    """A state, and from when until when the task was seen with it."""

    first_s: float
    last_s: float
    state: ShortState


class StateHistory:
    """Keeps short states of tasks, each as long as the timeline goes back. Times are seconds on it.

    Args:
        span_s: how much of the timeline is kept.
        most_bytes: see `MOST_BYTES`.
    """

    def __init__(self, span_s: float = SPAN_S, most_bytes: int = MOST_BYTES) -> None:
        self._span_s = span_s
        self._most_bytes = most_bytes
        self._seen: dict[str, deque[_SeenState]] = {}
        self._order: deque[tuple[str, _SeenState]] = deque()
        self._size = 0

    def add(self, task: str, t: float, state: ShortState) -> None:
        """Notes that a task was seen with a state.

        Args:
            task: its address, as `agent/service/task`.
            t: when; not before what was noted last.
            state: what there is room for of its state.
        """
        seen = self._seen.setdefault(task, deque())
        if seen and seen[-1].state == state:
            seen[-1].last_s = t
            return
        seen.append(_SeenState(t, t, state))
        self._order.append((task, seen[-1]))
        self._size += state.size()
        while len(self._order) > 1 and (self._order[0][1].last_s < t - self._span_s or self._size > self._most_bytes):
            self._forget_oldest()

    def at(self, task: str, t: float) -> tuple[float, ShortState] | None:
        """Returns when a task was seen last, at `t` or before, and with which state; None where it was not."""
        for seen in reversed(self._seen.get(task, ())):
            if seen.first_s <= t:
                return min(t, seen.last_s), seen.state
        return None

    def _forget_oldest(self) -> None:
        task, seen = self._order.popleft()
        self._size -= seen.state.size()
        of_task = self._seen[task]
        of_task.popleft()
        if not of_task:
            del self._seen[task]
