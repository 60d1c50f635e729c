"""Values over time in bounded memory, however long a recording is. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final

MOST_POINTS: Final = 3000
"""More than a picture can show."""
MOST_SLOTS: Final = 160
MOST_SAMPLES: Final = 5000


@dataclass
class TimeSeries:
    """Points in the order of time. Where they become too many, every other one is left out, and of those to come.

    Attributes:
        points: the time of each, in seconds, and its values.
        last: the newest point, whether it was kept or not.
    """

    points: list[tuple[Any, ...]] = field(default_factory=list)
    last: tuple[Any, ...] | None = None
    _stride: int = 1
    _count: int = 0

    def add(self, *point: Any) -> None:
        """Adds a point: its time and its values."""
        self.last = point
        if self._count % self._stride == 0:
            self.points.append(point)
            if len(self.points) > MOST_POINTS:
                self.points = self.points[::2]
                self._stride *= 2
        self._count += 1

    def whole(self) -> list[tuple[Any, ...]]:
        """Returns the points, the newest one included."""
        if self.last is not None and self.points[-1] is not self.last:
            return [*self.points, self.last]
        return self.points


@dataclass
class Counts:
    """How much there was in slots of equal length; where the slots become too many, they become longer.

    Attributes:
        slot_s: how long a slot is.
        slots: what was counted in each, by kind.
    """

    slot_s: float = 1.0
    slots: dict[str, dict[int, float]] = field(default_factory=dict)

    def add(self, t_s: float, kind: str, number: float = 1.0) -> None:
        """Counts something at a time; times need no order."""
        slot = int(t_s // self.slot_s)
        while slot >= MOST_SLOTS:
            self.slot_s *= 2.0
            self.slots = {name: _halved(counts) for name, counts in self.slots.items()}
            slot = int(t_s // self.slot_s)
        counts = self.slots.setdefault(kind, {})
        counts[slot] = counts.get(slot, 0.0) + number

    def total(self, kind: str) -> float:
        """Returns all of a kind."""
        return sum(self.slots.get(kind, {}).values())

    def rates(self, kind: str, end_s: float) -> list[tuple[float, float]]:
        """Returns how much a second there was of a kind, slot by slot: the time of its middle, and the rate."""
        counts = self.slots.get(kind, {})
        rates = []
        for slot in range(max(1, math.ceil(end_s / self.slot_s))):
            begin_s = slot * self.slot_s
            # The last slot is cut short by the end; a part of one says little.
            length_s = min(self.slot_s, end_s - begin_s)
            if length_s == self.slot_s or slot < 3:
                rates.append((begin_s + length_s / 2, counts.get(slot, 0.0) / max(length_s, 1e-3)))
        return rates


def _halved(counts: dict[int, float]) -> dict[int, float]:
    halved: dict[int, float] = {}
    for slot, number in counts.items():
        halved[slot // 2] = halved.get(slot // 2, 0.0) + number
    return halved


@dataclass
class Distribution:
    """Values of which a distribution is wanted. Where they become too many, every other one is left out.

    Attributes:
        values: those that were kept.
        count: how many there were.
        largest: of all.
    """

    values: list[float] = field(default_factory=list)
    count: int = 0
    largest: float = -math.inf
    _stride: int = 1

    def add(self, value: float) -> None:
        """Adds a value."""
        if self.count % self._stride == 0:
            self.values.append(value)
            if len(self.values) > MOST_SAMPLES:
                self.values = self.values[::2]
                self._stride *= 2
        self.count += 1
        self.largest = max(self.largest, value)

    def quantile(self, share: float) -> float:
        """Returns the value that this share of all stayed below, from 0 to 1."""
        ordered = sorted(self.values)
        return ordered[min(len(ordered) - 1, int(share * len(ordered)))]
