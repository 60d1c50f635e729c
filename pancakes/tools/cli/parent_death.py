"""End this process with the one that launched it, so that no agent stays behind if a launcher is killed. Linux only.

Imported only if asked for: `ctypes` costs each agent memory.
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

    Linux counts the thread that launched us as the parent, so a launcher does it from one that stays.

    Args:
        expected_pid: the parent; 0: the present one. With it, a parent that died before this call is seen too.

    Raises:
        PancakesError: the parent has ended already, or this system cannot do it.
    """
    if not sys.platform.startswith("linux"):
        raise PancakesError(f"--die-with-parent works only on Linux, not on {sys.platform}")
    parent_pid = expected_pid or os.getppid()
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0) != 0:
        raise PancakesError(f"--die-with-parent cannot be had: {os.strerror(ctypes.get_errno())}")
    if os.getppid() != parent_pid:  # it ended before the kernel was asked
        raise PancakesError(f"the process {parent_pid}, which launched this agent, has ended")
