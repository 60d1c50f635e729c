"""End this process when its launcher ends, so that no agent is left behind if a launcher is killed. Linux only.

Imported only if needed: `ctypes` costs each agent memory.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from typing import Final

from pancakes.errors import PancakesError

_PR_SET_PDEATHSIG: Final = 1  # from <linux/prctl.h>


def die_with_parent(expected_pid: int) -> None:
    """Ask the kernel to send SIGTERM to this process when its parent ends.

    Linux means the thread that started this process, so a launcher must start it from a thread that keeps running.

    Args:
        expected_pid: the parent's process id, to detect a parent that died before this call; 0: the present parent.

    Raises:
        PancakesError: the parent has ended already, or this system does not support it.
    """
    if not sys.platform.startswith("linux"):
        raise PancakesError(f"--die-with-parent works only on Linux, not on {sys.platform}")
    parent_pid = expected_pid or os.getppid()
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0) != 0:
        raise PancakesError(f"--die-with-parent failed: {os.strerror(ctypes.get_errno())}")
    if os.getppid() != parent_pid:  # the parent ended before the call above
        raise PancakesError(f"the process {parent_pid}, which launched this agent, has ended")
