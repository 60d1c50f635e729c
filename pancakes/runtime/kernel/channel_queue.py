"""What waits for one reader on one channel, in the order in which it came."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from itertools import count

from pancakes.packet import Packet
from pancakes.runtime.kernel.keep import Keep
from pancakes.runtime.weight import weight_of


class _Bounded:
    """What waits under one bound.

    Attributes:
        keep: the bound.
        entries: each packet with its number and its weight; numbers grow, over all bounds of the queue.
        bytes: the sum of the weights.
        lost: how many packets have fallen out that the reader wanted.
    """

    __slots__ = ("bytes", "entries", "keep", "lost")

    def __init__(self, keep: Keep) -> None:
        self.keep = keep
        self.entries: deque[tuple[int, Packet, int]] = deque()
        self.bytes = 0
        self.lost = 0

    def is_full(self, weight: int) -> bool:
        return self.keep.is_full(len(self.entries), self.bytes, weight)

    def make_room(self, weight: int) -> None:
        """Lets the oldest packets fall out until there is room for one more."""
        while self.entries and self.is_full(weight):
            try:
                fallen = self.entries.popleft()
            except IndexError:  # the reader was faster
                return
            self.bytes -= fallen[2]
            self.lost += self.keep.counts_losses


class ChannelQueue:
    """What waits for one reader on one channel: in one order, with a bound for each type.

    Any thread puts, and only the reader's takes. A light packet that finds room needs no lock: a deque, a dict and a
    `count` change in one step. Publishers that put at the same moment may pass the limit by one packet each.

    Args:
        waiting: the queues of the reader in which something may wait; the queue enters itself there.
        wake: called when it has done so.

    Attributes:
        handled: how many packets were taken out.
        refused: packets from other agents that found no room under a `reliable` subscription.
    """

    __slots__ = ("_by_type", "_first", "_lock", "_numbers", "_waiting", "_wake", "handled", "refused")

    def __init__(self, waiting: dict[ChannelQueue, None], wake: Callable[[], None]) -> None:
        self._waiting = waiting
        self._wake = wake
        self._by_type: dict[str | None, _Bounded] = {}  # never changed but replaced: other threads read it
        self._numbers = count(1)
        self._first = 0  # the number of the packet that was last put back
        self._lock = threading.Lock()  # guards the bytes and the losses
        self.handled = 0
        self.refused = 0

    def bound(self, bounds: Mapping[str | None, Keep]) -> None:
        """Bounds packets of each type as `bounds` says; None means any other type. Other bounds stay."""
        by_type = dict(self._by_type)
        for type_name, keep in bounds.items():
            if type_name in by_type:
                by_type[type_name].keep = keep
            else:
                by_type[type_name] = _Bounded(keep)
        self._by_type = by_type

    def keep_of(self, packet: Packet) -> Keep:
        """Returns the bound of packets like this one."""
        return self._bounded(packet).keep

    def _bounded(self, packet: Packet) -> _Bounded:
        return self._by_type.get(packet.type) or self._by_type[None]

    def refuses(self, packet: Packet, weight: int) -> bool:
        """Returns whether `packet` must be refused to its publisher; `weight`: its bytes, where it is a heavy one."""
        bounded = self._bounded(packet)
        return bounded.keep.reliable and bounded.is_full(weight)

    def put(self, packet: Packet, weight: int = 0) -> None:
        """Puts a packet; `weight`: its bytes, where it is a heavy one."""
        bounded = self._by_type.get(packet.type) or self._by_type[None]
        if weight or len(bounded.entries) >= bounded.keep.limit:
            with self._lock:
                if not bounded.keep.reliable:
                    bounded.make_room(weight)
                bounded.bytes += weight
        bounded.entries.append((next(self._numbers), packet, weight))
        if self not in self._waiting:
            self._waiting[self] = None
            self._wake()

    def take(self) -> Packet | None:
        """Takes the oldest packet out; None where nothing waits."""
        while True:
            oldest = None
            try:
                for bounded in self._by_type.values():
                    if bounded.entries and (oldest is None or bounded.entries[0][0] < oldest.entries[0][0]):
                        oldest = bounded
                if oldest is None:
                    return None
                _, packet, weight = oldest.entries.popleft()
            except IndexError:  # it fell out meanwhile
                continue
            if weight:
                with self._lock:
                    oldest.bytes -= weight
            self.handled += 1
            return packet

    def put_back(self, packet: Packet) -> None:
        """Puts a packet that the reader took back in front, to be handled again."""
        weight = weight_of(packet.body)
        bounded = self._bounded(packet)
        with self._lock:
            bounded.bytes += weight
        bounded.entries.appendleft((self._first, packet, weight))
        self._first -= 1
        self.handled -= 1

    def __len__(self) -> int:
        number = 0
        for bounded in self._by_type.values():
            number += len(bounded.entries)
        return number

    @property
    def heavy_bytes(self) -> int:
        """The bytes of the heavy packets that wait."""
        return sum(bounded.bytes for bounded in self._by_type.values())

    def dropped(self) -> int:
        """Returns how many packets were lost: those that fell out, and those that were refused from other agents.

        Where only the newest is wanted (`LATEST`), the others are not lost.
        """
        return sum(bounded.lost for bounded in self._by_type.values()) + self.refused
