"""What the operating system says of a process: processor time, memory, threads, what it holds open."""

from __future__ import annotations

import os
import time
from pathlib import Path

import msgspec


class Vitals(msgspec.Struct, frozen=True):
    """What one process uses.

    Attributes:
        rss_kib: resident memory.
        pss_kib: the same, of what is shared only its share.
        threads: how many.
        sockets: file descriptors that are sockets.
        files: all other file descriptors.
    """

    rss_kib: int
    pss_kib: int
    threads: int
    sockets: int
    files: int


def vitals_of(pid: int) -> Vitals:
    """Looks at a process.

    Raises:
        OSError: it is not there any more.
    """
    place = Path("/proc") / str(pid)
    memory: dict[str, int] = {}
    for line in (place / "smaps_rollup").read_text().splitlines()[1:]:
        key, value, *_ = line.split()
        memory[key] = int(value)
    sockets = files = 0
    for descriptor in os.listdir(place / "fd"):
        try:
            is_socket = os.readlink(place / "fd" / descriptor).startswith("socket:")
        except FileNotFoundError:  # closed meanwhile
            continue
        sockets += is_socket
        files += not is_socket
    return Vitals(memory["Rss:"], memory["Pss:"], len(os.listdir(place / "task")), sockets, files)


def processor_s(pid: int) -> float:
    """Returns the processor time that a process has used, in seconds.

    Raises:
        OSError: it is not there any more.
    """
    # How Linux builds the number of another process's clock (clock_getcpuclockid).
    return time.clock_gettime((~pid << 3) | 2)
