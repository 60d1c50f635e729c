"""Policies of an energy governor: from the battery's level to the effort, by thresholds or by feedback. Pure.

`Thresholds`: each level of the battery has its effort, with hysteresis.

`Feedback` regulates the effort so that the battery lasts until a wanted end. After Abdelzaher et al. ("Feedback
performance control in software services", IEEE Control Systems 23(3), 2003), the paper's reference [7]. Two loops: the
consumption, with the set-point `(level - reserve) / time left`, measured by a straight line through the readings; and
the processor load, if a limit is set, measured as a moving average. Each integrates its relative error, `effort += gain
(set-point - measured) / set-point`, within 0 to 1; the lower effort counts. If consumption is `p0 + p1 effort`, the
first loop converges for `gain p1 < 2 set-point`, and does not overshoot for half of that. It rests after the wanted
end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

from msgspec import Meta

from pancakes.energy.orders import Duration
from pancakes.settings import PositiveShare, Share


@dataclass
class Step:
    """One threshold.

    Attributes:
        below: it is in force once the battery's level falls below this.
        effort: what the robot may still do then, from 0 to 1.
    """

    below: PositiveShare
    effort: Share


class Thresholds:
    """Find the step on which the battery stands.

    It goes down a step as soon as the level lies below it, and up again only when the level has risen `hysteresis`
    above it. So a level that wavers by less than that changes nothing.

    Args:
        steps: the thresholds, from the highest.
        hysteresis: how far above a threshold the level must rise before it no longer counts.
    """

    def __init__(self, steps: Sequence[Step], hysteresis: float) -> None:
        self._steps = tuple(steps)
        self._hysteresis = hysteresis
        self._passed = 0

    def resume(self, effort: float) -> None:
        """Continue from the effort that an earlier policy decided on, so that hysteresis outlives a restart."""
        self._passed = sum(1 for step in self._steps if step.effort >= effort)

    def decide(self, level: float) -> float:
        """Return the effort for a level of the battery, both from 0 to 1."""
        while self._passed < len(self._steps) and level < self._steps[self._passed].below:
            self._passed += 1
        while self._passed > 0 and level >= self._steps[self._passed - 1].below + self._hysteresis:
            self._passed -= 1
        return self._steps[self._passed - 1].effort if self._passed else 1.0


def faults_of(steps: Sequence[Step], hysteresis: float) -> str:
    """Return what is wrong with thresholds, as a sentence; empty: nothing."""
    for higher, lower in zip(steps, steps[1:], strict=False):
        if lower.below >= higher.below or lower.effort >= higher.effort:
            return "the thresholds must go down, each with a lower effort than the one before"
    if steps and steps[0].effort >= 1.0:
        return "an effort of 1 is in force above all thresholds; the first threshold must ask for less"
    if steps and steps[0].below + hysteresis > 1.0:
        return f"a full battery never rises {hysteresis:g} above {steps[0].below:g}: that threshold would never end"
    return ""


LEAST_READINGS: Final = 3
"""A line through fewer readings says nothing."""
LOAD_WEIGHT: Final = 0.2
"""How much a new reading counts in the average of the processor's load."""


@dataclass
class FeedbackSettings:
    """Until when the battery must last, and how that is regulated.

    Attributes:
        until_s: the mission time until which it must last.
        reserve: the level that it must have then.
        period_s: from one decision to the next. In it the battery must lose more than its readings are off by.
        gain: how strongly an error is acted on.
        least_change: the effort stays as it is if it would change by less, so that noise causes no orders.
        load_at_most: the share of the processor's time that may be in use, as the device `load` measures it; None: any.
    """

    until_s: Duration
    reserve: Share = 0.05
    period_s: Duration = 30.0
    gain: Annotated[float, Meta(gt=0, le=2)] = 0.3
    least_change: Share = 0.05
    load_at_most: PositiveShare | None = None


class Feedback:
    """Regulate the effort by two loops.

    Args:
        settings: what is wanted.
        now_s: the mission time.
        effort: where to begin.

    Attributes:
        effort: the last decision.
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
        """Take a reading of the battery's level."""
        self._readings.append((now_s, level))

    def load(self, cpu: float) -> None:
        """Take a reading of the processor's load, from 0 to 1."""
        self._load = cpu if self._load is None else self._load + LOAD_WEIGHT * (cpu - self._load)

    def decide(self, now_s: float) -> float:
        """Return the effort; it changes at most once in a period."""
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
        effort = min(self._by_battery, self._by_load)
        if abs(effort - self.effort) >= settings.least_change or effort in (0.0, 1.0):
            self.effort = effort
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
    """Return the slope of the straight line that fits points (x, y) best, by least squares."""
    count = len(points)
    mean_x = sum(x for x, _ in points) / count
    mean_y = sum(y for _, y in points) / count
    spread = sum((x - mean_x) ** 2 for x, _ in points)
    return sum((x - mean_x) * (y - mean_y) for x, y in points) / spread if spread > 0.0 else 0.0


def _bounded(error: float) -> float:
    return min(max(error, -1.0), 1.0)


def _within(effort: float) -> float:
    # Clamped as a whole, so that a loop that does not decide does not wind up.
    return round(min(max(effort, 0.0), 1.0), 4)
