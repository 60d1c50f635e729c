"""What waits for one reader on one channel under one bound: put and taken without a lock."""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from pancakes.kernel.keep import MOST_BYTES, Keep
from pancakes.packet import Packet
from pancakes.weight import heavy_weight

if TYPE_CHECKING:
    from pancakes.kernel.mailbox import Mailbox

# Held for a few operations, and only where a packet is heavy or lost, so one for all queues will do.
_BOOKS: Final = threading.Lock()


class ChannelQueue:
    """What waits for one reader on one channel, under one subscription.

    Attributes:
        items: what waits, the oldest first.
        limit: how many packets may wait, as far as the queue has to see to that.
        shared: whether packets under several bounds wait here (`SharedQueue`).
        listed: whether its reader knows that something waits, or soon will.
        handled: how many packets its reader has taken out.
        dropped: how many were lost: they fell out, or came from another agent and found no room.
        heavy: the bytes of each heavy packet that waits, by its `id`; None until the first has come.
        heavy_bytes: their sum.
    """

    __slots__ = (
        "bounds",
        "channel",
        "dropped",
        "handled",
        "heavy",
        "heavy_bytes",
        "items",
        "keep",
        "limit",
        "listed",
        "mailbox",
        "shared",
        "take",
    )

    def __init__(self, mailbox: Mailbox, channel: str, bounds: Mapping[str | None, Keep]) -> None:
        self.mailbox = mailbox
        self.channel = channel
        self.bounds = bounds
        self.keep = keep = next(iter(bounds.values()))
        # Not bounded by `maxlen`: what falls out is to be counted, and weighs no more. Whoever puts too much does that.
        # To count all that is put, and to derive from that what was lost, costs each delivery 50 ns more.
        self.items: deque[Packet] = deque()
        # Under `reliable` a publisher asks before he puts.
        self.limit = sys.maxsize if keep.reliable else keep.limit
        self.shared = False
        self.listed = False
        self.handled = 0
        self.dropped = 0
        self.heavy: dict[int, int] | None = None
        self.heavy_bytes = 0
        # What `pop` does, for the reader's turn.
        self.take: Callable[[], Packet] = self.items.popleft

    @property
    def has_reliable(self) -> bool:
        """Whether it may refuse a packet."""
        return self.keep.reliable

    def reliable_for(self, packet: Packet) -> bool:
        """Returns whether `packet` came under a subscription that may lose none."""
        return self.keep.reliable

    def full(self, packet: Packet, weight: int = 0) -> bool:
        """Returns whether `packet` would be refused; `weight`: its bytes, where it is a heavy one."""
        if not self.keep.reliable:
            return False
        waiting = len(self.items)
        return waiting >= self.keep.limit or (waiting > 0 and weight > 0 and self.heavy_bytes + weight > MOST_BYTES)

    def put(self, packet: Packet) -> None:
        self.items.append(packet)
        if len(self.items) > self.limit:
            self.shorten()
        # Whoever finds it listed need not ask for a turn: who listed it does, and a reader unlists before it counts.
        if not self.listed:
            self.enlist()

    def put_all(self, packets: Sequence[Packet]) -> None:
        """Puts several packets, none of them heavy, in their order."""
        self.items.extend(packets)
        if len(self.items) > self.limit:
            self.shorten()
        if not self.listed:
            self.enlist()

    def put_heavy(self, packet: Packet, weight: int) -> None:
        """Puts a packet of so many bytes; the oldest fall out until there is room, except under `reliable`."""
        with _BOOKS:
            if self.heavy is None or not self.items:
                self.heavy = {}
                self.heavy_bytes = 0
            if not self.keep.reliable:
                self._make_room(weight)
            # The same packet may have been published twice.
            self.heavy_bytes += weight - self.heavy.get(id(packet), 0)
            self.heavy[id(packet)] = weight
            self.items.append(packet)
        if not self.listed:
            self.enlist()

    def lighten(self, packet: Packet) -> None:
        """Forgets the weight of a packet that was taken out; called where `heavy` has something in it."""
        if self.heavy is not None and id(packet) in self.heavy:
            with _BOOKS:
                self._unload(packet)

    def shorten(self) -> None:
        """Lets the oldest fall out until no more wait than may; for who has put something in and finds too much."""
        while len(self.items) > self.limit:
            try:
                oldest = self.items.popleft()
            except IndexError:  # its reader was faster
                return
            with _BOOKS:
                self.dropped += 1
                if self.heavy:
                    self._unload(oldest)

    def lose(self, number: int) -> None:
        """Counts packets that were lost."""
        with _BOOKS:
            self.dropped += number

    def _make_room(self, weight: int) -> None:
        """Lets the oldest fall out until there is room for another packet of so many bytes. Under the lock."""
        while self.items and (len(self.items) >= self.limit or self.heavy_bytes + weight > MOST_BYTES):
            try:
                oldest = self.items.popleft()
            except IndexError:  # its reader was faster
                return
            self.dropped += 1
            self._unload(oldest)

    def _unload(self, packet: Packet) -> None:
        """Forgets the weight of a packet, if it has one. Under the lock."""
        if self.heavy is not None:
            self.heavy_bytes -= self.heavy.pop(id(packet), 0)

    def enlist(self) -> None:
        """Tells the reader that something waits here; for who has put something in and found it not listed."""
        # Two publishers may both list the queue: an empty queue in the list harms nobody, a forgotten one would.
        self.listed = True
        mailbox = self.mailbox
        mailbox.waiting.append(self)
        if mailbox.take_token():
            mailbox.dispatch.ready(mailbox)

    def pop(self) -> Packet | None:
        """Takes the oldest packet out; None where nothing waits."""
        try:
            packet = self.take()
        except IndexError:
            return None
        self.handled += 1
        if self.heavy:
            self.lighten(packet)
        return packet

    def push_back(self, packet: Packet) -> None:
        """Puts a packet back in front, to be handled again."""
        self.handled -= 1
        weight = heavy_weight(packet)
        if weight:
            with _BOOKS:
                self.heavy = self.heavy or {}
                self.heavy[id(packet)] = weight
                self.heavy_bytes += weight
        self.items.appendleft(packet)

    def __len__(self) -> int:
        return len(self.items)
