"""Threads that wait for what the transport's thread learns."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from typing import Final

from pancakes.errors import PancakesError
from pancakes.runtime.clock import Clock

LOOK_S: Final = 0.1
"""How often a wait looks again at facts that come without an event, such as an agent that says it sleeps."""
CLOSED: Final = "the client is closed: make a new one"


class Waits:
    """Lets any thread wait until a condition is true, which is looked at whenever there is news.

    Args:
        clock: the host clock.
        lock: held while a condition is looked at.
    """

    def __init__(self, clock: Clock, lock: AbstractContextManager[object]) -> None:
        self._clock = clock
        self._lock = lock
        self._closed = False
        # One for each thread that waits, held while there is no news. No `Condition`: Ctrl-C in the middle of its
        # `wait`, which is written in Python, leaves its lock in disorder, and a program that then ends in good order
        # waits for ever.
        self._no_news: list[threading.Lock] = []

    def tell(self) -> None:
        """There is news."""
        for no_news in tuple(self._no_news):
            with suppress(RuntimeError):  # there is some already
                no_news.release()

    def close(self) -> None:
        """Ends all waits, those to come too, with an error."""
        self._closed = True
        self.tell()

    def until(self, until_s: float, condition: Callable[[], bool]) -> bool:
        """Waits until the condition is true, at most until a host time; returns whether it is.

        Raises:
            PancakesError: the client is closed, or is closed meanwhile.
        """
        no_news = threading.Lock()
        no_news.acquire()
        self._no_news.append(no_news)
        try:
            while True:
                if self._closed:
                    raise PancakesError(CLOSED)
                with self._lock:
                    if condition():
                        return True
                left_s = until_s - self._clock.now()
                if left_s <= 0:
                    return False
                no_news.acquire(timeout=min(left_s, LOOK_S))
        finally:
            self._no_news.remove(no_news)
