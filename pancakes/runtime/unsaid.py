"""What is to be said on `log` before there is a Log Service to hear it."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Final

MOST: Final = 1024
"""So much is kept until then; then the oldest falls out."""


class Unsaid:
    """Says things, once the agent is ready, in the order in which they came: links may stand before that. Any thread.

    Args:
        ready: set once it is.
    """

    def __init__(self, ready: threading.Event) -> None:
        self._ready = ready
        self._waiting: deque[Callable[[], None]] = deque(maxlen=MOST)

    def say(self, say: Callable[[], None]) -> None:
        """Calls `say`, at once where the agent is ready."""
        self._waiting.append(say)
        if self._ready.is_set():
            self.say_all()

    def say_all(self) -> None:
        """Says what waits: two threads may do so at once, and each takes what it finds."""
        while self._waiting:
            try:
                say = self._waiting.popleft()
            except IndexError:
                return
            say()
