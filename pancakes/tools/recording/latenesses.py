"""Which ticks of an agent's tasks ran, and how late they were, counted while it is recorded."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import Final

from msgspec import Struct

from pancakes.runtime.kernel.handlers import Tick
from pancakes.runtime.kernel.task_timer import HeardTick, TaskTimer

STEP: Final = 2.0**0.25
"""The upper edge of a bucket is this many times that of the bucket below: a quantile is right to within 10 %."""
LEAST_S: Final = 1e-6
"""The lowest bucket, number 0, reaches up to here."""
MOST: Final = 100_000
"""At most so many ticks wait to be counted: a second of a thousand tasks at 100 Hz."""
NEAR_S: Final = 1e-6
"""Deadlines that are no further apart are the same one: the first and the period give others only about."""
LATE_PERIODS: Final = 0.5
"""A tick is late that came later than this share of its period, ..."""
LATE_S: Final = 0.25
"""... or than this, in mission time."""


def bucket_of(lateness_s: float) -> int:
    """Returns the number of the bucket that a lateness belongs to."""
    return max(0, math.ceil(4.0 * math.log2(lateness_s / LEAST_S))) if lateness_s > LEAST_S else 0


def quantile_s(counts: Mapping[int, int], share: float) -> float | None:
    """Returns the lateness that this share of all ticks stayed below.

    Args:
        counts: how many ticks there were in each bucket.
        share: from 0 to 1.

    Returns:
        The middle of the bucket that it lies in, in seconds; 0 in the lowest; None where there was no tick.
    """
    left = share * sum(counts.values())
    for bucket, count in sorted(counts.items()):
        left -= count
        if left <= 0:
            return LEAST_S * STEP ** (bucket - 0.5) if bucket else 0.0
    return None


class TickRun(Struct, gc=False):
    """Ticks of a timer that ran one after the other, none of them missed or late but the first.

    Attributes:
        first_s: the deadline of the first, in mission time.
        period_s: from one to the next; 0 if the timer rested already when the only one ran.
        count: how many they are.
        missed: how many ticks before the first were missed, as the task was told.
        lateness_s: how late the first was, in mission time; 0 if it was not late, as all others were not.
    """

    first_s: float
    period_s: float
    count: int
    missed: int
    lateness_s: float = 0.0

    @classmethod
    def begun_by(cls, tick: Tick, period_s: float) -> TickRun:
        """Returns a run of one tick."""
        return cls(tick.time_s, period_s, 1, tick.missed, tick.lateness_s if _is_late(tick, period_s) else 0.0)

    def goes_on_with(self, tick: Tick, period_s: float) -> bool:
        """Returns whether a tick is the next one of the run."""
        next_s = self.first_s + self.count * self.period_s
        near = period_s == self.period_s and abs(next_s - tick.time_s) < NEAR_S
        return near and not tick.missed and not _is_late(tick, period_s)


def _is_late(tick: Tick, period_s: float) -> bool:
    return tick.lateness_s > min(LATE_PERIODS * period_s, LATE_S)


class Latenesses:
    """Counts ticks by their lateness, and notes their deadlines, in the recorder's thread.

    Attributes:
        heard: takes a tick, in the task's turn. It is the append of a list: each further call would delay the tick.
        runs: the ticks that `take` counted last, by timer; in order.
        overflowed: whether some ticks before these were lost, because too many waited.
    """

    def __init__(self) -> None:
        self._heard: deque[HeardTick] = deque(maxlen=MOST)
        self.heard: Callable[[HeardTick], None] = self._heard.append
        self.runs: dict[TaskTimer, list[TickRun]] = {}
        self.overflowed = False

    def take(self) -> Mapping[TaskTimer, Mapping[int, int]]:
        """Returns how many ticks there were in each bucket since the last time, by timer."""
        counts: dict[TaskTimer, Counter[int]] = {}
        runs = self.runs = {}
        waiting = len(self._heard)
        self.overflowed = waiting == MOST
        for _ in range(waiting):
            try:
                timer, tick, period_s = self._heard.popleft()
            except IndexError:  # an old one fell out just now
                break
            counts.setdefault(timer, Counter())[bucket_of(tick.lateness_s)] += 1
            period_s = period_s if period_s < math.inf else 0.0
            own = runs.setdefault(timer, [])
            if own and own[-1].goes_on_with(tick, period_s):
                own[-1].count += 1
            else:
                own.append(TickRun.begun_by(tick, period_s))
        return counts
