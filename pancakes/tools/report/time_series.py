"""Keep values over time, counts in slots, and distributions in bounded memory, however long a recording is. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final

MOST_POINTS: Final = 3000
"""The most points of a time series: more than a picture can show."""
MOST_SLOTS: Final = 160
MOST_SAMPLES: Final = 5000


@dataclass
class Thinned:
    """Items in bounded memory. If they become too many, every second one is dropped, now and from then on.

    Attributes:
        most: the most items that are kept.
        kept: the items that were kept, oldest first.
        count: how many items were added.
        stride: one of this many is kept.
    """

    most: int
    kept: list[Any] = field(default_factory=list)
    count: int = 0
    stride: int = 1

    def add(self, item: Any, /) -> None:
        """Add an item."""
        if self.count % self.stride == 0:
            self.kept.append(item)
            if len(self.kept) > self.most:
                self.kept = self.kept[::2]
                self.stride *= 2
        self.count += 1


class TimeSeries(Thinned):
    """Points in the order of time: the time of each, in seconds, and its values.

    Attributes:
        last: the newest point, whether it was kept or not.
    """

    last: tuple[Any, ...] | None = None

    def __init__(self) -> None:
        super().__init__(MOST_POINTS)

    def add(self, *point: Any) -> None:
        """Add a point: its time and its values."""
        self.last = point
        super().add(point)

    def whole(self) -> list[tuple[Any, ...]]:
        """Return the kept points, and the newest one."""
        if self.last is not None and self.kept[-1] is not self.last:
            return [*self.kept, self.last]
        return self.kept


@dataclass
class Counts:
    """Counts in time slots of equal length. If there are too many slots, their length is doubled.

    Attributes:
        slot_s: the length of a slot, in seconds.
        slots: the count in each slot, by kind.
    """

    slot_s: float = 1.0
    slots: dict[str, dict[int, float]] = field(default_factory=dict)

    def add(self, t_s: float, kind: str, number: float = 1.0) -> None:
        """Count something at a time; the times may come in any order."""
        slot = int(t_s // self.slot_s)
        while slot >= MOST_SLOTS:
            self.slot_s *= 2.0
            self.slots = {name: _halved(counts) for name, counts in self.slots.items()}
            slot = int(t_s // self.slot_s)
        counts = self.slots.setdefault(kind, {})
        counts[slot] = counts.get(slot, 0.0) + number

    def total(self, kind: str) -> float:
        """Return the total of a kind."""
        return sum(self.slots.get(kind, {}).values())

    def rates(self, kind: str, end_s: float) -> list[tuple[float, float]]:
        """Return the rate of a kind per second in each slot: the time of the slot's middle, and the rate."""
        counts = self.slots.get(kind, {})
        rates = []
        for slot in range(max(1, math.ceil(end_s / self.slot_s))):
            begin_s = slot * self.slot_s
            # The end cuts the last slot short, and the rate of a short slot says little.
            length_s = min(self.slot_s, end_s - begin_s)
            if length_s == self.slot_s or slot < 3:
                rates.append((begin_s + length_s / 2, counts.get(slot, 0.0) / max(length_s, 1e-3)))
        return rates


def _halved(counts: dict[int, float]) -> dict[int, float]:
    halved: dict[int, float] = {}
    for slot, number in counts.items():
        halved[slot // 2] = halved.get(slot // 2, 0.0) + number
    return halved


class Distribution(Thinned):
    """The distribution of values.

    Attributes:
        largest: the largest of all values, kept or not.
    """

    largest = -math.inf

    def __init__(self) -> None:
        super().__init__(MOST_SAMPLES)

    def add(self, value: float, /) -> None:
        """Add a value."""
        super().add(value)
        self.largest = max(self.largest, value)

    def quantile(self, share: float) -> float:
        """Return the quantile for a share from 0 to 1."""
        ordered = sorted(self.kept)
        return float(ordered[min(len(ordered) - 1, int(share * len(ordered)))])

    def quantiles(self) -> dict[str, float]:
        """Return the percentiles `p50`, `p90` and `p99`."""
        return {f"p{round(100 * share)}": self.quantile(share) for share in (0.5, 0.9, 0.99)}
