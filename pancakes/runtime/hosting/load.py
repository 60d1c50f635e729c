"""How busy an agent is: what its process and its computer do, and how late its tasks tick."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import msgspec

from pancakes.runtime.kernel.task_timer import TaskTimer

if TYPE_CHECKING:
    import psutil


class MeasuredLoad(msgspec.Struct, frozen=True):
    """How busy an agent was between two looks; `pancakes.mesh.migration.cost.HostLoad` has the units."""

    agent_share: float
    host_share: float
    lateness_share: float


IDLE = MeasuredLoad(0.0, 0.0, 0.0)
"""What an agent in virtual time says, where one thread does the work of all agents, and nothing is ever late."""


def processor_time_s() -> float:
    """Returns the processor time that this process has used so far, all its threads together."""
    times = os.times()
    return times.user + times.system


def host_share() -> float:
    """Returns how many processes ran or waited to run in the last minute, for each processor."""
    return os.getloadavg()[0] / (os.cpu_count() or 1)


def describe_process(uptime_s: float) -> dict[str, Any]:
    """Returns what this process is and has used so far, as plain values."""
    import platform

    from pancakes import __version__

    process = _process(os.getpid())
    return {
        "host": platform.node(),
        "pid": process.pid,
        "version": __version__,
        "build": deployed_build(),
        "python": platform.python_version(),
        "processor_s": processor_time_s(),
        "memory_mib": process.memory_info().rss / 2**20,
        "threads": process.num_threads(),
        "uptime_s": uptime_s,
    }


@lru_cache(maxsize=1)
def deployed_build() -> str:
    """Returns which build of Pancakes and its plug-ins `pancakes deploy` has put into this environment; empty: none."""
    try:
        with open(os.path.join(sys.prefix, "pancakes-build")) as file:
            return file.read().strip()
    except OSError:
        return ""


@lru_cache(maxsize=1)
def _process(pid: int) -> psutil.Process:
    # To make one takes a third of all that is asked of it, which a page asks once a second.
    import psutil

    return psutil.Process(pid)


class LoadMeter:
    """Measures the load between one look and the next. Never waits; in one thread.

    Args:
        used_s: returns the processor time used so far.
        host: returns the load of the computer, for each processor.
    """

    def __init__(self, used_s: Callable[[], float] = processor_time_s, host: Callable[[], float] = host_share) -> None:
        self._used_s = used_s
        self._host = host
        self._before: tuple[float, float] | None = None
        self._ticks: dict[TaskTimer, tuple[int, int, float]] = {}

    def look(self, now_s: float, timers: Iterable[TaskTimer]) -> MeasuredLoad | None:
        """Returns the load since the look before; None at the first, which has nothing to compare with.

        Args:
            now_s: host time.
            timers: the timers whose ticks count.
        """
        before, self._before = self._before, (now_s, self._used_s())
        lateness_share = self._lateness(timers)
        if before is None or now_s <= before[0]:
            return None
        agent_share = max(0.0, self._before[1] - before[1]) / (now_s - before[0])
        return MeasuredLoad(agent_share, self._host(), lateness_share)

    def _lateness(self, timers: Iterable[TaskTimer]) -> float:
        late, count = 0.0, 0
        ticks: dict[TaskTimer, tuple[int, int, float]] = {}
        for timer in timers:
            now = ticks[timer] = (timer.ticks, timer.missed_total, timer.lateness_sum_s)
            was = self._ticks.get(timer, (0, 0, 0.0))
            late += (now[2] - was[2]) / timer.period_s + (now[1] - was[1])
            count += now[0] - was[0] + now[1] - was[1]
        # Those of actors that have ended are forgotten with it.
        self._ticks = ticks
        return late / count if count else 0.0
