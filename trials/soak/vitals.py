"""Read the resources of a process from the operating system: processor time, memory, threads, open files."""

from __future__ import annotations

import os
import time
from pathlib import Path

import msgspec


class Vitals(msgspec.Struct, frozen=True):
    """The resources of one process.

    Attributes:
        rss_kib: resident memory.
        pss_kib: proportional memory: of shared pages, only its share.
        threads: the number of threads.
        sockets: the number of open sockets.
        files: the number of other open file descriptors.
    """

    rss_kib: int
    pss_kib: int
    threads: int
    sockets: int
    files: int


def vitals_of(pid: int) -> Vitals:
    """Read the resources of a process.

    Raises:
        OSError: the process has ended.
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
    """Return the processor time that a process has used, in seconds.

    Raises:
        OSError: the process has ended.
    """
    # How Linux builds the number of another process's clock (clock_getcpuclockid).
    return time.clock_gettime((~pid << 3) | 2)
