"""What a thread of ROS 2 leaves for an actor: bounded, the oldest falls out and is counted."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

_T = TypeVar("_T")


class Newest(Generic[_T]):
    """The newest things that came and were not taken yet. Any thread.

    Args:
        depth: how many are kept.
        wake: called when the first thing comes after all were taken; so at most one call of the taker is under way.
    """

    def __init__(self, depth: int, wake: Callable[[], None]) -> None:
        self._lock = threading.Lock()
        self._things: deque[_T] = deque(maxlen=depth)
        self._wake = wake
        self._left_out = 0

    def put(self, thing: _T) -> None:
        """Leaves a thing."""
        with self._lock:
            was_empty = not self._things
            self._left_out += len(self._things) == self._things.maxlen
            self._things.append(thing)
        if was_empty:
            self._wake()

    def take(self) -> tuple[list[_T], int]:
        """Returns all that wait, oldest first, and how many have fallen out since the last call."""
        with self._lock:
            things, left_out = list(self._things), self._left_out
            self._things.clear()
            self._left_out = 0
        return things, left_out
