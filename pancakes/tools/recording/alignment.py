"""Brings the times of recordings of several agents onto one clock, by what each wrote of the others' clocks. Pure."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final

import msgspec

from pancakes.runtime.clock import SET_SINCE_S
from pancakes.tools.recording.recorded_packet import NANOSECONDS

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
        """Makes one of what a recorder wrote about its recording; None: that is older, and says nothing of clocks."""
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
        """Takes a metadata record that `row_of` has made; what is no such thing is left out."""
        try:
            host_ns = int(row[HOST])
            for life, told in row.items():
                if life != HOST:
                    offset, bound, drift = told.split(" ")
                    self.notes.setdefault(life, []).append(ClockNote(host_ns, int(offset), int(bound), float(drift)))
        except (KeyError, ValueError):
            return


def row_of(host_s: float, links: Iterable[Mapping[str, object]]) -> dict[str, str]:
    """Returns a metadata record of how clocks stand; empty where nothing is known.

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
        shifts: by the key of the life; where there is none, the times stay.
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
        """Moves what was recorded before the machine learnt the time of day."""
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
        """Aligns all that are known to the first one, or to one that is, the best known first."""
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
    """Returns how well two lives know each other's clock at best; 0: they do not."""
    notes = [*one.notes.get(other.life, ()), *other.notes.get(one.life, ())]
    return max(1, min(note.bound_ns for note in notes)) if notes else 0


def _shift(one: ClockLife, other: ClockLife) -> tuple[Shift, int]:
    """Returns what turns times of `other` into those of `one`, and by how much that moves them at most."""
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
