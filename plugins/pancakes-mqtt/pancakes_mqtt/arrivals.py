"""Messages on their way from the thread of a connection to the actor that makes packets of them. Any thread."""

from __future__ import annotations

import threading
from typing import Final

from pancakes_mqtt.message import Message
from pancakes_mqtt.spool import Spool

PATIENCE_S: Final = 1.0


class Arrivals:
    """A spool with a bell, which rings once for all that waits.

    What is promised is never lost here: the thread that brings it waits for room, and the broker with it.

    Args:
        limit: how many wait at the most.
    """

    def __init__(self, limit: int) -> None:
        self._spool = Spool(limit)
        self._lock = threading.Lock()
        self._rung = False
        self._closed = False

    def put(self, message: Message) -> bool:
        """Add a message; returns whether the reader is to be told that something waits."""
        while not self._spool.put_patiently(message, PATIENCE_S):
            with self._lock:
                if self._closed or not message.promised:
                    return False
        return self.ring()

    def ring(self) -> bool:
        """Return whether the reader is to be told that something waits: it has not been told yet."""
        with self._lock:
            if self._rung or not len(self._spool):
                return False
            self._rung = True
            return True

    def answered(self) -> None:
        """The reader has taken all that it found, and is to be told of what comes from now on."""
        with self._lock:
            self._rung = False

    def take(self) -> Message | None:
        """Take the oldest message; None where none waits."""
        return self._spool.take()

    def close(self) -> None:
        """Take nothing more."""
        with self._lock:
            self._closed = True
        self._spool.close()

    @property
    def fallen_out(self) -> int:
        """How many messages that may be lost have fallen out."""
        return self._spool.fallen_out
