"""The feedback law: regulates the effort so that the battery lasts until a wanted end (pure).

After Abdelzaher et al. ("Feedback performance control in software services", IEEE Control Systems 23(3), 2003), the
paper's reference [7]: software has knobs, a controller turns them so that a measured quantity meets its set-point.
Two loops share the knobs:

- *consumption*: the set-point is what the battery may lose each second, `(level - reserve) / time left`; measured is
  what it did lose since the last decision, by a straight line through its readings.
- *processor load*, where a limit is set: measured is its moving average.

Each integrates its relative error, `effort += gain (set-point - measured) / set-point`, within 0 to 1, and the lower
of the two efforts counts. Where consumption is `p0 + p1 effort`, the first loop converges for `gain p1 < 2 set-point`,
and does not overshoot for half of that. Past the wanted end it rests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

from msgspec import Meta

from pancakes.bodies.energy.knobs import Duration, PositiveShare, Share

LEAST_READINGS: Final = 3
"""A line through fewer readings says nothing."""
LOAD_WEIGHT: Final = 0.2
"""How much a new reading counts in the average of the processor's load."""


@dataclass
class FeedbackSettings:
    """What the battery is to last for, and how that is regulated.

    Attributes:
        until_s: the mission time until which it is to last.
        reserve: the level that it is to have then.
        period_s: from one decision to the next. In it the battery must lose more than its readings are off by.
        gain: how strongly an error is acted on.
        least_change: the effort stays as it is where it would change by less, so that not every tremor is an order.
        load_at_most: the share of the processor's time that may be in use, as the device `load` tells it; None: any.
    """

    until_s: Duration
    reserve: Share = 0.05
    period_s: Duration = 30.0
    gain: Annotated[float, Meta(gt=0, le=2)] = 0.3
    least_change: Share = 0.05
    load_at_most: PositiveShare | None = None


class Feedback:
    """The two loops.

    Args:
        settings: what is wanted.
        now_s: the mission time.
        effort: where to begin.

    Attributes:
        effort: what was decided last.
    """

    def __init__(self, settings: FeedbackSettings, now_s: float, effort: float = 1.0) -> None:
        self._settings = settings
        self._next_s = now_s + settings.period_s
        self._by_battery = effort
        self._by_load = 1.0
        self._readings: list[tuple[float, float]] = []
        self._load: float | None = None
        self.effort = effort

    def battery(self, now_s: float, level: float) -> None:
        """Takes a reading of the battery's level."""
        self._readings.append((now_s, level))

    def load(self, cpu: float) -> None:
        """Takes a reading of the processor's load, from 0 to 1."""
        self._load = cpu if self._load is None else self._load + LOAD_WEIGHT * (cpu - self._load)

    def decide(self, now_s: float) -> float:
        """Returns the effort; it changes once in a period at the most."""
        settings = self._settings
        if now_s < self._next_s:
            return self.effort
        self._next_s = now_s + settings.period_s
        readings, self._readings = self._readings, []
        if now_s < settings.until_s and len(readings) >= LEAST_READINGS:
            self._regulate_consumption(readings, now_s)
        if settings.load_at_most is not None and self._load is not None:
            error = (settings.load_at_most - self._load) / settings.load_at_most
            self._by_load = _within(self._by_load + settings.gain * _bounded(error))
        wish = min(self._by_battery, self._by_load)
        if abs(wish - self.effort) >= settings.least_change or (wish in (0.0, 1.0)):
            self.effort = wish
        return self.effort

    def _regulate_consumption(self, readings: Sequence[tuple[float, float]], now_s: float) -> None:
        settings = self._settings
        consumed = -slope(readings)
        left_s = max(settings.until_s - now_s, settings.period_s)
        allowed = (readings[-1][1] - settings.reserve) / left_s
        if allowed <= 0.0:
            self._by_battery = 0.0
            return
        self._by_battery = _within(self._by_battery + settings.gain * _bounded((allowed - consumed) / allowed))


def slope(points: Sequence[tuple[float, float]]) -> float:
    """Returns the slope of the straight line that fits points (x, y) best, by least squares."""
    count = len(points)
    mean_x = sum(x for x, _ in points) / count
    mean_y = sum(y for _, y in points) / count
    spread = sum((x - mean_x) ** 2 for x, _ in points)
    return sum((x - mean_x) * (y - mean_y) for x, y in points) / spread if spread > 0.0 else 0.0


def _bounded(error: float) -> float:
    return min(max(error, -1.0), 1.0)


def _within(effort: float) -> float:
    # Clamped as a whole, so that a loop that has no say does not wind up.
    return round(min(max(effort, 0.0), 1.0), 4)
