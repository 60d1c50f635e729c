"""What a thread is told while it waits for a point in time."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from typing import Any, Final

LONGEST_S: Final = 3600.0
"""A thread waits no longer at a time: the system cannot wait further than some centuries ahead."""


class Inbox:
    """Messages for one thread, which waits for the next, or until it has something else to do.

    Not a `queue.SimpleQueue`, whose timed `get` may wait for ever (Python 3.11 and 3.12): where a message was taken
    just before, and the time is up before it has come to wait, it waits without any limit. Counted on a busy machine,
    with waits of 1 ns to 20 µs: once in some thousand. The timer then gave no ticks until a message came.
    """

    def __init__(self) -> None:
        self._messages: deque[Any] = deque()
        # Held while no message has been put.
        self._bell = threading.Lock()
        self._bell.acquire()

    def put(self, message: Any, /) -> None:
        """Adds a message. Any thread."""
        self._messages.append(message)
        with contextlib.suppress(RuntimeError):  # it rings already
            self._bell.release()

    def wait(self, timeout_s: float) -> None:
        """Waits for a message where there is none, but not longer than that; it may come back earlier."""
        # First the look, then the bell: a thread that puts a message rings after that.
        if not self._messages and timeout_s > 0:
            self._bell.acquire(timeout=min(timeout_s, LONGEST_S))

    def get(self) -> Any:
        """Takes the oldest message out, and waits for it."""
        while not self._messages:
            self.wait(LONGEST_S)
        self._bell.acquire(blocking=False)  # or it would ring for what is taken now
        return self._messages.popleft()

    def empty(self) -> bool:
        """Returns whether there is no message."""
        return not self._messages

    def __len__(self) -> int:
        return len(self._messages)
