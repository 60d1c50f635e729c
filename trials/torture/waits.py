"""Waits in the threads of a run that can be broken off, because an interrupt reaches only the main thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final

LOOK_S: Final = 0.05
"""How soon a broken-off wait ends, in seconds."""


class Waits:
    """The waits of all threads of one run. Any thread.

    After they are broken off, all present and future waits raise `InterruptedError`.
    """

    def __init__(self) -> None:
        self._broken_off = threading.Event()

    def break_off(self) -> None:
        """End all waits."""
        self._broken_off.set()

    def let(self, for_s: float) -> None:
        """Let some time pass."""
        if self._broken_off.wait(for_s):
            raise InterruptedError("the run was broken off")

    def until(self, comes: Callable[[float], bool], within_s: float) -> bool:
        """Wait until something happens; return whether it did.

        Args:
            comes: waits for it, for as long as it is told or shorter, and returns whether it has come.
            within_s: after so long nobody waits any longer.
        """
        until_s = time.monotonic() + within_s
        while not comes(max(0.0, min(LOOK_S, until_s - time.monotonic()))):
            self.let(0.0)
            if time.monotonic() >= until_s:
                return False
        return True
