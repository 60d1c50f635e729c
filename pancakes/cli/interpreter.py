"""What an agent that has a process to itself asks of its Python interpreter and of the system.

Whoever runs agents in a program of their own has to decide this themselves, because it holds for the whole process.
"""

from __future__ import annotations

import contextlib
import gc
import resource
import sys
from typing import Final

SWITCH_S: Final = 0.0002
"""A thread that computes lets another have the interpreter after this time, instead of Python's 5 ms. A tick waits for
it twice, in the timer's thread and in the pool's: beside a task that computes without pause, 100 tasks at 100 Hz are
late by 0.55 ms (p50) and not by 4, and their ticks come at all. With 0.5 ms that is 0.85, and beside a task that sends
without pause the network's thread is overtaken 25 times before it runs: each system call lets go of the interpreter for
a moment, too short to wake up in, and only who has waited for all of this time asks for more. Two threads that compute
get up to a tenth less done for it."""
COLLECT_EACH: Final = (10_000, 10, 10)
"""Python looks for rubbish once so many things more are alive than after the last look, instead of 700. Little that an
agent throws away needs to be looked for. Until 10,000 tasks run, looking takes 0.1 s instead of 0.3 of processor time;
and the start of a small agent is shorter by 5 per cent, or 7 ms."""


FILES: Final = 4096
"""So many files an agent may have open, where the system allows it: 256 agents, 64 clients and 256 connections that
have not said hello yet are more than the 256 files that some systems begin with, and without a file no operator gets
in."""


def prepare() -> None:
    """Sets all of them, for this process."""
    sys.setswitchinterval(SWITCH_S)
    gc.set_threshold(*COLLECT_EACH)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if 0 <= soft < FILES:
        with contextlib.suppress(OSError, ValueError):  # it goes on with what it has; `pancakes doctor` says so
            resource.setrlimit(resource.RLIMIT_NOFILE, (FILES if hard < 0 else min(FILES, hard), hard))


def keep() -> None:
    """Keeps what there is: from now on no look for rubbish goes through it. To be called when most is imported.

    A whole look stops everybody. Of an idle agent's 28,000 objects all but 1,200 are modules, classes and functions: it
    takes 0.1 ms instead of 3.
    """
    gc.freeze()
