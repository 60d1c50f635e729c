"""What waits for one reader that may be slow, such as a disk or a terminal: bounded in packets and in bytes."""

from __future__ import annotations

import threading
from collections import deque
from typing import Final, Generic, TypeVar

from pancakes.packet import Packet
from pancakes.runtime.weight import weight_of

MOST_BYTES: Final = 64 * 1024 * 1024
"""So many bytes of bodies wait, besides bodies lighter than `LIGHT_BYTES`; one may always wait."""

Item = TypeVar("Item")


class Backlog(Generic[Item]):
    """Keeps the newest packets, each with what belongs to it; of more than there is room for the oldest fall out.

    Any thread may put and take.

    Args:
        limit: so many packets wait at the most.
        most_bytes: so many bytes of heavy packets.

    Attributes:
        heavy_bytes: the bytes of the heavy packets that wait.
        dropped: how many packets fell out.
    """

    def __init__(self, limit: int, most_bytes: int = MOST_BYTES) -> None:
        self._limit = limit
        self._most_bytes = most_bytes
        self._lock = threading.Lock()
        # Beside each other: a pair for each item would be one more object for the garbage collector to look at.
        self._items: deque[Item] = deque()
        self._weights: deque[int] = deque()
        self.heavy_bytes = 0
        self.dropped = 0

    def put(self, packet: Packet, item: Item) -> None:
        """Puts what belongs to a packet, which is as heavy as the packet's body."""
        weight = weight_of(packet.body)
        with self._lock:
            self._items.append(item)
            self._weights.append(weight)
            self.heavy_bytes += weight
            while len(self._items) > self._limit or (self.heavy_bytes > self._most_bytes and len(self._items) > 1):
                self._pop()
                self.dropped += 1

    def take(self) -> Item | None:
        """Takes the oldest out; None where nothing waits."""
        with self._lock:
            return self._pop() if self._items else None

    def clear(self) -> None:
        """Forgets what waits, without counting it as fallen out."""
        while self.take() is not None:
            pass

    def __len__(self) -> int:
        return len(self._items)

    def _pop(self) -> Item:
        self.heavy_bytes -= self._weights.popleft()
        return self._items.popleft()
