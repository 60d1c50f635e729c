"""Times of a recording: one clock for the recordings of several agents, and mission time. Pure.

An agent records how its peers' clocks compare to its own. `Alignment` converts the times of all recordings to the clock
of the first agent by name. `MissionTime` is 0 when the mission began.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from typing import Final

import msgspec

from pancakes.packet import agent_of
from pancakes.recording.records import NANOSECONDS, RecordedPacket
from pancakes.util.clock import SET_SINCE_S

CLOCKS: Final = "pancakes.clocks"
"""Name of the metadata records that compare the clocks of an agent's peers to its own."""
READ_NS: Final = 20_000
"""The error when two clocks of one machine are compared."""
HOST: Final = "host_ns"
Shift = Callable[[int], int]
"""Takes a time of one recording, and returns it on the clock of another one."""


class ClockNote(msgspec.Struct, frozen=True):
    """How a peer's host clock compared to that of the recording agent, at one moment.

    Attributes:
        host_ns: when, on the clock of the recording agent.
        offset_ns: how far the peer's clock was ahead.
        bound_ns: the error of `offset_ns` is at most this.
        drift: how much the peer's clock gained in each second.
    """

    host_ns: int
    offset_ns: int
    bound_ns: int
    drift: float


class ClockLife(msgspec.Struct):
    """One life of an agent, from its recording.

    Attributes:
        life: its name.
        agent: the agent.
        epoch_ns: the time of its recording at 0 of its host clock.
        host_ns: when its recording began, or last took the time of day from its machine, on the host clock.
        notes: what it knew of other clocks, by their life, in order.
    """

    life: str
    agent: str
    epoch_ns: int
    host_ns: int = 0
    notes: dict[str, list[ClockNote]] = msgspec.field(default_factory=dict)

    @classmethod
    def of(cls, about: Mapping[str, str]) -> ClockLife | None:
        """Make one from the metadata of a recording; None: an older recording, without facts about clocks."""
        try:
            return cls(about["life"], about["agent"], int(about["epoch_ns"]), int(about.get("host_ns", "0")))
        except (KeyError, ValueError):
            return None

    @property
    def key(self) -> str:
        """The name of this recording's clock: another recording of this life may count from another moment."""
        return f"{self.life} {self.epoch_ns}"

    @property
    def is_dated(self) -> bool:
        """Whether the clock of its machine was set: otherwise its dates are in 1970."""
        return self.epoch_ns + self.host_ns >= SET_SINCE_S * NANOSECONDS

    def take(self, row: Mapping[str, str]) -> None:
        """Take a metadata record that `row_of` made; invalid values are left out."""
        try:
            host_ns = int(row[HOST])
            for life, text in row.items():
                if life != HOST:
                    offset, bound, drift = text.split(" ")
                    self.notes.setdefault(life, []).append(ClockNote(host_ns, int(offset), int(bound), float(drift)))
        except (KeyError, ValueError):
            return


def row_of(host_s: float, links: Iterable[Mapping[str, object]]) -> dict[str, str]:
    """Return a metadata record that compares clocks; empty if nothing is known.

    Args:
        host_s: the host time.
        links: the description of each link, see `Mesh.links`.
    """
    row = {}
    for link in links:
        clock = link["clock"]
        if isinstance(clock, Mapping) and link["role"] != "client":
            offset_ns, bound_ns = round(1e9 * clock["offset_s"]), round(1e9 * clock["bound_s"])
            row[str(link["life"])] = f"{offset_ns} {bound_ns} {clock['drift']!r}"
    return {HOST: str(round(1e9 * host_s)), **row} if row else {}


class Alignment:
    """Convert the times of all recordings to the clock of one of them, that of the first agent by name.

    A machine may learn the time of day while it records, so that a life has several; the newest counts.

    Args:
        lives: the lives that were recorded.

    Attributes:
        shifts: by the key of the life; times of lives without one are not changed.
        remarks: sentences on what was moved.
    """

    def __init__(self, lives: Sequence[ClockLife]) -> None:
        self.shifts: dict[str, Shift] = {}
        self.remarks: list[str] = []
        newest: dict[str, ClockLife] = {}
        for life in sorted(lives, key=lambda it: it.host_ns):
            before = newest.get(life.life)
            if before is not None:
                for peer, notes in before.notes.items():
                    life.notes[peer] = notes + life.notes.get(peer, [])
            newest[life.life] = life
        left = sorted(newest.values(), key=lambda life: (life.agent, life.key))
        while left:
            self._spread(left.pop(0), left)
        for life in lives:
            self._date(life, newest[life.life])

    def _date(self, life: ClockLife, newest: ClockLife) -> None:
        """Correct the times of what was recorded before the machine got the time of day."""
        moved_ns = newest.epoch_ns - life.epoch_ns
        if not moved_ns:
            return
        onward = self.shifts.get(newest.key)
        self.shifts[life.key] = lambda time_ns: (onward or _stay)(time_ns + moved_ns)
        if abs(moved_ns) >= NANOSECONDS:
            days, seconds = divmod(abs(moved_ns) / NANOSECONDS, 86_400)
            far = f"{'+' if moved_ns > 0 else '-'}{f'{days:.0f} days and ' if days else ''}{seconds:.3f} s"
            self.remarks.append(f"the times of {life.agent} before its clock was set were moved by {far}")

    def _spread(self, first: ClockLife, left: list[ClockLife]) -> None:
        """Align all lives whose offset to an aligned one is known, the best known first."""
        reached = [first]
        while True:
            pairs = [(bound, one, other) for one in reached for other in left if (bound := _bound_ns(one, other))]
            if not pairs:
                return
            bound_ns, one, other = min(pairs, key=lambda pair: (pair[0], pair[1].key, pair[2].key))
            left.remove(other)
            reached.append(other)
            self._align(one, other, bound_ns)

    def _align(self, one: ClockLife, other: ClockLife, bound_ns: int) -> None:
        shift, moved_ns = _shift(one, other)
        onward = self.shifts.get(one.key)
        if abs(moved_ns) > bound_ns + READ_NS:
            self.shifts[other.key] = shift if onward is None else lambda time_ns: onward(shift(time_ns))
            self.remarks.append(
                f"the times of {other.agent} were moved by {moved_ns / 1e9:+.6f} s onto the clock of {one.agent}"
                f" (to within {bound_ns / 1e6:.3f} ms)"
            )
        elif onward is not None:
            self.shifts[other.key] = onward


def _stay(time_ns: int) -> int:
    return time_ns


def _bound_ns(one: ClockLife, other: ClockLife) -> int:
    """Return the smallest bound on the offset of two lives' clocks; 0: it is not known."""
    notes = [*one.notes.get(other.life, ()), *other.notes.get(one.life, ())]
    return max(1, min(note.bound_ns for note in notes)) if notes else 0


def _shift(one: ClockLife, other: ClockLife) -> tuple[Shift, int]:
    """Return the function that converts times of `other` to those of `one`, and its largest shift."""
    own, theirs = one.notes.get(other.life, []), other.notes.get(one.life, [])
    if theirs and (not own or min(it.bound_ns for it in theirs) <= min(it.bound_ns for it in own)):
        notes = [(note.host_ns, note.offset_ns, note.drift) for note in theirs]
    else:  # recorded by the other side
        notes = [(note.host_ns + note.offset_ns, -note.offset_ns, -note.drift) for note in own]
    starts = [host_ns for host_ns, _, _ in notes]
    away_ns = one.epoch_ns - other.epoch_ns

    def shift(time_ns: int) -> int:
        host_ns = time_ns - other.epoch_ns
        after = bisect_right(starts, host_ns)
        first_ns, offset_ns, drift = notes[max(0, after - 1)]
        if 0 < after < len(notes):
            next_ns, next_offset_ns, _ = notes[after]
            drift = (next_offset_ns - offset_ns) / (next_ns - first_ns)
        return time_ns + away_ns + offset_ns + round(drift * (host_ns - first_ns))

    moves = [away_ns + offset_ns for _, offset_ns, _ in notes]
    return shift, max(moves, key=abs)


AGREE_NS: Final = NANOSECONDS
"""Missions that were begun together may differ by this, in host time."""
ENOUGH: Final = 20
"""At most this many packets are compared: each is seen a moment after its stamp, and the shortest delay counts."""
MOST: Final = 20_000
"""At most this many packets are examined."""


def speed_of(about: Mapping[str, str]) -> float:
    """Return the mission seconds for each second of host time, as a recorder wrote it; 1 if that is not a number."""
    try:
        speed = float(about["speed"])
    except (KeyError, ValueError):
        return 1.0
    return speed if 0.0 < speed < math.inf else 1.0


@dataclass(frozen=True)
class MissionTime:
    """Convert a recording's time to mission time.

    Attributes:
        zero_ns: when the mission began, on the recording's clock.
        speed: mission seconds for each second of the recording.
        known: whether it is the mission's time; otherwise it is seconds since the recording began, because the agents'
            missions did not begin together, or not at all.
    """

    zero_ns: int = 0
    speed: float = 1.0
    known: bool = True

    def at(self, time_ns: int) -> float:
        """Return the mission time in seconds; 0 while the mission was held."""
        return max(0.0, (time_ns - self.zero_ns) / NANOSECONDS * self.speed)

    @property
    def name(self) -> str:
        """The name of this time."""
        return "mission time" if self.known else "time since the recording began"

    @classmethod
    def of(cls, files: Iterable[tuple[Mapping[str, str], Iterable[RecordedPacket]]]) -> MissionTime:
        """Find the mission time of a recording.

        If an agent was restarted, its clock began again; its first life counts.

        Args:
            files: of each file what its recorder wrote about it, complete once its first packet has been taken, and
                its packets.
        """
        begun: dict[str, tuple[int, int, float]] = {}  # by agent: its first packet, its mission's beginning, the speed
        first_ns: int | None = None
        for about, entries in files:
            rest = iter(entries)
            first = next(rest, None)
            if first is None:
                continue
            agent, began_ns = first.agent, first.time_ns
            first_ns = began_ns if first_ns is None else min(first_ns, began_ns)
            speed = speed_of(about)
            zero_ns = _zero_ns(chain((first,), rest), speed)
            if zero_ns is not None and (agent not in begun or began_ns < begun[agent][0]):
                begun[agent] = (began_ns, zero_ns, speed)
        agreed = _agreed([(zero_ns, speed) for _, zero_ns, speed in begun.values()])
        return cls(*agreed) if agreed is not None else cls(first_ns or 0, 1.0, False)


def _zero_ns(entries: Iterable[RecordedPacket], speed: float) -> int | None:
    own = (entry for entry in islice(entries, MOST) if agent_of(entry.packet.source) == entry.agent)
    begun = (entry for entry in own if entry.packet.stamp_s > 0.0)
    zeros = (entry.time_ns - round(entry.packet.stamp_s / speed * NANOSECONDS) for entry in begun)
    return min(islice(zeros, ENOUGH), default=None)


def _agreed(begun: list[tuple[int, float]]) -> tuple[int, float] | None:
    """Return the beginning that more than half of the agents agree on, and the speed."""
    for zero_ns, speed in sorted(begun):
        together = [other for other in begun if other[1] == speed and 0 <= other[0] - zero_ns <= AGREE_NS]
        if 2 * len(together) > len(begun):
            return zero_ns, speed
    return None
