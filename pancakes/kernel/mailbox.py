"""Bounded queues: a component's mailbox with its two lanes, and the backlog of any other slow reader.

The control lane (pykka's own messages, ticks, calls) goes before the data lane. Data waits in one queue for each
channel, so two types on one channel never overtake each other. The mailbox belongs to a task's slot, not to its
actor: a restart loses nothing that waits. Any thread may put; one thread at a time (the holder of the token) takes
out.

Light packets need no lock: a deque, a dict and a `count` change in one step. Bytes of heavy packets change under one.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Mapping
from itertools import count
from typing import Any, Final, Generic, Protocol, TypeVar

import pykka

from pancakes.kernel.handlers import Keep
from pancakes.kernel.payload_size import weight_of
from pancakes.kernel.pykka_actor import Flag, dismiss
from pancakes.packet import Packet


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


class Runnable(Protocol):
    """What gets turns: what the kernel knows of a component's core."""

    @property
    def facade(self) -> Any:
        """The object whose methods it calls; see `ActorCore`."""

    @property
    def address(self) -> str:
        """Where it is."""

    @property
    def author_class(self) -> type:
        """See `ActorCore.author_class`."""

    @property
    def blocking(self) -> bool:
        """Whether it needs a thread of its own."""

    @property
    def actor_inbox(self) -> Mailbox:
        """Its mailbox."""

    @property
    def actor_stopped(self) -> Flag:
        """Whether it has ended."""

    def acts(self) -> bool:
        """Returns whether its next tick or packet may be handled. In its turn."""

    def take_turn(self, slice_s: float | None) -> None:
        """Handles what waits; see `ActorCore.take_turn`."""


class Dispatch(Protocol):
    """What a mailbox needs of the dispatcher that its component runs on."""

    def ready(self, mailbox: Mailbox) -> None:
        """The mailbox has something in it and its token is held: see that its component gets a turn."""


class Mailbox:
    """What waits for one component.

    Attributes:
        control: the lane that goes first: pykka's envelopes, ticks and calls, in order.
        waiting: the channel queues that may have something in them, in the order in which it came.
        queues: all channel queues, by channel.
        token: the right to give its component turns.
        dispatch: the dispatcher that gives the turns.
        component: the component that reads it now; None between an actor and its successor.
        paused: whether the data lane rests: its packets wait.
        closed: whether its component has ended, and no successor is there yet; a thread that asks then is told so.
    """

    __slots__ = ("closed", "component", "control", "dispatch", "paused", "queues", "token", "waiting")

    def __init__(self) -> None:
        self.control: deque[Any] = deque()
        # A dict, as publishers enter a queue in one step, and once.
        self.waiting: dict[ChannelQueue, None] = {}
        self.queues: dict[str, ChannelQueue] = {}
        # Held from the beginning: a dispatcher gives the first turn.
        self.token = threading.Lock()
        self.token.acquire()
        self.dispatch: Dispatch
        self.component: Runnable | None = None
        self.closed = False
        self.paused = False

    def put(self, item: Any, /) -> None:
        """Puts into the control lane (pykka calls this for `tell`, `ask` and `stop`)."""
        self.control.append(item)
        if self.closed:
            self.clear_control()
        else:
            self.wake()

    def wake(self) -> None:
        """Sees that the component gets a turn, unless it has one or is about to."""
        token = self.token
        # A look costs less than an attempt that fails, and most fail: packets come while a turn is due already.
        if not token.locked() and token.acquire(False):
            self.dispatch.ready(self)

    def end_turn(self) -> None:
        """Gives the token back, and asks for another turn where something waits."""
        self.token.release()
        if self.control or (self.waiting and not self.paused):
            self.wake()

    def clear_control(self) -> None:
        """Empties the control lane: a thread that waits for an answer is told that none will come."""
        while self.control:
            try:
                item = self.control.popleft()
            except IndexError:  # another thread clears it as well
                return
            dismiss(item)

    def subscribe(self, channel: str) -> ChannelQueue:
        """Returns the queue for a channel, with what waits there."""
        queue = self.queues.get(channel)
        if queue is None:
            queue = self.queues[channel] = ChannelQueue(self.waiting, self.wake)
        return queue

    def clear_data(self) -> None:
        """Forgets what waits in the data lane."""
        self.waiting.clear()
        for queue in self.queues.values():
            while queue.take() is not None:
                pass

    def strike_out(self, queue: ChannelQueue) -> None:
        """Strikes a queue out of `waiting`; enters it again, behind the others, where something waits in it."""
        self.waiting.pop(queue, None)
        # Only now: a publisher that found it there does not enter it.
        if queue:
            self.waiting[queue] = None

    def enter_all(self) -> None:
        """Enters every queue in which something waits: a new component begins with what its predecessor left."""
        for queue in self.queues.values():
            self.strike_out(queue)

    def dropped(self) -> int:
        """Returns how many packets were lost in all queues; see `ChannelQueue.dropped`."""
        return sum(queue.dropped() for queue in list(self.queues.values()))


class Reference(Runnable, Protocol):
    """All that one actor uses of another, as pykka's `ActorRef`: where it is, its mailbox, and whether it has ended.

    The actor itself stands behind it. What else it has is for that actor alone: `tell` brings it a message, and what
    others want to read of it stands in a table that is shared. Any thread.
    """

    @property
    def agent(self) -> str:
        """The name of its agent."""

    @property
    def name(self) -> str:
        """The last part of its address."""

    @property
    def actor_ref(self) -> pykka.ActorRef[Any]:
        """Pykka's own reference to it."""

    def stop(self) -> None:
        """Ends the actor after what it is doing now."""

    def revoke(self) -> None:
        """Takes the right to publish away from an actor that cannot be ended."""


class Call:
    """A function to be called in a component's turn, and in no turn of its successor's."""

    __slots__ = ("component", "function")

    def __init__(self, component: Runnable, function: Callable[[], None]) -> None:
        self.component = component
        self.function = function


class Told:
    """A message that waits in a control lane for a turn of its actor, and of none of that actor's successors."""

    __slots__ = ("component", "message")

    def __init__(self, component: Runnable, message: object) -> None:
        self.component = component
        self.message = message


def tell(component: Reference, message: object) -> bool:
    """Gives an actor a message, which its `take_message` takes after what it is doing now. Any thread.

    Its successor at the same address does not get it.

    Returns:
        False where the actor has ended, and the message is forgotten.
    """
    alive = not component.actor_stopped.is_set()
    if alive:
        component.actor_inbox.put(Told(component, message))
    return alive


LONGEST_S: Final = 3600.0
"""A thread waits no longer at a time: the system cannot wait further than some centuries ahead."""


class Inbox:
    """Messages for one thread, which waits for the next, or until it has something else to do.

    Not a `queue.SimpleQueue`, whose timed `get` may wait for ever (Python 3.11 and 3.12): where a message was taken
    just before, and the time is up before it has come to wait, it waits without any limit. Counted on a busy machine,
    with waits of 1 ns to 20 µs: once in some thousand. The timer then gave no ticks until a message came.
    """

    def __init__(self) -> None:
        self._messages: deque[Any] = deque()
        # Held while no message has been put.
        self._bell = threading.Lock()
        self._bell.acquire()

    def put(self, message: Any, /) -> None:
        """Adds a message. Any thread."""
        self._messages.append(message)
        with contextlib.suppress(RuntimeError):  # it rings already
            self._bell.release()

    def wait(self, timeout_s: float) -> None:
        """Waits for a message where there is none, but not longer than that; it may come back earlier."""
        # First the look, then the bell: a thread that puts a message rings after that.
        if not self._messages and timeout_s > 0:
            self._bell.acquire(timeout=min(timeout_s, LONGEST_S))

    def get(self) -> Any:
        """Takes the oldest message out, and waits for it."""
        while not self._messages:
            self.wait(LONGEST_S)
        self._bell.acquire(blocking=False)  # or it would ring for what is taken now
        return self._messages.popleft()

    def empty(self) -> bool:
        """Returns whether there is no message."""
        return not self._messages

    def __len__(self) -> int:
        return len(self._messages)


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
