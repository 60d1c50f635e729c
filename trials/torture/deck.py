"""Deal out the kinds of faults to several fleets, so that each kind is equally frequent."""

from __future__ import annotations

import random
import threading
from collections.abc import Collection, Sequence


class Deck:
    """All kinds in random order, again and again. Any thread.

    Args:
        kinds: all of them.
        count: the most kinds to deal out, in all.
        draw: draws the order.

    Attributes:
        left: how many may still be dealt out.
    """

    def __init__(self, kinds: Sequence[str], count: int, draw: random.Random) -> None:
        self._kinds = tuple(kinds)
        self.left = count
        self._random = draw
        self._lock = threading.Lock()
        self._cards: list[str] = []

    def deal(self, unfit: Collection[str] = ()) -> str:
        """Return the next kind that is not in `unfit`; empty: none is left.

        Args:
            unfit: kinds that cannot be had just now; others get them later.
        """
        with self._lock:
            if self.left <= 0 or not set(self._kinds) - set(unfit):
                return ""
            while not (fit := [kind for kind in self._cards if kind not in unfit]):
                self._cards += self._random.sample(self._kinds, len(self._kinds))
            self._cards.remove(fit[0])
            self.left -= 1
            return fit[0]
