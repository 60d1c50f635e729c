"""What a benchmark says: a figure of ours beside the same figure of something bare, run by run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from statistics import median
from typing import Any


@dataclass(frozen=True)
class Plan:
    """How thoroughly to measure.

    Attributes:
        rounds: how often each side is measured, in turns.
        scale: the share of the usual work that each run does.
    """

    rounds: int = 5
    scale: float = 1.0

    def share(self, number: int) -> int:
        """Returns how much of something a run does where `number` is the usual."""
        return max(1, round(number * self.scale))


@dataclass
class Figure:
    """One thing that was measured on both sides.

    Attributes:
        name: what it is.
        unit: of both sides.
        wanted: what the ratio is to be; None where nothing is asked for.
        sense: `max` where the ratio is to be at most `wanted`, `min` where at least.
        runs: ours, in the order in which they were measured.
        bare_runs: the baseline's; the one at the same place was measured in the same round.
    """

    name: str
    unit: str
    sense: str = "max"
    wanted: float | None = None
    runs: list[float] = field(default_factory=list)
    bare_runs: list[float] = field(default_factory=list)

    @property
    def value(self) -> float:
        """Ours: the median."""
        return median(self.runs)

    @property
    def baseline(self) -> float:
        """The baseline's median."""
        return median(self.bare_runs)

    @property
    def ratio(self) -> float:
        """Ours, of the baseline's."""
        return self.value / self.baseline

    @property
    def spread(self) -> tuple[float, float]:
        """The smallest and the largest ratio of any round."""
        ratios = [ours / bare for ours, bare in zip(self.runs, self.bare_runs, strict=True)]
        return min(ratios), max(ratios)

    @property
    def is_missed(self) -> bool:
        """Whether the ratio is not what is wanted."""
        if self.wanted is None:
            return False
        return self.ratio > self.wanted if self.sense == "max" else self.ratio < self.wanted

    def record(self) -> dict[str, Any]:
        """Returns the figure as plain values."""
        return {
            "name": self.name,
            "value": self.value,
            "unit": self.unit,
            "baseline": self.baseline,
            "ratio": self.ratio,
            "wanted": self.wanted,
            "sense": self.sense,
            "runs": self.runs,
            "baseline_runs": self.bare_runs,
        }


def in_turns(
    plan: Plan, figures: list[Figure], ours: Callable[[], list[float]], bare: Callable[[], list[float]]
) -> list[Figure]:
    """Measures both sides in turns, ours first in every other round, and returns the figures filled in.

    Args:
        plan: how often.
        figures: what each side returns the values of, in this order.
        ours: one run of ours.
        bare: one run of the baseline.
    """
    for number in range(plan.rounds):
        sides: list[tuple[Callable[[], list[float]], str]] = [(ours, "runs"), (bare, "bare_runs")]
        for side, runs in sides if number % 2 == 0 else reversed(sides):
            for figure, value in zip(figures, side(), strict=True):
                getattr(figure, runs).append(value)
    return figures
