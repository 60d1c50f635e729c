"""What a benchmark says: a figure of ours beside the same figure of something bare, run by run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any

WIDE = 1.5
"""Rounds differ much where the highest ratio is so many times the lowest."""


@dataclass(frozen=True)
class Plan:
    """How thoroughly to measure.

    Attributes:
        rounds: how often each side is measured, in turns.
        scale: the share of the usual work that each run does.
        most_rounds: how often where the rounds differ much.
    """

    rounds: int = 5
    scale: float = 1.0
    most_rounds: int = 0

    def share(self, number: int) -> int:
        """Returns how much of something a run does where `number` is the usual."""
        return max(1, round(number * self.scale))


@dataclass
class Figure:
    """One thing that was measured, on both sides where there is something to compare it with.

    Attributes:
        name: what it is.
        unit: of both sides.
        wanted: what the ratio is to be; None where nothing is asked for.
        sense: `max` where the ratio is to be at most `wanted`, `min` where at least.
        runs: ours, in the order in which they were measured.
        bare_runs: the baseline's; the one at the same place was measured in the same round. Empty where there is no
            baseline.
        absolute: whether not the ratio, but the value itself is to be as `wanted` says.
        least: whether the smallest of the runs counts, not the median: processor time, to which other work on the
            machine only adds.
    """

    name: str
    unit: str
    sense: str = "max"
    wanted: float | None = None
    runs: list[float] = field(default_factory=list)
    bare_runs: list[float] = field(default_factory=list)
    absolute: bool = False
    least: bool = False

    @property
    def value(self) -> float:
        """Ours: the median, or the smallest."""
        return min(self.runs) if self.least else median(self.runs)

    @property
    def baseline(self) -> float | None:
        """The baseline's, if there is one, likewise."""
        if not self.bare_runs:
            return None
        return min(self.bare_runs) if self.least else median(self.bare_runs)

    @property
    def ratio(self) -> float | None:
        """Ours, of the baseline's, if there is one."""
        return self.value / self.baseline if self.baseline is not None else None

    @property
    def spread(self) -> tuple[float, float]:
        """The smallest and the largest of any round: of the ratios, or of the values where there is no baseline."""
        if not self.bare_runs:
            return min(self.runs), max(self.runs)
        ratios = [ours / bare for ours, bare in zip(self.runs, self.bare_runs, strict=True)]
        return min(ratios), max(ratios)

    @property
    def is_wide(self) -> bool:
        """Whether its rounds differ so much that more of them are needed."""
        if self.wanted is None:
            return False  # its baseline may be 0, as that of modules which only we have
        low, high = self.spread
        return high > WIDE * low

    @property
    def is_missed(self) -> bool:
        """Whether it is not what is wanted."""
        judged = self.value if self.absolute else self.ratio
        if self.wanted is None or judged is None:
            return False
        return judged > self.wanted if self.sense == "max" else judged < self.wanted

    def record(self) -> dict[str, Any]:
        """Returns the figure as plain values."""
        return {
            "name": self.name,
            "value": self.value,
            "unit": self.unit,
            "baseline": self.baseline,
            "ratio": self.ratio,
            "wanted": self.wanted,
            "absolute": self.absolute,
            "sense": self.sense,
            "runs": self.runs,
            "baseline_runs": self.bare_runs,
        }


@dataclass(frozen=True)
class Missing:
    """Something beside which nothing could be measured.

    Attributes:
        name: what it is.
        reason: why.
    """

    name: str
    reason: str

    def record(self) -> dict[str, Any]:
        """Returns it as plain values."""
        return {"name": self.name, "missing": self.reason}


@dataclass(frozen=True)
class Failed:
    """A topic that did not come to its end.

    Attributes:
        name: the topic.
        reason: why.
    """

    name: str
    reason: str

    def record(self) -> dict[str, Any]:
        """Returns it as plain values."""
        return {"name": self.name, "failed": self.reason}


Side = tuple[Callable[[], list[float]], Sequence[list[float]]]
"""What measures a side once, and where each of its values goes."""


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
    sides = [(ours, [figure.runs for figure in figures]), (bare, [figure.bare_runs for figure in figures])]
    return in_turns_of_all(plan, sides, figures)


def in_turns_of_all(plan: Plan, sides: Sequence[Side], figures: list[Figure]) -> list[Figure]:
    """Measures any number of sides in turns, each round beginning with the next one, and returns the figures.

    Args:
        plan: how often.
        sides: what measures each, and where its values go; figures may share these lists.
        figures: what the lists belong to.
    """
    for number in range(max(plan.rounds, plan.most_rounds)):
        if number >= plan.rounds and not any(figure.is_wide for figure in figures):
            break
        first = number % len(sides)
        for measure, lists in (*sides[first:], *sides[:first]):
            for runs, value in zip(lists, measure(), strict=True):
                runs.append(value)
    return figures


def alone(plan: Plan, figures: list[Figure], ours: Callable[[], list[float]]) -> list[Figure]:
    """Measures what has no baseline, and returns the figures filled in; the arguments are those of `in_turns`."""
    return in_turns_of_all(plan, [(ours, [figure.runs for figure in figures])], figures)
