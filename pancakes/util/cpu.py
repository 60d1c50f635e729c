"""Processor times, processor count and speed of this computer, as its operating system reports them."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from time import thread_time
from typing import Final

_BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")
_YARDSTICK_LOOPS: Final = 10_000


def processor_times() -> tuple[float, float]:
    """Return the busy time and the total time of all processors, in seconds."""
    import psutil

    times = psutil.cpu_times()
    # `user` already includes guests; waiting for a disk is not work.
    whole_s = sum(times) - getattr(times, "guest", 0.0) - getattr(times, "guest_nice", 0.0)
    return whole_s - times.idle - getattr(times, "iowait", 0.0), whole_s


def processor_count() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@lru_cache(maxsize=1)
def host_id() -> str:
    """Return a name for this computer since its start: the same for all its processes."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        import platform  # few agents ever need it

        return platform.node()


def yardstick_s() -> float:
    """Return the processor time of a fixed piece of Python, about 0.5 ms: how fast this processor is now."""
    begun_s = thread_time()
    total = 0
    for number in range(_YARDSTICK_LOOPS):
        total += number & 7
    return thread_time() - begun_s
