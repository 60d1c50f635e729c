"""A component's mailbox: bounded, with two lanes, without a lock.

Control (pykka's own messages, ticks, calls) goes before data. Data waits in one queue for each channel, so
that two types on one channel never overtake each other. The mailbox belongs to a task's slot, not to its
actor: a restart loses nothing that waits.

Any thread may put; one thread at a time (the holder of `token`) takes out.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from typing import TYPE_CHECKING, Any, Protocol

import msgspec
from pykka import ActorDeadError
from pykka._envelope import Envelope
from pykka.messages import _ActorStop

from pancakes.kernel.counter import Counter
from pancakes.packet import Packet

if TYPE_CHECKING:
    from pancakes.kernel.component import Component


class Keep(msgspec.Struct, frozen=True):
    """What a subscription does when its reader is slow.

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


class ChannelQueue:
    """What waits for one reader on one channel, under one subscription."""

    __slots__ = ("_offered", "bounds", "channel", "handled", "items", "keep", "listed", "mailbox")

    def __init__(self, mailbox: Mailbox, channel: str, bounds: dict[str | None, Keep]) -> None:
        self.mailbox = mailbox
        self.channel = channel
        self.bounds = bounds
        self.keep = keep = next(iter(bounds.values()))
        self.items: deque[Packet] = deque(maxlen=None if keep.reliable else keep.limit)
        self.listed = False
        self.handled = 0
        self._offered = Counter()

    @property
    def has_reliable(self) -> bool:
        """Whether it may refuse a packet."""
        return self.keep.reliable

    def reliable_for(self, packet: Packet) -> bool:
        """Returns whether `packet` came under a subscription that may lose none."""
        return self.keep.reliable

    def full(self, packet: Packet) -> bool:
        """Returns whether `packet` would be refused."""
        return self.keep.reliable and len(self.items) >= self.keep.limit

    def put(self, packet: Packet) -> None:
        self._offered.take()
        self.items.append(packet)
        mailbox = self.mailbox
        # Two publishers may both list the queue: an empty queue in the list harms nobody, a forgotten one would.
        # Whoever finds it listed need not ask for a turn: who listed it does, and a reader unlists before it counts.
        if not self.listed:
            self.listed = True
            mailbox.waiting.append(self)
            if mailbox.token.acquire(False):
                mailbox.dispatch.ready(mailbox)

    def pop(self) -> Packet | None:
        """Takes the oldest packet out; None where nothing waits."""
        try:
            packet = self.items.popleft()
        except IndexError:
            return None
        self.handled += 1
        return packet

    def push_back(self, packet: Packet) -> None:
        """Puts a packet back in front, to be handled again."""
        self.handled -= 1
        self.items.appendleft(packet)

    def __len__(self) -> int:
        return len(self.items)

    def offered(self) -> int:
        """Returns how many packets were ever put."""
        return self._offered.value

    def dropped(self) -> int:
        """Returns how many packets fell out, derived so that no publisher has to count under a lock."""
        return max(0, self.offered() - self.handled - len(self.items))


class SharedQueue(ChannelQueue):
    """What waits for one reader on one channel under several subscriptions, each with its own bound.

    One order for all types, therefore a lock: held for a few operations on a dict, never over a call out.
    """

    __slots__ = ("_entries", "_keys", "_lock")

    def __init__(self, mailbox: Mailbox, channel: str, bounds: dict[str | None, Keep]) -> None:
        super().__init__(mailbox, channel, bounds)
        self._entries: OrderedDict[int, Packet] = OrderedDict()
        self._keys: dict[str | None, deque[int]] = {name: deque() for name in bounds}
        self._lock = threading.Lock()

    def _bound(self, packet: Packet) -> str | None:
        return packet.type if packet.type in self.bounds else None

    @property
    def has_reliable(self) -> bool:
        return any(keep.reliable for keep in self.bounds.values())

    def reliable_for(self, packet: Packet) -> bool:
        return self.bounds[self._bound(packet)].reliable

    def full(self, packet: Packet) -> bool:
        bound = self._bound(packet)
        keep = self.bounds[bound]
        return keep.reliable and len(self._keys[bound]) >= keep.limit

    def put(self, packet: Packet) -> None:
        bound = self._bound(packet)
        with self._lock:
            number = self._offered.take()
            keys = self._keys[bound]
            if len(keys) >= self.bounds[bound].limit and not self.bounds[bound].reliable:
                del self._entries[keys.popleft()]
            keys.append(number)
            self._entries[number] = packet
        mailbox = self.mailbox
        if not self.listed:
            self.listed = True
            mailbox.waiting.append(self)
            if mailbox.token.acquire(False):
                mailbox.dispatch.ready(mailbox)

    def pop(self) -> Packet | None:
        with self._lock:
            if not self._entries:
                return None
            _, packet = self._entries.popitem(last=False)
            self._keys[self._bound(packet)].popleft()
            self.handled += 1
            return packet

    def push_back(self, packet: Packet) -> None:
        with self._lock:
            self.handled -= 1
            number = min(self._entries, default=0) - 1
            self._entries[number] = packet
            self._entries.move_to_end(number, last=False)
            self._keys[self._bound(packet)].appendleft(number)

    def __len__(self) -> int:
        return len(self._entries)

    def dropped(self) -> int:
        with self._lock:
            return max(0, self.offered() - self.handled - len(self._entries))


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
        self.waiting: deque[ChannelQueue] = deque()
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

    def subscribe(self, channel: str, bounds: dict[str | None, Keep]) -> ChannelQueue:
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
