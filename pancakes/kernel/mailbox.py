"""A component's mailbox: bounded, with two lanes, without a lock.

Control (pykka's own messages, ticks, calls) goes before data. Data waits in one queue for each channel, so
that two types on one channel never overtake each other. The mailbox belongs to a task's slot, not to its
actor: a restart loses nothing that waits.

Any thread may put; one thread at a time (the holder of `token`) takes out.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec
from pykka import ActorDeadError
from pykka._envelope import Envelope
from pykka.messages import _ActorStop

from pancakes.kernel.counter import Counter
from pancakes.packet import Packet
from pancakes.weight import LIGHT_BYTES, weigher

if TYPE_CHECKING:
    from pancakes.kernel.component import Component


MOST_BYTES: Final = 16 * 1024 * 1024
"""So many bytes of bodies wait under a subscription, besides bodies lighter than `LIGHT_BYTES`; one may always wait."""

SPARE: Final = 64
SPARE_BYTES: Final = MOST_BYTES // 8
"""So many packets, or as many as half of all, and so many bytes of heavy ones stay in the row of a shared queue after
they have fallen out.
"""

# Held for a few operations, and only for a heavy packet, so one for all queues will do.
_SCALES: Final = threading.Lock()

# Held while the packets of a run are counted, which `Counter` would do one by one.
_RUNS: Final = threading.Lock()


class Keep(msgspec.Struct, frozen=True):
    """What a subscription does when its reader is slow, or the bodies that wait take more than `MOST_BYTES`.

    Attributes:
        limit: how many packets wait at the most.
        reliable: whether a packet that finds no room is refused to its publisher; else the oldest falls
            out and is counted.
    """

    limit: int
    reliable: bool = False


LATEST = Keep(1)
"""Only the newest packet waits."""


def queue(limit: int) -> Keep:
    """Up to `limit` packets wait; then the oldest falls out, and is counted."""
    return Keep(limit)


def reliable(limit: int) -> Keep:
    """Up to `limit` packets wait; then publishing raises `MailboxFull`, and nobody gets the packet."""
    return Keep(limit, reliable=True)


class Dispatch(Protocol):
    """What a mailbox needs of the dispatcher that its component runs on."""

    def ready(self, mailbox: Mailbox) -> None:
        """The mailbox has something in it and its token is held: see that its component gets a turn."""
        ...


def heavy_weight(packet: Packet) -> int:
    """Returns the bytes of a packet's body where it is a heavy one; of a light one 0."""
    weigh = weigher(type(packet.body))
    weight = weigh(packet.body) if weigh is not None else 0
    return weight if weight > LIGHT_BYTES else 0


class ChannelQueue:
    """What waits for one reader on one channel, under one subscription.

    Attributes:
        heavy: the bytes of each heavy packet that waits, by its `id`; None until the first has come.
        heavy_bytes: their sum.
        refused: packets from other agents that found no room under a `reliable` subscription.
    """

    __slots__ = (
        "_offered",
        "bounds",
        "channel",
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
        "take",
    )

    def __init__(self, mailbox: Mailbox, channel: str, bounds: Mapping[str | None, Keep]) -> None:
        self.mailbox = mailbox
        self.channel = channel
        self.bounds = bounds
        self.keep = keep = next(iter(bounds.values()))
        self.items: deque[Packet] = deque(maxlen=None if keep.reliable else keep.limit)
        self.listed = False
        self.handled = 0
        self.in_runs = 0
        self.refused = 0
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
        if mailbox.token.acquire(False):
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
        """Returns how many packets fell out (derived, so that no publisher counts under a lock), or were refused."""
        return max(0, self.offered() - self.handled - len(self.items)) + self.refused


class _Lane:
    """What waits in a shared queue under one subscription.

    Its packets are numbered in the order in which they came; the ones that wait are those from `first` on.

    Attributes:
        keep: its bound.
        most: how many packets may wait, as far as the queue has to see to that.
        first: the number of the oldest that waits.
        next: the number that the next one will have.
        fallen: how many have fallen out and are still in the queue's row, before the first.
        weights: of the heavy ones, by number.
        bytes: their sum.
    """

    __slots__ = ("bytes", "fallen", "first", "keep", "most", "next", "weights")

    def __init__(self, keep: Keep) -> None:
        self.keep = keep
        self.most = math.inf if keep.reliable else keep.limit  # a publisher asks before he puts under `reliable`
        self.first = 0
        self.next = 0
        self.fallen = 0
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
            return max(0, self.offered() - self.handled - len(self)) + self.refused


def _is_full(lane: _Lane, weight: int) -> bool:
    waiting = lane.next - lane.first
    return waiting >= lane.keep.limit or (waiting > 0 and weight > 0 and lane.bytes + weight > MOST_BYTES)


class Mailbox:
    """What waits for one component.

    Attributes:
        control: the lane that goes first: pykka's envelopes, ticks and calls, in order.
        waiting: the channel queues that have something in them, in the order in which it came.
        queues: all channel queues, by channel.
        token: held while the component has a turn or is about to get one.
        dispatch: the dispatcher that gives the turns.
        component: the component that reads it now; None between an actor and its successor.
        paused: whether the data lane rests: its packets wait.
        closed: whether its component has ended, and no successor is there yet; who asks then is told so at once.
    """

    __slots__ = ("_dropped", "closed", "component", "control", "dispatch", "paused", "queues", "token", "waiting")

    def __init__(self) -> None:
        self.control: deque[Any] = deque()
        # A list: it is never longer than the task has channels, and a deque takes 760 bytes.
        self.waiting: list[ChannelQueue] = []
        self.queues: dict[str, ChannelQueue] = {}
        self.token = threading.Lock()
        # Nobody reads it yet: the token is taken until a dispatcher attaches a component.
        self.token.acquire()
        self.dispatch: Dispatch
        self.component: Component | None = None
        self.closed = False
        self.paused = False
        self._dropped = 0

    def put(self, item: Any, /) -> None:
        """Puts into the control lane (pykka calls this for `tell`, `ask` and `stop`)."""
        self.control.append(item)
        if self.closed:
            self.clear_control()
        elif self.token.acquire(False):
            self.dispatch.ready(self)

    def clear_control(self) -> None:
        """Empties the control lane, as pykka's teardown does: who waits for an answer is told that none will come."""
        while self.control:
            try:
                item = self.control.popleft()
            except IndexError:  # another thread clears it as well
                return
            if not isinstance(item, Envelope) or item.reply_to is None:
                continue
            if isinstance(item.message, _ActorStop):
                item.reply_to.set(None)
            else:
                error = ActorDeadError(f"stopped before it handled {item.message!r}")
                item.reply_to.set_exception((ActorDeadError, error, None))

    def get(self) -> Any:
        """Takes from the control lane without waiting (pykka's teardown)."""
        return self.control.popleft()

    def empty(self) -> bool:
        """Returns whether the control lane is empty (pykka's teardown)."""
        return not self.control

    def has_work(self) -> bool:
        """Returns whether anything waits that may be handled now."""
        return bool(self.control or (self.waiting and not self.paused))

    def subscribe(self, channel: str, bounds: Mapping[str | None, Keep]) -> ChannelQueue:
        """Returns the queue for a channel, bounded as `bounds` says for each type; None means any other type.

        What waits in an earlier queue for this channel is kept, and so are the bounds of types that `bounds` does not
        name: a task that is started anew subscribes to one type after the other.
        """
        before = self.queues.get(channel)
        if before is not None:
            bounds = {**before.bounds, **bounds}
            if before.bounds == bounds:
                return before
        made = ChannelQueue(self, channel, bounds) if len(bounds) == 1 else SharedQueue(self, channel, bounds)
        self.queues[channel] = made
        if before is not None:
            while (packet := before.pop()) is not None:
                weight = heavy_weight(packet)
                if weight:
                    made.put_heavy(packet, weight)
                else:
                    made.put(packet)
            self._dropped += before.dropped()
        return made

    def clear_data(self) -> None:
        """Forgets what waits in the data lane."""
        self.waiting.clear()
        for queue in self.queues.values():
            queue.listed = False
            while queue.pop() is not None:
                pass

    def list_all(self) -> None:
        """Lists every queue in which something waits: a new component begins with what its predecessor left."""
        self.waiting.clear()
        for waiting in self.queues.values():
            waiting.listed = False  # before the look, so that what is put meanwhile is either seen or listed
            if len(waiting):
                waiting.listed = True
                self.waiting.append(waiting)

    def dropped(self) -> int:
        """Returns how many packets fell out of all queues."""
        return self._dropped + sum(queue.dropped() for queue in list(self.queues.values()))
