"""The faults of real agents of one fleet, and how each of them is healed."""

from __future__ import annotations

import contextlib
import math
import random
import resource
import shutil
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from torture.live import LiveFleet
from torture.proxy import Proxy

KINDS: Final = (
    "kill, restart",
    "kill, stays away",
    "kill, lost disk",
    "kill, restored disk",
    "goodbye",
    "short stop",
    "long stop",
    "cut",
    "one-way cut",
    "cut from one",
    "flapping",
    "full disk",
)
KILLS: Final = tuple(kind for kind in KINDS if kind.startswith("kill"))
DISKS: Final = ("kill, lost disk", "kill, restored disk")
FOR_GOOD: Final = (*DISKS, "kill, stays away")
"""Faults that remove a guardian or its memory: the two others of three must be well."""
LOSSES: Final = (*KILLS, "goodbye", "long stop", "cut", "one-way cut")
"""Faults after which another agent must take over the task, if they hit its owner."""
BACKED_UP: Final = 200
"""How often to try to copy a disk that changes."""


class Stroke(NamedTuple):
    """A fault that was made.

    Attributes:
        kind: which.
        hit: the agent.
        for_s: how long it lasts; infinity: until the next one.
        heal: ends it.
    """

    kind: str
    hit: str
    for_s: float
    heal: Callable[[], None]


class Strokes:
    """Make faults of the agents of one fleet.

    Args:
        fleet: the fleet.
        proxies: the proxy between each two agents, by the one that dials and the one that is dialled.
        lease_s: the lease of the task.
        draw: random numbers for the duration of a fault, and the direction in which a link is cut.
        started: called with each agent that is started again.
    """

    def __init__(
        self,
        fleet: LiveFleet,
        proxies: Mapping[tuple[str, str], Proxy],
        lease_s: float,
        draw: random.Random,
        started: Callable[[str], None],
    ) -> None:
        self._fleet = fleet
        self._proxies = proxies
        self._lease_s = lease_s
        self._random = draw
        self._started = started

    def strike(self, kind: str, hit: str, others: Sequence[str]) -> Stroke:
        """Make a fault.

        Args:
            kind: which.
            hit: the agent.
            others: the agents to choose from if it is cut from only one.
        """
        if kind in KILLS or kind == "goodbye":
            return self._end(kind, hit)
        if kind in ("short stop", "long stop"):
            process = self._fleet.running[hit].process
            process.send_signal(signal.SIGSTOP)
            for_s = self._leases(0.1, 0.9) if kind == "short stop" else self._leases(1.2, 3.0)
            return Stroke(kind, hit, for_s, lambda: process.send_signal(signal.SIGCONT))
        if kind == "full disk":
            pid = self._fleet.running[hit].pid
            hard = _limit(pid, 0)
            return Stroke(kind, hit, self._leases(1.5, 3.0), lambda: _unlimit(pid, hard))
        if kind == "flapping":
            return self._flap(hit)
        says, hears = (True, True)
        if kind == "one-way cut":
            says, hears = self._random.choice([(True, False), (False, True)])
        peers = [self._random.choice(others)] if kind == "cut from one" else []
        self._hold(hit, says, hears, peers)
        return Stroke(kind, hit, self._leases(1.2, 3.0), lambda: self._hold(hit, False, False, peers))

    def close(self) -> None:
        """Restore all links."""
        for proxy in self._proxies.values():
            proxy.hold(False, False)

    def back_up(self, name: str) -> None:
        """Copy an agent's disk, even while the agent writes to it, like a backup."""
        copy = self._copy(name)
        for _ in range(BACKED_UP):
            shutil.rmtree(copy, ignore_errors=True)
            with contextlib.suppress(shutil.Error, OSError):  # a file was replaced during the copy
                shutil.copytree(self._fleet.state / name, copy)
                return
        raise OSError(f"no copy of {self._fleet.state / name} could be made: it changes all the time")

    def is_backed_up(self, name: str) -> bool:
        """Return whether there is a copy of an agent's disk; it may be of any age."""
        return self._copy(name).exists()

    def _copy(self, name: str) -> Path:
        return self._fleet.directory / f"copy-{name}"

    def _leases(self, low: float, high: float) -> float:
        return self._lease_s * self._random.uniform(low, high)

    def _end(self, kind: str, hit: str) -> Stroke:
        fleet, state = self._fleet, self._fleet.state / hit
        if kind == "goodbye":
            process = fleet.running[hit].process
            process.terminate()
            process.wait(20.0)
        fleet.kill(hit)
        if kind == "kill, lost disk":
            shutil.rmtree(state)
        elif kind == "kill, restored disk":
            shutil.rmtree(state)
            shutil.copytree(self._copy(hit), state)
        for_s = math.inf if kind == "kill, stays away" else self._leases(0.1, 3.0)
        return Stroke(kind, hit, for_s, lambda: self._start(hit))

    def _start(self, name: str) -> None:
        self._fleet.start(name)
        self._started(name)

    def _hold(self, hit: str, says: bool, hears: bool, peers: Sequence[str] = ()) -> None:
        """Hold the data from or to an agent; if peers are named, only theirs."""
        for (dialler, dialled), proxy in self._proxies.items():
            if hit == dialler and dialled in (peers or (dialled,)):
                proxy.hold(says, hears)
            elif hit == dialled and dialler in (peers or (dialler,)):
                proxy.hold(hears, says)

    def _flap(self, hit: str) -> Stroke:
        """Cut an agent off and reconnect it in turns, each for half a lease."""
        ended = threading.Event()

        def flap() -> None:
            cut = True
            while True:
                self._hold(hit, cut, cut)
                if ended.wait(self._lease_s / 2):
                    break
                cut = not cut
            self._hold(hit, False, False)

        thread = threading.Thread(target=flap, daemon=True)
        thread.start()

        def heal() -> None:
            ended.set()
            thread.join()

        return Stroke("flapping", hit, 3.0 * self._lease_s, heal)


def _limit(pid: int, most_bytes: int) -> int:
    """Limit the size of a process's files, as on a full disk; return the former limit."""
    soft, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (most_bytes, hard))
    return soft


def _unlimit(pid: int, soft: int) -> None:
    with contextlib.suppress(ProcessLookupError):  # a later fault has killed the process
        _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (soft, hard))
