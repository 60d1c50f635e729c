"""How late the ticks of an agent's tasks were, counted while it is recorded."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import Final

from pancakes.runtime.kernel.task_timer import TaskTimer

STEP: Final = 2.0**0.25
"""The upper edge of a bucket is this many times that of the bucket below: a quantile is right to within 10 %."""
LEAST_S: Final = 1e-6
"""The lowest bucket, number 0, reaches up to here."""
MOST: Final = 100_000
"""At most so many ticks wait to be counted: a second of a thousand tasks at 100 Hz."""


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


class Latenesses:
    """Counts ticks by their lateness, in the recorder's thread.

    Attributes:
        heard: takes a timer and its lateness, in the task's turn. It is the append of a list: each further call would
            delay the tick.
    """

    def __init__(self) -> None:
        self._heard: deque[tuple[TaskTimer, float]] = deque(maxlen=MOST)
        self.heard: Callable[[tuple[TaskTimer, float]], None] = self._heard.append

    def take(self) -> Mapping[TaskTimer, Mapping[int, int]]:
        """Returns how many ticks there were in each bucket since the last time, by timer."""
        counts: dict[TaskTimer, Counter[int]] = {}
        for _ in range(len(self._heard)):
            try:
                timer, lateness_s = self._heard.popleft()
            except IndexError:  # an old one fell out just now
                break
            counts.setdefault(timer, Counter())[bucket_of(lateness_s)] += 1
        return counts
