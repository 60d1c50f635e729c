"""Compare what a task published in a recording with what it publishes now, packet by packet. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from pancakes.packet import Packet, body_to_plain

DIFFERENT: Final = "different"
MISSING: Final = "missing"
EXTRA: Final = "extra"
STAMP: Final = "stamp"
"""The name of the field in a `FieldDifference` if two packets differ in the time of their publication."""


@dataclass(frozen=True, slots=True)
class Tolerance:
    """How much two equal packets may differ.

    Attributes:
        share: the largest relative difference of a number; near 0 the absolute difference.
        time_s: the largest difference between the times of publication, in mission seconds.
    """

    share: float = 1e-6
    time_s: float = 0.05


class FieldDifference(NamedTuple):
    """A field of a packet's body that differs.

    Attributes:
        field: the keys that lead to it, such as `ranges_m[3]`; `stamp` for the packet's time.
        recorded: its recorded value.
        now: its value now.
    """

    field: str
    recorded: Any
    now: Any


@dataclass(frozen=True, slots=True)
class Difference:
    """A packet that differs between the two runs.

    Attributes:
        kind: `different`, `missing` (published only then) or `extra` (published only now).
        packet: the recorded packet; for `extra`, the new one.
        fields: the fields that differ, if it is `different`.
    """

    kind: str
    packet: Packet
    fields: tuple[FieldDifference, ...] = ()


class StreamKey(NamedTuple):
    """What two packets must have in common to be compared."""

    channel: str
    type: str
    to: str


@dataclass
class Stream:
    """How many packets of one channel, type and destination are equal, different, missing or extra."""

    recorded: int
    now: int
    equal: int = 0
    different: int = 0
    missing: int = 0
    extra: int = 0


@dataclass
class RunComparison:
    """The comparison of two runs of a task.

    Attributes:
        streams: the counts of each stream.
        differences: the packets that differ, in the order of time.
    """

    streams: dict[StreamKey, Stream] = field(default_factory=dict)
    differences: list[Difference] = field(default_factory=list)

    @property
    def agrees(self) -> bool:
        """Whether nothing differs."""
        return not self.differences


def key_of(packet: Packet) -> StreamKey:
    """Return the stream of a packet."""
    return StreamKey(packet.channel, packet.type, packet.destination)


def compare(recorded: Sequence[Packet], now: Sequence[Packet], address: str, tolerance: Tolerance) -> RunComparison:
    """Compare the packets that a task published then with those that it publishes now.

    Packets with the same cause are compared with each other; packets without one (from ticks) by their time.

    Args:
        recorded: the recorded packets, in order.
        now: the packets of the new run, in order.
        address: the task's address.
        tolerance: how much equal packets may differ.
    """
    result = RunComparison()
    streams: dict[StreamKey, tuple[list[Packet], list[Packet]]] = {}
    for side, packets in enumerate((recorded, now)):
        for packet in packets:
            streams.setdefault(key_of(packet), ([], []))[side].append(packet)
    for key, (before, after) in sorted(streams.items()):
        counts = result.streams[key] = Stream(len(before), len(after))
        for one, other in _pairs(before, after, address, tolerance.time_s):
            if one is None or other is None:
                counts.missing += one is not None
                counts.extra += other is not None
                if one is not None:
                    result.differences.append(Difference(MISSING, one))
                elif other is not None:
                    result.differences.append(Difference(EXTRA, other))
                continue
            fields = tuple(_differences(one, other, tolerance))
            counts.equal += not fields
            counts.different += bool(fields)
            if fields:
                result.differences.append(Difference(DIFFERENT, one, fields))
    result.differences.sort(key=lambda difference: (difference.packet.stamp_s, difference.packet.seq))
    return result


_Pair = tuple[Packet | None, Packet | None]


def _pairs(before: Sequence[Packet], after: Sequence[Packet], address: str, time_s: float) -> Iterator[_Pair]:
    by_cause: dict[tuple[str, int], list[Packet]] = {}
    for packet in after:
        cause = _cause(packet, address)
        if cause is not None:
            by_cause.setdefault(cause, []).append(packet)
    for packet in before:
        cause = _cause(packet, address)
        if cause is not None:
            effects = by_cause.get(cause)
            yield packet, effects.pop(0) if effects else None
    for effects in by_cause.values():
        for packet in effects:
            yield None, packet
    yield from _by_time(
        [packet for packet in before if _cause(packet, address) is None],
        [packet for packet in after if _cause(packet, address) is None],
        time_s,
    )


def _cause(packet: Packet, address: str) -> tuple[str, int] | None:
    """Return the cause of a packet; None if it has none, or it is the task's own, whose numbers differ between runs."""
    cause = packet.cause
    return (cause[0], cause[1]) if cause is not None and cause[0] != address else None


def _by_time(before: Sequence[Packet], after: Sequence[Packet], time_s: float) -> Iterator[_Pair]:
    first = second = 0
    while first < len(before) and second < len(after):
        one, other = before[first], after[second]
        gap_s = abs(one.stamp_s - other.stamp_s)
        # If one of the two packets has no partner, the next packet may fit better.
        later_other = second + 1 < len(after) and abs(one.stamp_s - after[second + 1].stamp_s) < gap_s
        later_one = first + 1 < len(before) and abs(before[first + 1].stamp_s - other.stamp_s) < gap_s
        if gap_s <= time_s and not (later_other or later_one):
            yield one, other
            first, second = first + 1, second + 1
        elif later_other or (not later_one and other.stamp_s < one.stamp_s):
            yield None, other
            second += 1
        else:
            yield one, None
            first += 1
    for packet in before[first:]:
        yield packet, None
    for packet in after[second:]:
        yield None, packet


def _differences(recorded: Packet, now: Packet, tolerance: Tolerance) -> Iterator[FieldDifference]:
    if abs(recorded.stamp_s - now.stamp_s) > tolerance.time_s:
        yield FieldDifference(STAMP, recorded.stamp_s, now.stamp_s)
    yield from _walk(body_to_plain(recorded.body), body_to_plain(now.body), "", tolerance.share)


def _walk(recorded: Any, now: Any, path: str, share: float) -> Iterator[FieldDifference]:
    if isinstance(recorded, Mapping) and isinstance(now, Mapping):
        for key in dict.fromkeys([*recorded, *now]):
            yield from _walk(recorded.get(key), now.get(key), f"{path}.{key}" if path else str(key), share)
    elif isinstance(recorded, (list, tuple)) and isinstance(now, (list, tuple)) and len(recorded) == len(now):
        for number, (one, other) in enumerate(zip(recorded, now, strict=True)):
            yield from _walk(one, other, f"{path}[{number}]", share)
    elif not _equal(recorded, now, share):
        yield FieldDifference(path, recorded, now)


def _equal(recorded: Any, now: Any, share: float) -> bool:
    numbers = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in (recorded, now))
    if not numbers:
        return type(recorded) is type(now) and bool(recorded == now)
    if math.isnan(recorded) or math.isnan(now):
        return math.isnan(recorded) and math.isnan(now)
    return math.isclose(recorded, now, rel_tol=share, abs_tol=share)
