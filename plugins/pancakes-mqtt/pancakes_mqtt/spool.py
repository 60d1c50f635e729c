"""A bounded queue of messages. Any thread."""

from __future__ import annotations

import threading
from collections import deque
from typing import Final

from pancakes_mqtt.message import Message

MOST_BYTES: Final = 16 * 1024 * 1024
"""The most bytes that wait; one message may always wait, whatever its size."""


class Spool:
    """Messages in the order in which they came.

    If there is no room, the oldest message that may be lost (QoS 0) is dropped; if only promised messages (QoS 1 and 2)
    wait, a new promised one is refused.

    Args:
        limit: the most messages that wait.
        most_bytes: the most bytes that wait.
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
        """Add a message; return whether it waits now. After `close` none does."""
        with self._lock:
            return self._put(message)

    def put_patiently(self, message: Message, patience_s: float) -> bool:
        """Add a message; a promised one waits up to `patience_s` for room.

        Returns:
            Whether it waits now. A message without room in time is not counted: it may be tried again.
        """
        with self._room:
            if message.promised:
                if not self._room.wait_for(lambda: not self._open or self._makes_room(message), patience_s):
                    return False
            return self._put(message)

    def take(self) -> Message | None:
        """Take the oldest message; None if none waits."""
        with self._room:
            first = min((line for line in (self._promised, self._others) if line), key=_age, default=None)
            if first is None:
                return None
            message = first.popleft()[1]
            self._bytes -= message.weight
            self._room.notify()
            return message

    def forget_unpromised(self) -> int:
        """Drop the messages that may be lost, and return how many; they count as dropped."""
        with self._room:
            count = len(self._others)
            self._bytes -= sum(message.weight for _, message in self._others)
            self._others.clear()
            self._fallen_out += count
            self._room.notify_all()
            return count

    def close(self) -> None:
        """Accept no more messages; a thread that waits for room continues."""
        with self._room:
            self._open = False
            self._room.notify_all()

    def __len__(self) -> int:
        with self._lock:
            return len(self._promised) + len(self._others)

    @property
    def fallen_out(self) -> int:
        """How many messages were dropped or refused so far."""
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
