"""Measure a peer that stops or hardly reads under load: effect on others, time until it is closed, time to return."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any, Final, NamedTuple

from torture.load_fleet import LoadedFleet
from torture.overload import p99
from torture.slow_peer import SlowPeer

WANTED_RATIO: Final = 1.2
"""How large the others' p99 may be while one peer is slow, as a multiple of the baseline."""
CLOSED_S: Final = 7.0
"""How long until a peer that reads nothing is closed: 5 s, and the time until all buffers are full."""
TASKS: Final[dict[str, Any]] = {
    "a": {"Flood": {"to": "*", "size": 1024}, "Pinger": {"to": "b/client/Ponger"}},
    "b": {"Ponger": {}},
    "c": {"QueueReader": {}},
}
"""`a` floods `b` and `c`; round trips between `a` and `b` are measured; `c` is the one that stops."""
FLOOD_PER_S: Final = 2000.0
HOW: Final = ("stopped", "1 byte/s", "nothing")


class Seen(NamedTuple):
    """The figures of one kind of slowness.

    Attributes:
        how: `stopped` (SIGSTOP), or how much a peer reads that still sends heartbeats.
        closed_s: how many seconds until the agent closed the link, for each time.
        joined_s: how many seconds after it woke it was connected again, for each time.
        p99_s: of the others' round trips while one peer was slow, for each time.
        baseline_p99_s: the same just before, with that peer reading.
    """

    how: str
    closed_s: list[float]
    joined_s: list[float]
    p99_s: list[float]
    baseline_p99_s: list[float]

    @property
    def ratio(self) -> float:
        """The ratio of the others' p99 to its baseline, of the medians."""
        return median(self.p99_s) / median(self.baseline_p99_s)

    @property
    def spread(self) -> tuple[float, float]:
        """The smallest and the largest ratio."""
        ratios = [slow / normal for slow, normal in zip(self.p99_s, self.baseline_p99_s, strict=True)]
        return min(ratios), max(ratios)


def slow_peer(directory: Path, how: str, rounds: int, span_s: float) -> Seen:
    """Measure one kind of slowness several times, each after a baseline in which the same peer reads."""
    seen = Seen(how, [], [], [], [])
    with LoadedFleet(directory, TASKS) as fleet:
        fleet.wait(lambda: _trips(fleet, 0.0, math.inf), "the link")
        fleet.configure("a", "Flood", per_s=FLOOD_PER_S)
        other = _stopping(fleet) if how == "stopped" else _hardly_reading(fleet, 0.0 if how == "nothing" else 1.0)
        with other as (name, fall_asleep, wake):
            for _ in range(rounds):
                began_s = time.monotonic()
                fleet.client.wait(lambda: False, span_s)
                asleep_s = time.monotonic()
                fall_asleep()
                fleet.running["a"].hear(f"the link to {name} has ended")
                closed_s = time.monotonic()
                seen.baseline_p99_s.append(_p99_s(fleet, began_s, asleep_s))
                seen.p99_s.append(_p99_s(fleet, asleep_s, closed_s))
                seen.closed_s.append(closed_s - asleep_s)
                woken_s = time.monotonic()
                wake()
                fleet.running["a"].hear(f"{name} (agent")
                seen.joined_s.append(time.monotonic() - woken_s)
    return seen


Peer = tuple[str, Callable[[], None], Callable[[], None]]


@contextmanager
def _stopping(fleet: LoadedFleet) -> Iterator[Peer]:
    """Yield the name of an agent, and functions that stop and continue its process; at the end it continues."""
    pid = fleet.running["c"].pid

    def stop() -> None:
        os.kill(pid, signal.SIGSTOP)
        os.waitpid(pid, os.WUNTRACED)

    try:
        yield "c", stop, lambda: os.kill(pid, signal.SIGCONT)
    finally:
        os.kill(pid, signal.SIGCONT)


@contextmanager
def _hardly_reading(fleet: LoadedFleet, bytes_per_s: float) -> Iterator[Peer]:
    """Yield the name of a peer on a raw socket, and functions that make it slow, and make it reconnect and read."""
    peers = [SlowPeer(fleet.addresses["a"])]

    def fall_asleep() -> None:
        peers[-1].bytes_per_s = bytes_per_s

    def wake() -> None:
        peers[-1].close()
        peers.append(SlowPeer(fleet.addresses["a"]))

    try:
        fleet.running["a"].hear("zz-slow (agent")
        yield "zz-slow", fall_asleep, wake
    finally:
        peers[-1].close()


def _p99_s(fleet: LoadedFleet, began_s: float, ended_s: float) -> float:
    """Return the 99th percentile of the round trips that ended in a span of time."""
    fleet.wait(lambda: _trips(fleet, ended_s, math.inf), "a round trip after the span")
    return p99(_trips(fleet, began_s, ended_s))


def _trips(fleet: LoadedFleet, began_s: float, ended_s: float) -> list[float]:
    rows = fleet.told("a", "Pinger", began_s)
    return [row["took_s"] for row in rows if "took_s" in row and row["at_s"] <= ended_s]
