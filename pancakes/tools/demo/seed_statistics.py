"""Ranges of seeds such as `1-200` or `3,17,20-29`, and the spread of figures over many missions. Pure."""

from __future__ import annotations

import re
import statistics
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

MOST: Final = 100_000
"""The most seeds of one run; more are probably a typing error."""
_HOW: Final = "write seeds as 1-200, or as 3,17,20-29"


def seeds_of(text: str) -> tuple[int, ...]:
    """Parse ranges of seeds; return them in ascending order and without duplicates.

    Raises:
        ValueError: the text is malformed; the message is a sentence.
    """
    found: set[int] = set()
    for part in text.replace(" ", "").split(","):
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", part, re.ASCII)
        if match is None:
            raise ValueError(f"{part or text!r} is not a range of seeds: {_HOW}")
        if len(part) > 2 * 19 + 1:
            raise ValueError(f"{part!r} has a seed of more than 18 digits: {_HOW}")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise ValueError(f"{part!r} ends before it begins: write {last}-{first}")
        if last - first >= MOST or len(found) + last - first >= MOST:
            raise ValueError(f"{text!r} names more than {MOST:,} seeds: run them in parts")
        found.update(range(first, last + 1))
    return tuple(sorted(found))


def text_of_seeds(seeds: Iterable[int]) -> str:
    """Format seeds for `seeds_of`, with consecutive ones as ranges."""
    parts: list[list[int]] = []
    for seed in sorted(set(seeds)):
        if parts and parts[-1][1] == seed - 1:
            parts[-1][1] = seed
        else:
            parts.append([seed, seed])
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in parts)


_GIVEN: Final = ("seed", "duration_s")
"""The keys of a summary that repeat options, and are not figures of the mission."""


@dataclass(frozen=True, slots=True)
class Spread:
    """One figure of many missions.

    Attributes:
        figure: its path in the summary, such as `radius_error_m.agent1.max`.
        missions: how many missions have it; in the others it is null or missing.
        min: the smallest value.
        median: the median.
        max: the largest value.
    """

    figure: str
    missions: int
    min: float
    median: float
    max: float

    @property
    def differs(self) -> bool:
        """Whether its values differ."""
        return self.min != self.max


def spreads_of(summaries: Iterable[Mapping[str, Any]]) -> list[Spread]:
    """Return the spread of each figure in the summaries, in the order of first appearance."""
    found: dict[str, list[float]] = {}
    for summary in summaries:
        for figure, value in figures_of({key: value for key, value in summary.items() if key not in _GIVEN}):
            found.setdefault(figure, []).append(value)
    return [
        Spread(figure, len(values), min(values), statistics.median(values), max(values))
        for figure, values in found.items()
    ]


def figures_of(summary: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, float]]:
    """Yield the numbers of a summary with their paths, including those in tables but not those in lists."""
    for key, value in summary.items():
        if isinstance(value, Mapping):
            yield from figures_of(value, f"{before}{key}.")
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            yield f"{before}{key}", value
