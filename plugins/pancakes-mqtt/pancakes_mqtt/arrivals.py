"""Messages on their way from the thread of a connection to the actor that makes packets of them. Any thread."""

from __future__ import annotations

import threading
from typing import Final

from pancakes_mqtt.message import Message
from pancakes_mqtt.spool import Spool

PATIENCE_S: Final = 1.0


class Arrivals:
    """A spool that notifies its reader once for all waiting messages.

    Promised messages (QoS 1 and 2) are never lost here: the connection's thread waits for room, and so the broker does.

    Args:
        limit: the most messages that wait.
    """

    def __init__(self, limit: int) -> None:
        self._spool = Spool(limit)
        self._lock = threading.Lock()
        self._rung = False
        self._closed = False

    def put(self, message: Message) -> bool:
        """Add a message; return whether the reader must be notified."""
        while not self._spool.put_patiently(message, PATIENCE_S):
            with self._lock:
                if self._closed or not message.promised:
                    return False
        return self.ring()

    def ring(self) -> bool:
        """Return whether the reader must be notified: messages wait and it is not notified yet."""
        with self._lock:
            if self._rung or not len(self._spool):
                return False
            self._rung = True
            return True

    def answered(self) -> None:
        """Note that the reader has taken all messages: it must be notified of the next one."""
        with self._lock:
            self._rung = False

    def take(self) -> Message | None:
        """Take the oldest message; None if none waits."""
        return self._spool.take()

    def close(self) -> None:
        """Accept no more messages."""
        with self._lock:
            self._closed = True
        self._spool.close()

    @property
    def fallen_out(self) -> int:
        """How many messages that may be lost were dropped."""
        return self._spool.fallen_out
