"""How often something may happen. Pure."""

from __future__ import annotations


class Bucket:
    """Lets so many through at once, and so many in each second after that.

    Args:
        at_once: how many, at first and after a pause.
        rate_hz: how many in a second.
        now_s: host time.
    """

    def __init__(self, at_once: float, rate_hz: float, now_s: float) -> None:
        self._at_once = at_once
        self._rate_hz = rate_hz
        self._room = at_once
        self._filled_s = now_s

    def take(self, number: int, now_s: float) -> bool:
        """Returns whether `number` more may happen now, all of them or none; they then count as happened."""
        self._room = min(self._at_once, self._room + (now_s - self._filled_s) * self._rate_hz)
        self._filled_s = now_s
        if self._room < number:
            return False
        self._room -= number
        return True
