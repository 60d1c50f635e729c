"""When a node is busy, and when it may save power. Pure."""

from __future__ import annotations

import math


class Duty:
    """Whether something happens at a node: so much for each of those who look, and for a while after the last.

    Args:
        linger_s: how long a node stays busy when nothing happens any more.

    Attributes:
        busy: whether it is, as `decide` last found.
    """

    def __init__(self, linger_s: float) -> None:
        self.linger_s = linger_s
        self.busy = False
        self._who: dict[str, None] = {}
        self._calm_s = -math.inf

    @property
    def who(self) -> list[str]:
        """Those at whom something happens right now."""
        return list(self._who)

    def noticed(self, who: str, busy: bool, now_s: float) -> None:
        """Somebody who looks says whether something happens."""
        if busy:
            self._who[who] = None
        elif who in self._who:
            del self._who[who]
            self.stirred(now_s)

    def stirred(self, now_s: float) -> None:
        """Something happens just now, such as an alarm elsewhere, that nobody will say the end of."""
        self._calm_s = max(self._calm_s, now_s + self.linger_s)

    def decide(self, now_s: float) -> bool:
        """Works out whether the node is busy at `now_s`; returns whether that has changed."""
        busy = bool(self._who) or now_s < self._calm_s - 1e-9
        changed, self.busy = busy != self.busy, busy
        return changed

    def calm_in(self, now_s: float) -> float | None:
        """Returns in how many seconds it will be calm if nothing else happens; None: not by itself, or it is."""
        return None if self._who or not self.busy else max(0.0, self._calm_s - now_s)
