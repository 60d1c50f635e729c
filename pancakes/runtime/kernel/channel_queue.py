"""What waits for one reader on one channel, in the order in which it came."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence

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

    def make_room(self, weight: int) -> int:
        """Lets the oldest packets fall out until there is room for one more. Returns how many fell out."""
        fallen = 0
        while self.entries and self.is_full(weight):
            self.bytes -= self.entries.popleft()[2]
            fallen += 1
        if self.keep.counts_losses:
            self.lost += fallen
        return fallen


class ChannelQueue:
    """What waits for one reader on one channel: in one order, with a bound for each type. Any thread.

    Args:
        enlist: called with the queue when a packet is put into it while it is not `listed`.

    Attributes:
        listed: whether the reader knows that something waits.
        handled: how many packets were taken out.
        refused: packets from other agents that found no room under a `reliable` subscription.
    """

    __slots__ = ("_by_type", "_enlist", "_first", "_last", "_lock", "_waiting", "handled", "listed", "refused")

    def __init__(self, enlist: Callable[[ChannelQueue], None]) -> None:
        self._enlist = enlist
        self._by_type: dict[str | None, _Bounded] = {}
        self._lock = threading.Lock()
        self._first = self._last = 0  # the numbers of the packet that was last put back, and of the newest
        self._waiting = 0
        self.listed = False
        self.handled = 0
        self.refused = 0

    def bound(self, bounds: Mapping[str | None, Keep]) -> None:
        """Bounds packets of each type as `bounds` says; None means any other type. Other bounds stay."""
        with self._lock:
            for type_name, keep in bounds.items():
                if type_name in self._by_type:
                    self._by_type[type_name].keep = keep
                else:
                    self._by_type[type_name] = _Bounded(keep)

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
        with self._lock:
            bounded = self._by_type.get(packet.type) or self._by_type[None]
            keep = bounded.keep
            if not keep.reliable and (weight or len(bounded.entries) >= keep.limit):
                self._waiting -= bounded.make_room(weight)
            self._last += 1
            bounded.entries.append((self._last, packet, weight))
            bounded.bytes += weight
            self._waiting += 1
            if self.listed:
                return
            self.listed = True
        self._enlist(self)

    def put_all(self, packets: Sequence[Packet], weight: int = 0) -> None:
        """Puts packets of one type, in their order; `weight`: the bytes of each, where they are heavy."""
        with self._lock:
            bounded = self._bounded(packets[0])
            entries, keep = bounded.entries, bounded.keep
            for number, packet in enumerate(packets, self._last + 1):
                if not keep.reliable and (weight or len(entries) >= keep.limit):
                    self._waiting -= bounded.make_room(weight)
                entries.append((number, packet, weight))
                bounded.bytes += weight
            self._last += len(packets)
            self._waiting += len(packets)
            if self.listed:
                return
            self.listed = True
        self._enlist(self)

    def still_waits(self) -> bool:
        """Returns whether something waits. Where not, the queue is not listed any more."""
        with self._lock:
            self.listed = self._waiting > 0
            return self.listed

    def take(self) -> Packet | None:
        """Takes the oldest packet out; None where nothing waits."""
        with self._lock:
            oldest = None
            for bounded in self._by_type.values():
                if bounded.entries and (oldest is None or bounded.entries[0][0] < oldest.entries[0][0]):
                    oldest = bounded
            if oldest is None:
                return None
            _, packet, weight = oldest.entries.popleft()
            oldest.bytes -= weight
            self._waiting -= 1
            self.handled += 1
            return packet

    def put_back(self, packet: Packet) -> None:
        """Puts a packet that was taken back in front, to be handled again."""
        weight = weight_of(packet.body)
        with self._lock:
            bounded = self._bounded(packet)
            bounded.entries.appendleft((self._first, packet, weight))
            bounded.bytes += weight
            self._first -= 1
            self._waiting += 1
            self.handled -= 1

    def __len__(self) -> int:
        return self._waiting

    @property
    def heavy_bytes(self) -> int:
        """The bytes of the heavy packets that wait."""
        return sum(bounded.bytes for bounded in self._by_type.values())

    def dropped(self) -> int:
        """Returns how many packets were lost: those that fell out, and those that were refused from other agents.

        Where only the newest is wanted (`LATEST`), the others are not lost.
        """
        return sum(bounded.lost for bounded in self._by_type.values()) + self.refused
