"""What waits for one reader on one channel under several bounds, one for each type, in one order."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

from pancakes.kernel.channel_queue import ChannelQueue
from pancakes.kernel.keep import LATEST, MOST_BYTES, Keep
from pancakes.packet import Packet
from pancakes.weight import heavy_weight

if TYPE_CHECKING:
    from pancakes.kernel.mailbox import Mailbox

SPARE: Final = 64
SPARE_BYTES: Final = MOST_BYTES // 8
"""So many packets, or as many as half of all, and so many bytes of heavy ones stay in the row of a shared queue after
they have fallen out.
"""


class _Lane:
    """What waits in a shared queue under one subscription.

    Its packets are numbered in the order in which they came; the ones that wait are those from `first` on.

    Attributes:
        keep: its bound.
        most: how many packets may wait, as far as the queue has to see to that.
        first: the number of the oldest that waits.
        next: the number that the next one will have.
        fallen: how many have fallen out and are still in the queue's row, before the first.
        lost: how many have ever fallen out, where more than the newest is wanted.
        weights: of the heavy ones, by number.
        bytes: their sum.
    """

    __slots__ = ("bytes", "fallen", "first", "keep", "lost", "most", "next", "weights")

    def __init__(self, keep: Keep) -> None:
        self.keep = keep
        self.most = math.inf if keep.reliable else keep.limit  # a publisher asks before he puts under `reliable`
        self.first = 0
        self.next = 0
        self.fallen = 0
        self.lost = 0
        self.weights: dict[int, int] = {}
        self.bytes = 0


class SharedQueue(ChannelQueue):
    """What waits for one reader on one channel under several subscriptions, each with its own bound.

    One order for all types, therefore one row and a lock, which is held for a few operations and never over a call out.
    A packet that falls out stays in the row until the reader comes to it or enough others have fallen out as well: to
    take it out of the middle at once took 0.5 µs a packet more.
    """

    __slots__ = ("_fallen", "_fallen_bytes", "_lanes", "_lock", "_others")

    def __init__(self, mailbox: Mailbox, channel: str, bounds: Mapping[str | None, Keep]) -> None:
        super().__init__(mailbox, channel, bounds)
        self.items = deque()
        self._lanes = {name: _Lane(keep) for name, keep in bounds.items()}
        self._others = self._lanes.get(None)
        self._lock = threading.Lock()
        self._fallen = 0  # as those of the lanes, of all of them
        self._fallen_bytes = 0
        self.shared = True
        self.take = self._take

    def _lane(self, packet: Packet) -> _Lane:
        lane = self._lanes.get(packet.type, self._others)
        assert lane is not None, f"nobody here listens to {packet.type}"
        return lane

    @property
    def has_reliable(self) -> bool:
        return any(keep.reliable for keep in self.bounds.values())

    def reliable_for(self, packet: Packet) -> bool:
        return self._lane(packet).keep.reliable

    def full(self, packet: Packet, weight: int = 0) -> bool:
        lane = self._lane(packet)
        return lane.keep.reliable and _is_full(lane, weight)

    def put(self, packet: Packet) -> None:
        lane = self._lanes.get(packet.type, self._others)
        assert lane is not None
        with self._lock:
            lane.next += 1
            self.items.append(packet)
            if lane.next - lane.first > lane.most:
                self._let_fall(lane, 1)
        if not self.listed:
            self.enlist()

    def put_all(self, packets: Sequence[Packet]) -> None:
        lane = self._lanes.get(packets[0].type, self._others)
        assert lane is not None
        with self._lock:
            lane.next += len(packets)
            self.items.extend(packets)
            if lane.next - lane.first > lane.most:
                self._let_fall(lane, lane.next - lane.first - lane.keep.limit)
        if not self.listed:
            self.enlist()

    def put_heavy(self, packet: Packet, weight: int) -> None:
        lane = self._lane(packet)
        with self._lock:
            while not lane.keep.reliable and _is_full(lane, weight):
                self._let_fall(lane, 1)
            self._weigh(lane, lane.next, weight)
            lane.next += 1
            self.items.append(packet)
        if not self.listed:
            self.enlist()

    def _let_fall(self, lane: _Lane, number: int) -> None:
        """Lets so many of a lane's packets fall out, the oldest first. Under the lock."""
        if lane.weights:
            for fallen in range(lane.first, lane.first + number):
                self._fallen_bytes += self._unweigh(lane, fallen)
        lane.first += number
        lane.fallen += number
        if lane.keep != LATEST:
            lane.lost += number
        self._fallen += number
        if self._fallen > max(SPARE, len(self.items) // 2) or self._fallen_bytes > SPARE_BYTES:
            self._sweep()

    def _sweep(self) -> None:
        """Takes those that have fallen out of the row. Under the lock."""
        kept = []
        for packet in self.items:
            lane = self._lane(packet)
            if lane.fallen:
                lane.fallen -= 1
            else:
                kept.append(packet)
        self._fallen = self._fallen_bytes = 0
        self.items.clear()
        self.items.extend(kept)

    def _weigh(self, lane: _Lane, number: int, weight: int) -> None:
        if weight:
            lane.weights[number] = weight
            lane.bytes += weight
            self.heavy_bytes += weight

    def _unweigh(self, lane: _Lane, number: int) -> int:
        weight = lane.weights.pop(number, 0)
        lane.bytes -= weight
        self.heavy_bytes -= weight
        return weight

    def _take(self) -> Packet:
        lanes, others = self._lanes, self._others
        with self._lock:
            while True:
                packet = self.items.popleft()
                lane = lanes.get(packet.type, others)
                assert lane is not None
                if lane.fallen:
                    lane.fallen -= 1
                    self._fallen -= 1
                    continue
                if lane.weights:
                    self._unweigh(lane, lane.first)
                lane.first += 1
                return packet

    def push_back(self, packet: Packet) -> None:
        weight = heavy_weight(packet)
        with self._lock:
            self.handled -= 1
            if self._fallen:
                self._sweep()  # those are older, and would be taken for this one
            lane = self._lane(packet)
            lane.first -= 1
            self._weigh(lane, lane.first, weight)
            self.items.appendleft(packet)

    def __len__(self) -> int:
        return sum(lane.next - lane.first for lane in self._lanes.values())

    def offered(self) -> int:
        return sum(lane.next for lane in self._lanes.values())

    def dropped(self) -> int:
        with self._lock:
            return sum(lane.lost for lane in self._lanes.values()) + self.refused + self.earlier


def _is_full(lane: _Lane, weight: int) -> bool:
    waiting = lane.next - lane.first
    return waiting >= lane.keep.limit or (waiting > 0 and weight > 0 and lane.bytes + weight > MOST_BYTES)
