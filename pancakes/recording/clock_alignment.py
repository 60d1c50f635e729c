"""Times of a recording: one clock for the recordings of several agents, and mission time. Pure.

An agent writes how its peers' clocks stand to its own. `Alignment` turns the times of all recordings into those of the
first agent by name. `MissionTime` is 0 when the mission began.
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
"""Name of the metadata records of a recording that tell how the clocks of its agent's peers stood to its own."""
READ_NS: Final = 20_000
"""Two clocks of one machine are read so far apart."""
HOST: Final = "host_ns"
Shift = Callable[[int], int]
"""Takes a time of one recording, and returns that moment as another one counts."""


class ClockNote(msgspec.Struct, frozen=True):
    """How a peer's host clock stood to that of the agent that recorded, once.

    Attributes:
        host_ns: when, on the clock of the agent that recorded.
        offset_ns: how far the peer's was ahead.
        bound_ns: the truth lies no further from it.
        drift: how much the peer's gained in each second.
    """

    host_ns: int
    offset_ns: int
    bound_ns: int
    drift: float


class ClockLife(msgspec.Struct):
    """One life of an agent, as a recording tells of it.

    Attributes:
        life: what names it.
        agent: the agent.
        epoch_ns: what its recording says at 0 of its host clock.
        host_ns: when its recording began, on that clock, or last took the time of day from its machine.
        notes: what it knew of others, by their life, in order.
    """

    life: str
    agent: str
    epoch_ns: int
    host_ns: int = 0
    notes: dict[str, list[ClockNote]] = msgspec.field(default_factory=dict)

    @classmethod
    def of(cls, about: Mapping[str, str]) -> ClockLife | None:
        """Make one of what a recorder wrote about its recording; None: that is older, and has no word about clocks."""
        try:
            return cls(about["life"], about["agent"], int(about["epoch_ns"]), int(about.get("host_ns", "0")))
        except (KeyError, ValueError):
            return None

    @property
    def key(self) -> str:
        """Names the times of this recording: another one of this life may count from another moment."""
        return f"{self.life} {self.epoch_ns}"

    @property
    def is_dated(self) -> bool:
        """Whether the clock of its machine was set: else its times of day are those of 1970."""
        return self.epoch_ns + self.host_ns >= SET_SINCE_S * NANOSECONDS

    def take(self, row: Mapping[str, str]) -> None:
        """Take a metadata record that `row_of` has made; what is no such thing is left out."""
        try:
            host_ns = int(row[HOST])
            for life, told in row.items():
                if life != HOST:
                    offset, bound, drift = told.split(" ")
                    self.notes.setdefault(life, []).append(ClockNote(host_ns, int(offset), int(bound), float(drift)))
        except (KeyError, ValueError):
            return


def row_of(host_s: float, links: Iterable[Mapping[str, object]]) -> dict[str, str]:
    """Return a metadata record of how clocks stand; empty if nothing is known.

    Args:
        host_s: the host time.
        links: what the mesh says of each link, see `Mesh.links`.
    """
    row = {}
    for link in links:
        clock = link["clock"]
        if isinstance(clock, Mapping) and link["role"] != "client":
            offset_ns, bound_ns = round(1e9 * clock["offset_s"]), round(1e9 * clock["bound_s"])
            row[str(link["life"])] = f"{offset_ns} {bound_ns} {clock['drift']!r}"
    return {HOST: str(round(1e9 * host_s)), **row} if row else {}


class Alignment:
    """What turns the times of each recording into those of one of them, which is that of the first agent by name.

    A machine may learn the time of day while it records, so that a life has several; the newest counts.

    Args:
        lives: the lives that were recorded.

    Attributes:
        shifts: by the key of the life; if there is none, the times stay.
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
        """Move what was recorded before the machine learnt the time of day."""
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
        """Align all that are known to the first one, or to one that is, the best known first."""
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
    """Return how well two lives know each other's clock at best; 0: they do not."""
    notes = [*one.notes.get(other.life, ()), *other.notes.get(one.life, ())]
    return max(1, min(note.bound_ns for note in notes)) if notes else 0


def _shift(one: ClockLife, other: ClockLife) -> tuple[Shift, int]:
    """Return what turns times of `other` into those of `one`, and by how much that moves them at most."""
    own, theirs = one.notes.get(other.life, []), other.notes.get(one.life, [])
    if theirs and (not own or min(it.bound_ns for it in theirs) <= min(it.bound_ns for it in own)):
        notes = [(note.host_ns, note.offset_ns, note.drift) for note in theirs]
    else:  # told from the other side
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
"""Missions of agents that were begun together may have begun this far apart, in host time."""
ENOUGH: Final = 20
"""At most this many packets are compared: each is seen a moment after its stamp, and the shortest delay counts."""
MOST: Final = 20_000
"""At most so many packets are looked at."""


def speed_of(about: Mapping[str, str]) -> float:
    """Return the mission seconds for each second of host time, as a recorder wrote it; 1 if that is no number."""
    try:
        speed = float(about["speed"])
    except (KeyError, ValueError):
        return 1.0
    return speed if 0.0 < speed < math.inf else 1.0


@dataclass(frozen=True)
class MissionTime:
    """What turns a recording's time into mission time.

    Attributes:
        zero_ns: when the mission began, as the recording counts time.
        speed: mission seconds for each second of the recording.
        known: whether it is the mission's time; otherwise seconds since the recording began: the agents' missions did
            not begin together, or not at all.
    """

    zero_ns: int = 0
    speed: float = 1.0
    known: bool = True

    def at(self, time_ns: int) -> float:
        """Return the mission time in seconds; 0 while the mission was held."""
        return max(0.0, (time_ns - self.zero_ns) / NANOSECONDS * self.speed)

    @property
    def name(self) -> str:
        """What this time is called."""
        return "mission time" if self.known else "time since the recording began"

    @classmethod
    def of(cls, files: Iterable[tuple[Mapping[str, str], Iterable[RecordedPacket]]]) -> MissionTime:
        """Find the mission time of a recording.

        Where an agent was started again its clock began from scratch; what counts is its first life.

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
    begun = (entry for entry in own if entry.packet.stamp > 0.0)
    zeros = (entry.time_ns - round(entry.packet.stamp / speed * NANOSECONDS) for entry in begun)
    return min(islice(zeros, ENOUGH), default=None)


def _agreed(begun: list[tuple[int, float]]) -> tuple[int, float] | None:
    """Return the beginning that more than half of the agents agree on, and the speed."""
    for zero_ns, speed in sorted(begun):
        together = [other for other in begun if other[1] == speed and 0 <= other[0] - zero_ns <= AGREE_NS]
        if 2 * len(together) > len(begun):
            return zero_ns, speed
    return None
