"""The gate of a mesh: what is sent under a right leaves only as long as that lasts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from pancakes.packet import Fence


class Gate(NamedTuple):
    """Is asked about packets of guarded tasks, in the sender's thread, right before the system call.

    Attributes:
        may_leave: returns whether what is sent under a right may leave now.
        held_back: told of a right that has ended, and how many packets under it were given up.
    """

    may_leave: Callable[[Fence], bool] = lambda fence: True
    held_back: Callable[[Fence, int], None] = lambda fence, packets: None


OPEN: Final = Gate()
"""Lets everything leave."""
