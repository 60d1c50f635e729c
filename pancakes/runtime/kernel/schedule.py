"""The timer's book: what is due when. Pure: times go in, what is due comes out (paper §3.2, the scheduler)."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator
from itertools import count
from typing import Any

import msgspec


class Due(msgspec.Struct, frozen=True, gc=False):
    """A tick.

    Attributes:
        targets: what is to be ticked; the timer takes each out as it ticks it.
        deadline_s: when it was due.
        missed: how many ticks before it never happened because the timer itself was late.
    """

    targets: Iterator[Any]
    deadline_s: float
    missed: int


class _Group(msgspec.Struct):
    """All targets that tick together: one entry in the heap however many there are."""

    period_s: float
    number: int
    targets: dict[int, Any] = msgspec.field(default_factory=dict)

    @property
    def deadline_s(self) -> float:
        return self.number * self.period_s


class Schedule:
    """Periodic ticks and single calls on one clock.

    Deadlines are absolute, k times the period since the clock's zero, so that nothing drifts and
    equal rates tick together.

    Attributes:
        next_s: when something is due next; infinity where nothing ever is.
    """

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, _Group | Callable[[], None]]] = []
        self._order = count()
        self._groups: dict[float, _Group] = {}
        self._group_of: dict[int, _Group] = {}
        self.next_s = math.inf  # not a method: in virtual time it is asked for three times for each tick

    def every(self, target: Any, period_s: float, now_s: float) -> None:
        """Ticks `target` each `period_s` from now on; a target that ticks already changes its rate.

        The first tick is the next multiple of the period, and never one at which the target has ticked.
        """
        if not (period_s > 0 and math.isfinite(period_s)):
            raise ValueError(f"a period must be positive and finite, not {period_s}")
        self.cancel(target)
        group = self._groups.get(period_s)
        if group is None:
            # A little tolerance: 0.3 / 0.1 is 2.9999999999999996, and must not tick at 0.3 again.
            group = _Group(period_s, math.floor(now_s / period_s + 1e-9) + 1)
            self._groups[period_s] = group
            self._push(group.deadline_s, group)
        group.targets[id(target)] = target
        self._group_of[id(target)] = group

    def cancel(self, target: Any) -> None:
        """Ends the ticks of `target`, if it has any."""
        group = self._group_of.pop(id(target), None)
        if group is not None:
            del group.targets[id(target)]

    def at(self, time_s: float, call: Callable[[], None]) -> None:
        """Hands out `call` once, when `time_s` is reached."""
        self._push(time_s, call)

    def _push(self, time_s: float, entry: _Group | Callable[[], None]) -> None:
        heapq.heappush(self._heap, (time_s, next(self._order), entry))
        self.next_s = self._heap[0][0]

    def due(self, now_s: float) -> list[Due | Callable[[], None]]:
        """Takes out what is due at `now_s`, oldest first."""
        out: list[Due | Callable[[], None]] = []
        heap = self._heap
        while heap and heap[0][0] <= now_s:
            entry = heap[0][2]
            if not isinstance(entry, _Group):
                heapq.heappop(heap)
                out.append(entry)
                continue
            period_s, number = entry.period_s, entry.number
            if not entry.targets:
                heapq.heappop(heap)
                del self._groups[period_s]
                continue
            missed = max(0, math.floor(now_s / period_s + 1e-9) - number)
            number += missed
            out.append(Due(iter(tuple(entry.targets.values())), number * period_s, missed))
            entry.number = number = number + 1
            heapq.heapreplace(heap, (number * period_s, next(self._order), entry))
        self.next_s = heap[0][0] if heap else math.inf
        return out
