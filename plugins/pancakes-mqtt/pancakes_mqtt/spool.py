"""Messages that wait, never more than fit. Any thread."""

from __future__ import annotations

import threading
from collections import deque
from typing import Final

from pancakes_mqtt.message import Message

MOST_BYTES: Final = 16 * 1024 * 1024
"""So many bytes wait at the most, besides the number of messages; one message may always wait."""


class Spool:
    """Messages in the order in which they came.

    Where there is no room, the oldest of those falls out that may be lost (QoS 0); a message that is promised (QoS 1
    and 2) is refused where only such wait.

    Args:
        limit: how many wait at the most.
        most_bytes: how many bytes they have at the most.
    """

    def __init__(self, limit: int, most_bytes: int = MOST_BYTES) -> None:
        self._limit = limit
        self._most_bytes = most_bytes
        self._lock = threading.Lock()
        self._room = threading.Condition(self._lock)
        self._promised: deque[tuple[int, Message]] = deque()
        self._others: deque[tuple[int, Message]] = deque()
        self._number = 0
        self._bytes = 0
        self._fallen_out = 0
        self._open = True

    def put(self, message: Message) -> bool:
        """Add a message; returns whether it waits now. Once it is closed, none does."""
        with self._lock:
            return self._put(message)

    def put_patiently(self, message: Message, patience_s: float) -> bool:
        """Add a message, and waits for room for so long where it is promised and there is none.

        Returns:
            Whether it waits now. What found no room in time is not counted: it may be tried again.
        """
        with self._room:
            if message.promised:
                if not self._room.wait_for(lambda: not self._open or self._makes_room(message), patience_s):
                    return False
            return self._put(message)

    def take(self) -> Message | None:
        """Take the oldest; None where nothing waits."""
        with self._room:
            first = min((line for line in (self._promised, self._others) if line), key=_age, default=None)
            if first is None:
                return None
            message = first.popleft()[1]
            self._bytes -= message.weight
            self._room.notify()
            return message

    def forget_unpromised(self) -> int:
        """Forget what may be lost, and returns how much that was; it counts as fallen out."""
        with self._room:
            count = len(self._others)
            self._bytes -= sum(message.weight for _, message in self._others)
            self._others.clear()
            self._fallen_out += count
            self._room.notify_all()
            return count

    def close(self) -> None:
        """Take nothing more; a thread that waits for room goes on."""
        with self._room:
            self._open = False
            self._room.notify_all()

    def __len__(self) -> int:
        with self._lock:
            return len(self._promised) + len(self._others)

    @property
    def fallen_out(self) -> int:
        """How many messages have fallen out, or were refused, so far."""
        with self._lock:
            return self._fallen_out

    def _put(self, message: Message) -> bool:
        if not self._open or not self._makes_room(message):
            self._fallen_out += 1
            return False
        self._number += 1
        (self._promised if message.promised else self._others).append((self._number, message))
        self._bytes += message.weight
        return True

    def _makes_room(self, message: Message) -> bool:
        while not self._fits(message):
            if not self._others:
                return False
            self._bytes -= self._others.popleft()[1].weight
            self._fallen_out += 1
        return True

    def _fits(self, message: Message) -> bool:
        waiting = len(self._promised) + len(self._others)
        return waiting < self._limit and (not waiting or self._bytes + message.weight <= self._most_bytes)


def _age(line: deque[tuple[int, Message]]) -> int:
    return line[0][0]
