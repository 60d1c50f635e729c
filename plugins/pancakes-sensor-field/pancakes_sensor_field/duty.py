"""When a node is busy, and when it may save power. Pure."""

from __future__ import annotations

import math


class Duty:
    """Whether a node is busy: while an observer sees something happen, and for a while after.

    Args:
        linger_s: how long a node stays busy after the last event.

    Attributes:
        busy: whether it is busy, by the last `decide`.
    """

    def __init__(self, linger_s: float) -> None:
        self.linger_s = linger_s
        self.busy = False
        self._observers: dict[str, None] = {}
        self._calm_s = -math.inf

    @property
    def observers(self) -> list[str]:
        """The observers that see something happen right now."""
        return list(self._observers)

    def noticed(self, observer: str, busy: bool, now_s: float) -> None:
        """Take an observer's report of whether something happens."""
        if busy:
            self._observers[observer] = None
        elif observer in self._observers:
            del self._observers[observer]
            self.stirred(now_s)

    def stirred(self, now_s: float) -> None:
        """Note a momentary event, such as an alarm elsewhere, whose end no observer reports."""
        self._calm_s = max(self._calm_s, now_s + self.linger_s)

    def decide(self, now_s: float) -> bool:
        """Decide whether the node is busy at `now_s`; return whether that has changed."""
        busy = bool(self._observers) or now_s < self._calm_s - 1e-9
        changed, self.busy = busy != self.busy, busy
        return changed

    def calm_in(self, now_s: float) -> float | None:
        """Return in how many seconds it will be calm if nothing else happens; None: not by itself, or already calm."""
        return None if self._observers or not self.busy else max(0.0, self._calm_s - now_s)
