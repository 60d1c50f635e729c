"""What waits for one reader on one channel under one bound: put and taken without a lock."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from pancakes.kernel.counter import Counter
from pancakes.kernel.keep import LATEST, MOST_BYTES, Keep
from pancakes.packet import Packet
from pancakes.weight import heavy_weight

if TYPE_CHECKING:
    from pancakes.kernel.mailbox import Mailbox

# Held for a few operations, and only for a heavy packet, so one for all queues will do.
_SCALES: Final = threading.Lock()

# Held while the packets of a run are counted, which `Counter` would do one by one.
_RUNS: Final = threading.Lock()


class ChannelQueue:
    """What waits for one reader on one channel, under one subscription.

    Attributes:
        shared: whether packets under several bounds wait here (`SharedQueue`).
        earlier: how many packets were lost in the queues that this one took the place of.
        heavy: the bytes of each heavy packet that waits, by its `id`; None until the first has come.
        heavy_bytes: their sum.
        refused: packets from other agents that found no room under a `reliable` subscription.
    """

    __slots__ = (
        "_offered",
        "bounds",
        "channel",
        "earlier",
        "handled",
        "heavy",
        "heavy_bytes",
        "in_runs",
        "items",
        "keep",
        "listed",
        "mailbox",
        "numbers",
        "refused",
        "shared",
        "take",
    )

    def __init__(self, mailbox: Mailbox, channel: str, bounds: Mapping[str | None, Keep]) -> None:
        self.mailbox = mailbox
        self.channel = channel
        self.bounds = bounds
        self.keep = keep = next(iter(bounds.values()))
        self.items: deque[Packet] = deque(maxlen=None if keep.reliable else keep.limit)
        self.shared = False
        self.listed = False
        self.handled = 0
        self.in_runs = 0
        self.refused = 0
        self.earlier = 0
        self.heavy: dict[int, int] | None = None
        self.heavy_bytes = 0
        self._offered = Counter()
        # `put` takes one, and so does a publisher that has many to do it for (`Route.give`).
        self.numbers = self._offered.numbers
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
        next(self.numbers)
        self.items.append(packet)
        # Whoever finds it listed need not ask for a turn: who listed it does, and a reader unlists before it counts.
        if not self.listed:
            self.enlist()

    def put_all(self, packets: Sequence[Packet]) -> None:
        """Puts several packets, none of them heavy, in their order."""
        if len(packets) == 1:
            next(self.numbers)
        else:
            with _RUNS:
                self.in_runs += len(packets)
        self.items.extend(packets)
        if not self.listed:
            self.enlist()

    def put_heavy(self, packet: Packet, weight: int) -> None:
        """Puts a packet of so many bytes; the oldest fall out until there is room, except under `reliable`."""
        with _SCALES:
            if self.heavy is None or not self.items:
                self.heavy = {}
                self.heavy_bytes = 0
            if not self.keep.reliable:
                self._make_room(weight)
            # One that was pushed out unseen may have borne this `id`.
            self.heavy_bytes += weight - self.heavy.get(id(packet), 0)
            self.heavy[id(packet)] = weight
            next(self.numbers)
            self.items.append(packet)
        if not self.listed:
            self.enlist()

    def lighten(self, packet: Packet) -> None:
        """Forgets the weight of a packet that was taken out; called where `heavy` has something in it."""
        if self.heavy is not None and id(packet) in self.heavy:
            with _SCALES:
                self._unload(packet)

    def _make_room(self, weight: int) -> None:
        while self.items and (len(self.items) >= self.keep.limit or self.heavy_bytes + weight > MOST_BYTES):
            try:
                oldest = self.items.popleft()
            except IndexError:  # its reader was faster
                return
            if not self._unload(oldest) and self.heavy_bytes + weight > MOST_BYTES:
                # Light packets are put without a lock, and may have pushed heavy ones out whose weight is still here.
                waiting = {id(packet) for packet in list(self.items)}
                self.heavy = {key: its for key, its in (self.heavy or {}).items() if key in waiting}
                self.heavy_bytes = sum(self.heavy.values())

    def _unload(self, packet: Packet) -> bool:
        """Returns whether the packet was heavy."""
        weight = self.heavy.pop(id(packet), 0) if self.heavy is not None else 0
        self.heavy_bytes -= weight
        return weight > 0

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
            with _SCALES:
                self.heavy = self.heavy or {}
                self.heavy[id(packet)] = weight
                self.heavy_bytes += weight
        self.items.appendleft(packet)

    def __len__(self) -> int:
        return len(self.items)

    def offered(self) -> int:
        """Returns how many packets were ever put."""
        return self._offered.value + self.in_runs

    def dropped(self) -> int:
        """Returns how many packets were lost: those that fell out, and those that were refused from other agents.

        Where only the newest is wanted (`LATEST`), the others are not lost.
        """
        # Derived, so that no publisher counts under a lock.
        fallen = 0 if self.keep == LATEST else max(0, self.offered() - self.handled - len(self.items))
        return fallen + self.refused + self.earlier
