"""The policy of thresholds: each level of the battery has its effort, with hysteresis (pure)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pancakes.bodies.energy.knobs import PositiveShare, Share


@dataclass
class Step:
    """One threshold.

    Attributes:
        below: it counts from where the battery's level falls below this.
        effort: what the robot may still do then, from 0 to 1.
    """

    below: PositiveShare
    effort: Share


class Thresholds:
    """Knows on which step the battery stands.

    It goes down a step as soon as the level lies below it, and up again only where the level has risen `hysteresis`
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
        """Goes on where a policy stood that had decided on an effort, so that hysteresis outlives a restart."""
        self._passed = sum(1 for step in self._steps if step.effort >= effort)

    def decide(self, level: float) -> float:
        """Returns the effort for a level of the battery, both from 0 to 1."""
        while self._passed < len(self._steps) and level < self._steps[self._passed].below:
            self._passed += 1
        while self._passed > 0 and level >= self._steps[self._passed - 1].below + self._hysteresis:
            self._passed -= 1
        return self._steps[self._passed - 1].effort if self._passed else 1.0


def faults_of(steps: Sequence[Step], hysteresis: float) -> str:
    """Returns what is wrong with thresholds, as a sentence; empty: nothing."""
    for higher, lower in zip(steps, steps[1:], strict=False):
        if lower.below >= higher.below or lower.effort >= higher.effort:
            return "the thresholds must go down, each with a lower effort than the one before"
    if steps and steps[0].effort >= 1.0:
        return "an effort of 1 is in force above all thresholds; the first threshold must ask for less"
    if steps and steps[0].below + hysteresis > 1.0:
        return f"a full battery never rises {hysteresis:g} above {steps[0].below:g}: that threshold would never end"
    return ""
