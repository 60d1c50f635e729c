"""What an agent that has a process to itself asks of its Python interpreter and of the system.

A program that runs agents itself must set this itself, because the settings are those of the whole process.
"""

from __future__ import annotations

import contextlib
import gc
import resource
import sys
from typing import Final

SWITCH_S: Final = 0.0002
"""A thread that computes gives the interpreter to another after this time, in seconds; Python's own time is 5 ms. A
tick waits for it twice: in the timer's thread and in the pool's. With a longer time, the ticks of other tasks are late
beside a task that computes without pause, and beside a task that sends without pause the network's thread hardly runs:
each system call releases the interpreter, for a moment that is too short to wake up in. Two threads that compute are a
little slower for it."""
COLLECT_EACH: Final = (10_000, 10, 10)
"""Python's garbage collector runs when so many objects more are alive than after its last run. An agent makes little
garbage that the collector must find, and a start makes many objects that stay."""
FILES: Final = 4096
"""So many files an agent may have open, where the system allows it. All agents, clients and new connections of a full
mesh need more than the limit that some systems begin with; without a free file no operator can connect."""


def prepare() -> None:
    """Sets all of them, for this process."""
    sys.setswitchinterval(SWITCH_S)
    gc.set_threshold(*COLLECT_EACH)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if 0 <= soft < FILES:
        with contextlib.suppress(OSError, ValueError):  # it goes on with what it has; `pancakes doctor` says so
            resource.setrlimit(resource.RLIMIT_NOFILE, (FILES if hard < 0 else min(FILES, hard), hard))


def keep() -> None:
    """Takes all present objects out of the garbage collector's sight. To be called when most modules are imported.

    A full collection stops all threads, and most objects of an idle agent are modules, classes and functions.
    """
    gc.freeze()
