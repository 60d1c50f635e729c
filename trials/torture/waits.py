"""Waits in the threads of a run, which whoever ends the run breaks off: an interrupt comes to the main thread alone."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final

LOOK_S: Final = 0.05
"""So soon a wait for something ends that is broken off."""


class Waits:
    """The waits of all threads of one run. Any thread.

    Once they are broken off, each of them raises `InterruptedError`, those to come as well.
    """

    def __init__(self) -> None:
        self._broken_off = threading.Event()

    def break_off(self) -> None:
        """Ends all waits."""
        self._broken_off.set()

    def let(self, for_s: float) -> None:
        """Lets so much time pass."""
        if self._broken_off.wait(for_s):
            raise InterruptedError("the run was broken off")

    def until(self, comes: Callable[[float], bool], within_s: float) -> bool:
        """Waits until something comes; returns whether it did.

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
