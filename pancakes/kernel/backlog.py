"""What waits for one reader that may be slow, such as a disk or a terminal: bounded in packets and in bytes."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

from pancakes.kernel.counter import Counter
from pancakes.packet import Packet
from pancakes.weight import LIGHT_BYTES, weigher

MOST_BYTES: Final = 64 * 1024 * 1024
"""So many bytes of bodies wait, besides bodies lighter than `LIGHT_BYTES`; one may always wait."""

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class _Heavy(Generic[Item]):
    """What belongs to a heavy packet, and how heavy that is."""

    item: Item
    weight: int


class Backlog(Generic[Item]):
    """Keeps the newest packets, each with what belongs to it; of more than there is room for the oldest fall out.

    Any thread may put and take. A light packet costs whoever puts it no lock.

    Args:
        limit: so many packets wait at the most.
        most_bytes: so many bytes of heavy packets.

    Attributes:
        heavy_bytes: the bytes of the heavy packets that wait.
    """

    def __init__(self, limit: int, most_bytes: int = MOST_BYTES) -> None:
        self._limit = limit
        self._most_bytes = most_bytes
        self._items: deque[Item | _Heavy[Item]] = deque()
        self._dropped = Counter()
        # Guards `heavy_bytes` for a few operations, and only where a heavy packet comes or goes.
        self._scales = threading.Lock()
        self.heavy_bytes = 0

    def put(self, packet: Packet, item: Item) -> None:
        """Puts what belongs to a packet, which is as heavy as the packet's body."""
        weigh = weigher(type(packet.body))
        if weigh is None or (weight := weigh(packet.body)) <= LIGHT_BYTES:
            self._items.append(item)
        else:
            self._load(weight)
            self._items.append(_Heavy(item, weight))
        while len(self._items) > self._limit or (self.heavy_bytes > self._most_bytes and len(self._items) > 1):
            if self.take() is None:
                return
            self._dropped.take()

    def take(self) -> Item | None:
        """Takes the oldest out; None where nothing waits."""
        try:
            item = self._items.popleft()
        except IndexError:
            return None
        if isinstance(item, _Heavy):
            self._load(-item.weight)
            return item.item
        return item

    def clear(self) -> None:
        """Forgets what waits, without counting it as fallen out."""
        while self.take() is not None:
            pass

    @property
    def dropped(self) -> int:
        """How many packets fell out."""
        return self._dropped.value

    def __len__(self) -> int:
        return len(self._items)

    def _load(self, weight: int) -> None:
        with self._scales:
            self.heavy_bytes += weight
