"""How old the newest reading of a sensor is. Any thread."""

from __future__ import annotations

import threading
from typing import Final

ROUNDING_S: Final = 1e-9
"""A timer may come earlier than it should by a rounding."""


class Freshness:
    """When a sensor was heard last, and whether it was found silent since."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last_s = 0.0
        self._stale = False

    def heard(self, now_s: float) -> bool:
        """A reading has come; returns whether the sensor had been found silent."""
        with self._lock:
            was, self._stale, self._last_s = self._stale, False, now_s
            return was

    def look(self, now_s: float, stale_after_s: float) -> tuple[float, float | None]:
        """Looks whether readings still come.

        Returns:
            When to look again, in seconds; and for how long none has come, where it has just grown too long.
        """
        with self._lock:
            left_s = self._last_s + stale_after_s - now_s
            if left_s > ROUNDING_S:
                return left_s, None
            was, self._stale = self._stale, True
            return stale_after_s, None if was else now_s - self._last_s
