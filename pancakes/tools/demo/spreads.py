"""How far the figures of many missions lie apart. Pure."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

_GIVEN: Final = ("seed", "duration_s")
"""What a summary repeats of what was asked for: no figure of the mission."""


@dataclass(frozen=True, slots=True)
class Spread:
    """One figure of many missions.

    Attributes:
        figure: where it stands in a summary, as `radius_error_m.agent1.max`.
        missions: so many missions have it; in the others it is null or not there.
        min: the smallest.
        median: half of them are no larger.
        max: the largest.
    """

    figure: str
    missions: int
    min: float
    median: float
    max: float

    @property
    def differs(self) -> bool:
        """Whether the missions differ in it."""
        return self.min != self.max


def spreads_of(summaries: Iterable[Mapping[str, Any]]) -> list[Spread]:
    """Returns the spread of each figure that stands in summaries, in the order in which they first come."""
    found: dict[str, list[float]] = {}
    for summary in summaries:
        for figure, value in figures_of({key: value for key, value in summary.items() if key not in _GIVEN}):
            found.setdefault(figure, []).append(value)
    return [
        Spread(figure, len(values), min(values), statistics.median(values), max(values))
        for figure, values in found.items()
    ]


def figures_of(summary: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, float]]:
    """Yields the numbers of a summary with where they stand, those in tables too; what is in lists is left out."""
    for key, value in summary.items():
        if isinstance(value, Mapping):
            yield from figures_of(value, f"{before}{key}.")
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            yield f"{before}{key}", value
