"""Lets fewer things through than arrive, at an even rate."""

from __future__ import annotations

_EARLY = 0.25


class Pace:
    """Lets through at most so many of the things that come, evenly.

    A thing that is a quarter of a period early counts as being in time, so that a source of the same rate that is not
    quite regular does not lose every other one; in the long run the rate is kept all the same.

    Args:
        rate_hz: how many a second may pass.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_s = 1.0 / rate_hz
        self._next_s = 0.0

    def due(self, time_s: float) -> bool:
        """Something comes at `time_s`; returns whether it may pass."""
        if time_s < self._next_s - _EARLY * self._period_s:
            return False
        # A gap is not made up for afterwards.
        next_s, gap_s = self._next_s + self._period_s, time_s + (1.0 - _EARLY) * self._period_s
        self._next_s = next_s if next_s > gap_s else gap_s
        return True
