"""Keep the numbers that a page can plot: figures of agents and tasks, and the numeric fields of packets. Pure.

A series has a name of two or three words: `SOURCE TYPE FIELD` for a field of a packet
(`agent1/device/battery battery level`), `AGENT FIGURE`, `AGENT/SERVICE/TASK FIGURE` or `A~B FIGURE` for a figure. Times
`t` are seconds on the page's timeline.

Memory is bounded: each series keeps the span of the timeline, at most `HIGHEST_HZ` points a second, and all series
together at most `MOST_POINTS` points. If there are more series than have room, each keeps a shorter time.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from pancakes.packet import Packet, field_names
from pancakes.tools.schema_rows import unit_of
from pancakes.tools.web.timeline import SPAN_S
from pancakes.util.arrays import is_array, is_number

HIGHEST_HZ: Final = 4.0
"""The most points a second of one series."""
MOST_SERIES: Final = 4000
"""The most series; further ones are counted, and not kept."""
MOST_POINTS: Final = 2_000_000
"""The most points of all series together: 32 MB."""
FEWEST_POINTS: Final = 120
"""Each series has room for this many points, however many series there are."""
MOST_FIELDS: Final = 256
"""The most numbers of one packet."""
MOST_ITEMS: Final = 64
"""Numbers in longer lists or larger arrays are not plotted."""
MOST_DEEP: Final = 4
WANTED_S: Final = 10.0
"""How long after the last question of a page its packets are still followed, in seconds."""


class Ring:
    """The newest points of one series."""

    def __init__(self) -> None:
        self.times = array("d")
        self.values = array("d")

    def add(self, t: float, value: float, most: int, since_s: float) -> None:
        """Add a point; drop points before `since_s` and more than `most`, in blocks, so that it costs little."""
        self.times.append(t)
        self.values.append(value)
        spare = 64 + most // 8
        if len(self.times) > most + spare or self.times[0] < since_s - 60.0:
            first = max(len(self.times) - most, bisect_left(self.times, since_s))
            del self.times[:first], self.values[:first]

    def after(self, t: float) -> tuple[array[float], array[float]]:
        """Return the times and values after `t`."""
        first = bisect_left(self.times, math.nextafter(t, math.inf))
        return self.times[first:], self.values[first:]


class SeriesStore:
    """All series of a fleet.

    Args:
        span_s: how far back the series go, in seconds.
        most_points: see `MOST_POINTS`.
        most_series: see `MOST_SERIES`.

    Attributes:
        left_out: how many series were not kept because there were too many.
    """

    def __init__(self, span_s: float = SPAN_S, most_points: int = MOST_POINTS, most_series: int = MOST_SERIES) -> None:
        self._span_s = span_s
        self._most_points = most_points
        self._most_series = most_series
        self._rings: dict[str, Ring] = {}
        self._due: dict[tuple[str, str], float] = {}  # when the next packet is taken, by source and type
        self._channels: dict[tuple[str, str], str] = {}
        self._wanted: dict[tuple[str, str], float] = {}
        self._all_until = -math.inf
        self._refused: set[str] = set()

    @property
    def left_out(self) -> int:
        """How many series were not kept because there were too many."""
        return len(self._refused)

    def add(self, name: str, t: float, value: float | None) -> None:
        """Add a point; None: there is no value now, so the line has a gap."""
        ring = self._rings.get(name)
        if ring is None:
            if value is None or not self._has_room(name):
                return
            ring = self._rings[name] = Ring()
        elif (ring.times and t <= ring.times[-1]) or (value is None and math.isnan(ring.values[-1])):
            return
        ring.add(t, math.nan if value is None else value, self._most_each(), t - self._span_s)

    def _has_room(self, name: str) -> bool:
        if len(self._rings) < self._most_series:
            return True
        if len(self._refused) < self._most_series:
            self._refused.add(name)
        return False

    def _most_each(self) -> int:
        return max(FEWEST_POINTS, min(int(self._span_s * HIGHEST_HZ), self._most_points // max(1, len(self._rings))))

    def take(self, packet: Packet, t: float) -> None:
        """Take the numbers of a packet, unless one of its source and type was taken a moment ago."""
        key = (packet.source, packet.type)
        if t < self._due.get(key, -math.inf):
            return
        if key not in self._due and len(self._due) >= self._most_series:
            return
        self._due[key] = t + 0.999 / HIGHEST_HZ
        self._channels[key] = packet.channel
        head = f"{packet.source} {packet.type} "
        for count, (field, value) in enumerate(numbers_in(packet.body)):
            if count >= MOST_FIELDS:
                return
            self.add(head + field, t, value)

    def find(self, words: str, most: int) -> tuple[list[tuple[str, str, float | None]], int]:
        """Return the series whose names contain all words: name, unit and newest value, and how many match.

        Args:
            words: the words; case does not matter; empty: all series.
            most: how many to return at most.
        """
        asked = words.lower().split()
        names = sorted(name for name in self._rings if all(word in name.lower() for word in asked))
        return [(name, unit(name), plain(self._rings[name].values[-1])) for name in names[:most]], len(names)

    def after(self, name: str, t: float) -> tuple[array[float], array[float]] | None:
        """Return the times and values of a series after `t`; None: there is no such series yet."""
        ring = self._rings.get(name)
        return ring.after(t) if ring is not None else None

    # What pages want ---------------------------------------------------------------------------------------------

    def want(self, names: Sequence[str], now: float) -> None:
        """Note that a page shows series now, so that their packets are followed."""
        for name in names:
            source, _, rest = name.partition(" ")
            type_, _, field = rest.partition(" ")
            if field:
                self._wanted[source, type_] = now + WANTED_S

    def want_all(self, now: float) -> None:
        """Note that a person looks for a series now, so that all packets are followed for a moment."""
        self._all_until = now + WANTED_S

    def wanted(self, now: float) -> dict[str, tuple[str, ...]] | None:
        """Return the channels and types that pages want now; None: all channels, because the channel is not known."""
        self._wanted = {key: until for key, until in self._wanted.items() if until > now}
        if now < self._all_until or any(key not in self._channels for key in self._wanted):
            return None
        found: dict[str, set[str]] = {}
        for key in self._wanted:
            found.setdefault(self._channels[key], set()).add(key[1])
        return {channel: tuple(sorted(types)) for channel, types in sorted(found.items())}


def unit(name: str) -> str:
    """Return the unit of a series by the end of its name; empty: it has none."""
    field = name.rpartition(" ")[2].rpartition(".")[2].partition("[")[0]
    return "%" if field.endswith("_percent") else unit_of(field)


def plain(value: float) -> float | None:
    """Return a number as JSON can have it, rounded to six digits."""
    return float(f"{value:.6g}") if math.isfinite(value) else None


def thinned(times: Sequence[float], values: Sequence[float], most: int) -> tuple[list[float], list[float | None]]:
    """Return at most about `most` points of a series: the smallest and largest value of each piece, so peaks stay."""
    count = len(times)
    if count <= most:
        return [round(t, 3) for t in times], [plain(value) for value in values]
    pieces = max(1, most // 2)
    chosen: list[int] = []
    for piece in range(pieces):
        places = range(piece * count // pieces, (piece + 1) * count // pieces)
        low = min(places, key=lambda place: _order(values[place]))
        high = max(places, key=lambda place: _order(values[place]))
        chosen.extend(sorted({low, high}))
    return [round(times[place], 3) for place in chosen], [plain(values[place]) for place in chosen]


def _order(value: float) -> float:
    return -math.inf if math.isnan(value) else value


def numbers_in(body: Any) -> Iterator[tuple[str, float | None]]:
    """Yield the names and values of the numbers in a body; None: not finite. Large arrays are left out."""
    yield from _numbers(body, "", 0)


def _numbers(value: Any, name: str, depth: int) -> Iterator[tuple[str, float | None]]:
    if isinstance(value, bool | int | float):
        number = float(value) if abs(value) < 1e300 else math.nan
        yield name or "value", number if math.isfinite(number) else None
    elif depth >= MOST_DEEP or isinstance(value, str | bytes | bytearray | memoryview):
        return
    elif is_number(value):
        yield from _numbers(value.item(), name, depth)
    elif is_array(value):
        if value.size <= MOST_ITEMS:
            yield from _numbers(value.tolist(), name, depth)
    elif isinstance(value, list | tuple):
        if len(value) <= MOST_ITEMS:
            for place, item in enumerate(value):
                inner = getattr(item, "name", "")
                # Bodies of a world have names, which say more than their places.
                yield from _numbers(item, f"{name}.{inner}" if inner else f"{name}[{place}]", depth + 1)
    else:
        items = value.items() if isinstance(value, Mapping) else _fields(value)
        for key, item in items:
            yield from _numbers(item, f"{name}.{key}" if name else str(key), depth + 1)


def _fields(value: Any) -> Iterator[tuple[str, Any]]:
    for key in field_names(type(value)):
        yield key, getattr(value, key)
