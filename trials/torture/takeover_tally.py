"""Judge guarded tasks under faults by the files of the tasks and their actuators, without asking the agents."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

STOPS: Final = ("short stop", "long stop")
"""The faults that stop a process: if it stops between its look at the clock and an act, that act is late."""


class Trace(NamedTuple):
    """A line of an agent, or of its actuator.

    Attributes:
        epoch: the epoch of the act, and the agent that made that epoch.
        at_ns: the time, on the clock that all processes of a machine share.
    """

    epoch: tuple[int, str]
    at_ns: int


class Traces:
    """A file of acts or of commands; an act with an epoch that has passed is late.

    Args:
        path: the file; it need not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._read = 0
        self._highest = (-1, "")
        self._before = False

    def read(self, tally: TakeoverTally) -> list[Trace]:
        """Judge the new lines, and return them."""
        found = []
        for line in _lines(self.path, self._read):
            self._read += len(line)
            _, number, agent, at_ns = line.decode().split()
            trace = Trace((int(number), agent), int(at_ns))
            late = trace.epoch < self._highest
            tally.late += late
            tally.doubled += late and self._before
            self._before, self._highest = late, max(self._highest, trace.epoch)
            found.append(trace)
        tally.acts += len(found)
        return found


class Heard:
    """The file of the packets that the task has handled: each must have its effect once in the state that continues.

    Args:
        path: the file; each line has the number of a packet, and the number that the state had before.

    Attributes:
        newest: the highest number that was handled.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._read = 0
        self.newest = 0

    def read(self, tally: TakeoverTally) -> None:
        """Judge the new lines."""
        for line in _lines(self._path, self._read):
            self._read += len(line)
            number, before = map(int, line.split())
            tally.packets += 1
            if number <= before:
                tally.wrong.append(f"packet {number} had its effect although the state held {before}")
            elif number > before + 1:
                tally.wrong.append(
                    f"packet {number} had its effect while the state held {before}: what lies between is lost"
                )
            self.newest = max(self.newest, number)


@dataclass
class TakeoverTally:
    """The tally of all cases.

    Attributes:
        faults: the number of faults of each kind.
        meanwhile: how many of them during a hand-off or a take-over.
        acts: the acts of the task and the commands that actuators obeyed, of both.
        late: how many of them had an epoch that had passed.
        doubled: how often two or more late ones followed each other.
        packets: how many packets had their effect.
        wrong: a sentence for each packet that had its effect twice, or never.
        standstills: a sentence for each time that no agent acted for too long.
        killed_s: from each kill of only the owner to the first command from another agent, in seconds.
        ended_s: the same if the owner said goodbye.
        stood_s: the same for owners that were stopped or cut off.
        returned_s: from the restart of a killed owner to its own first command, if no other agent took over.
    """

    faults: Counter[str] = field(default_factory=Counter)
    meanwhile: int = 0
    acts: int = 0
    late: int = 0
    doubled: int = 0
    packets: int = 0
    wrong: list[str] = field(default_factory=list)
    standstills: list[str] = field(default_factory=list)
    killed_s: list[float] = field(default_factory=list)
    ended_s: list[float] = field(default_factory=list)
    stood_s: list[float] = field(default_factory=list)
    returned_s: list[float] = field(default_factory=list)

    def add(self, other: TakeoverTally) -> None:
        """Add the tally of another fleet or run."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)

    def told(self) -> list[str]:
        """Return the tally as lines."""
        kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(self.faults.items()))
        return [
            f"{self.faults.total()} faults, {self.meanwhile} of them during hand-offs and take-overs: {kinds}",
            f"acts and commands: {self.acts}, {self.late} late, {self.doubled} doubled",
            f"packets to the tasks: {self.packets}, {len(self.wrong)} with an effect twice or never",
            f"from a kill of the owner to the copy's first command: {_spread(self.killed_s)}",
            f"from a goodbye of the owner to the copy's first command: {_spread(self.ended_s)}",
            f"from a stop or a cut of the owner to the copy's first command: {_spread(self.stood_s)}",
            f"from the start of an owner that was not replaced to its first command: {_spread(self.returned_s)}",
            f"{len(self.standstills)} standstills",
        ]

    def failures(self, kinds: tuple[str, ...]) -> list[str]:
        """Return a sentence for each failure; `kinds`: the kinds of faults that must have occurred."""
        found = [*self.wrong, *self.standstills]
        if self.doubled:
            found.append(f"{self.doubled} times two acts, or more, followed each other under an epoch that had passed")
        allowed = 2 * sum(self.faults[kind] for kind in STOPS)
        if self.late > allowed:
            found.append(
                f"{self.late} acts were late, and {allowed} may be: one for each stop of each thread that acts"
            )
        found += [f"no fault of the kind {kind!r} was made" for kind in kinds if not self.faults[kind]]
        return found

    def figures(self) -> dict[str, Any]:
        """Return the tally as plain values."""
        return {**vars(self), "faults": dict(self.faults)}

    @classmethod
    def of(cls, figures: dict[str, Any]) -> TakeoverTally:
        """Make a tally of the plain values of `figures`."""
        return cls(**{**figures, "faults": Counter(figures["faults"])})


def percentile(values: list[float], percent: float) -> float:
    """Return a percentile; nan if there are no values."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(len(ordered) * percent / 100) - 1)] if ordered else math.nan


def _spread(values: list[float]) -> str:
    if not values:
        return "none was measured (only what hits the owner by itself is; with --calm all does)"
    p50, p99 = percentile(values, 50), percentile(values, 99)
    return f"p50 {p50:.2f} s, p99 {p99:.2f} s, max {max(values):.2f} s, of {len(values)}"


def _lines(path: Path, since: int) -> list[bytes]:
    """Return the complete lines of a file after an offset."""
    if not path.exists():
        return []
    with path.open("rb") as file:
        file.seek(since)
        return [line for line in file.read().splitlines(keepends=True) if line.endswith(b"\n")]
