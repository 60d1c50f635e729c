"""Bounded queues: a component's mailbox with its two lanes, and the backlog of any other slow reader.

The control lane (pykka's own messages, ticks, calls) goes before the data lane. All data waits in one order, so no
packet overtakes another; each type on each channel has a bound of its own. The mailbox belongs to a task's slot, not
to its actor: a restart loses nothing that waits. Any thread may put; one thread at a time (the holder of the token)
takes out.

Light packets need no lock: a deque changes in one step. Bytes of heavy packets change under one.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, Protocol, TypeVar

import pykka

from pancakes.kernel.handlers import Handler, QueuePolicy
from pancakes.kernel.payload_size import weight_of
from pancakes.kernel.pykka_actor import Flag, dismiss
from pancakes.packet import Packet

if TYPE_CHECKING:
    from pancakes.kernel.awaiting import ActorLoop


ASK_TYPE: Final = "request.ask"
REQUEST_TYPES: Final = frozenset((ASK_TYPE, "request.answer", "request.feedback", "request.cancel"))
"""The types of `pancakes.kernel.request_packets`, which is imported once a task asks or is asked."""


class Heavy(NamedTuple):
    """A packet that waits and is no light one, with the bytes of its body."""

    packet: Packet
    weight: int


class TypeQueue:
    """What waits for one reader on one channel under one bound: packets of one type, or of all types without a bound.

    Any thread puts, and only the reader's takes. A light packet that finds room needs no lock: a deque changes in one
    step. A packet enters its queue before the mailbox's order, and leaves the order before its queue: if a thread has
    taken a place in the order, a packet is in the queue. Publishers that put at the same moment may pass the limit by
    one packet each.

    Args:
        channel: the queue of its channel.
        policy: the bound.

    Attributes:
        channel: the same.
        policy: the same.
        entries: what waits: a light packet as it is, a heavy one with its weight.
        handlers: what the reader does with each packet.
        bytes: the bytes of the heavy packets that wait.
        lost: how many packets have fallen out that the reader wanted.
        handled: how many packets were taken out.
    """

    __slots__ = ("_limit", "_mailbox", "bytes", "channel", "entries", "handled", "handlers", "lost", "policy")

    def __init__(self, channel: ChannelQueue, policy: QueuePolicy) -> None:
        self.channel = channel
        self.handlers: tuple[Handler, ...] = ()
        self.bytes = 0
        self.lost = 0
        self.handled = 0
        self._mailbox = channel.mailbox
        self.entries: deque[Packet | Heavy] = deque()
        self.bound(policy)

    def bound(self, policy: QueuePolicy) -> None:
        """Take another bound."""
        self.policy = policy
        self._limit = policy.limit

    def refuses(self, weight: int) -> bool:
        """Return whether a packet must be refused to its publisher; `weight`: its bytes, if it is a heavy one."""
        return self.policy.reliable and self.policy.is_full(len(self.entries), self.bytes, weight)

    def put(self, packet: Packet, weight: int = 0) -> None:
        """Put a packet; `weight`: its bytes, if it is a heavy one."""
        entries, mailbox = self.entries, self._mailbox
        if weight or len(entries) >= self._limit:
            self._make_room(weight)
        entries.append(Heavy(packet, weight) if weight else packet)
        mailbox.order.append(self)
        # As `Mailbox.wake`: who puts something looks at the token first, which costs less than an attempt that fails,
        # and most would fail, as packets come while a turn is due already.
        token = mailbox.token
        if not token.locked() and not mailbox.paused and token.acquire(False):
            mailbox.dispatch.ready(mailbox)

    def _make_room(self, weight: int) -> None:
        """Let the oldest packets fall out until there is room for one more, and count its weight."""
        with self._mailbox.scales:
            while not self.policy.reliable and self.policy.is_full(len(self.entries), self.bytes, weight):
                try:
                    self._mailbox.order.remove(self)  # the place of its oldest
                except ValueError:  # the reader was faster
                    break
                self._leave(self.entries.popleft())
                self.lost += self.policy.counts_losses
            self.bytes += weight

    def _leave(self, entry: Packet | Heavy) -> Packet:
        """Return the packet of an entry that waits no more. Under the scales' lock if it is a heavy one."""
        if isinstance(entry, Heavy):
            self.bytes -= entry.weight
            return entry.packet
        return entry

    def take(self) -> Packet:
        """Take the oldest packet out, whose place in the mailbox's order has been taken before."""
        entry = self.entries.popleft()
        self.handled += 1
        return entry if entry.__class__ is Packet else self.unweighed(entry)

    def unweighed(self, entry: Packet | Heavy) -> Packet:
        """Return the packet of an entry that was taken out, whose bytes, if it is a heavy one, count no more."""
        with self._mailbox.scales:
            return self._leave(entry)

    def put_back(self, packet: Packet) -> None:
        """Put a packet that the reader took back in front, to be handled again."""
        weight = weight_of(packet.body)
        with self._mailbox.scales:
            self.bytes += weight
        self.entries.appendleft(Heavy(packet, weight) if weight else packet)
        self._mailbox.order.appendleft(self)
        self.handled -= 1

    def __len__(self) -> int:
        return len(self.entries)


class UrgentQueue(TypeQueue):
    """What waits under an urgent bound: its reader is told in the control lane, which goes first and never rests.

    So a task that awaits an answer gets it, and one that works on a request hears that it was cancelled. What has come
    waits here, and not in the control lane: it outlives an actor, and has a bound.
    """

    __slots__ = ()

    def put(self, packet: Packet, weight: int = 0) -> None:
        mailbox = self._mailbox
        with mailbox.scales:
            if self.policy.is_full(len(self.entries), self.bytes, weight):
                self.lost += 1
                return
            self.bytes += weight
            self.entries.append(Heavy(packet, weight) if weight else packet)
        component = mailbox.component
        if component is not None:
            mailbox.put(Told(component, Urgent()))

    def clear(self) -> None:
        """Forget what waits. By the reader."""
        while self.entries:
            self.take()


class Urgent:
    """Tells an actor that something waits in one of its urgent queues."""

    __slots__ = ()


class ChannelQueue:
    """What waits for one reader on one channel, with a bound for each type that it reads.

    Args:
        mailbox: where it waits.

    Attributes:
        mailbox: the same.
        refused: packets from other agents that found no room under a `reliable` subscription.
    """

    __slots__ = ("_by_type", "mailbox", "refused")

    def __init__(self, mailbox: Mailbox) -> None:
        self.mailbox = mailbox
        self.refused = 0
        self._by_type: dict[str | None, TypeQueue] = {}  # never changed but replaced: other threads read it

    def bound(self, type_name: str | None, policy: QueuePolicy) -> None:
        """Bound packets of a type; None means all types without a bound of their own. Other bounds stay."""
        known = self._by_type.get(type_name)
        if known is not None:
            known.bound(policy)
        else:
            kind = UrgentQueue if policy.urgent else TypeQueue
            self._by_type = {**self._by_type, type_name: kind(self, policy)}

    def of(self, type_name: str | None) -> TypeQueue:
        """Return where packets of a type wait that the reader reads; None: those without a bound of their own."""
        found = self._by_type.get(type_name)
        return found if found is not None else self._by_type[None]

    def handle(self, handlers: Mapping[str | None, tuple[Handler, ...]]) -> None:
        """Set what the reader does with packets of each type. In its turn."""
        for type_name, waiting in self._by_type.items():
            waiting.handlers = handlers[type_name]

    def clear_urgent(self) -> None:
        """Forget what waits besides the mailbox's order. By the reader."""
        for waiting in self._by_type.values():
            if isinstance(waiting, UrgentQueue):
                waiting.clear()

    def drain(self) -> Iterator[Packet]:
        """Take out one by one the packets of this channel that wait now. By the reader."""
        order = self.mailbox.order
        for waiting in tuple(order):
            if waiting.channel is self:
                try:
                    order.remove(waiting)
                except ValueError:  # it fell out meanwhile
                    continue
                yield waiting.take()

    @property
    def handled(self) -> int:
        """How many packets were taken out."""
        return sum(waiting.handled for waiting in self._by_type.values())

    def __len__(self) -> int:
        return sum(map(len, self._by_type.values()))

    @property
    def heavy_bytes(self) -> int:
        """The bytes of the heavy packets that wait."""
        return sum(waiting.bytes for waiting in self._by_type.values())

    def dropped(self) -> int:
        """Return how many packets were lost: those that fell out, and those that were refused from other agents.

        If only the newest is wanted (`LATEST`), the others are not lost.
        """
        return sum(waiting.lost for waiting in self._by_type.values()) + self.refused


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
    def loop(self) -> ActorLoop | None:
        """Its event loop; None: it has awaited nothing yet."""

    def may_await(self) -> bool:
        """Return whether its loop may run: it awaits something, and is not frozen. In its thread, between turns."""

    @property
    def actor_inbox(self) -> Mailbox:
        """Its mailbox."""

    @property
    def actor_stopped(self) -> Flag:
        """Whether it has ended."""

    def acts(self) -> bool:
        """Return whether its next tick or packet may be handled. In its turn."""

    def take_turn(self, slice_s: float | None) -> None:
        """Handle what waits; see `ActorCore.take_turn`."""


class Dispatch(Protocol):
    """What a mailbox needs of the dispatcher that its component runs on."""

    def ready(self, mailbox: Mailbox) -> None:
        """The mailbox has something in it and its token is held: see that its component gets a turn."""


class Mailbox:
    """What waits for one component.

    Attributes:
        control: the lane that goes first: pykka's envelopes, ticks and calls, in order.
        order: for each packet that waits the queue that it is in, in the order in which they came.
        queues: all channel queues, by channel.
        token: the right to give its component turns.
        dispatch: the dispatcher that gives the turns.
        component: the component that reads it now; None between an actor and its successor.
        paused: whether the data lane rests: its packets wait. Changed in a turn only, whose end looks for them.
        scales: guards what is counted of heavy packets, and of those that fall out.
        closed: whether its component has ended, and no successor is there yet; a thread that asks then is told so.
    """

    __slots__ = ("closed", "component", "control", "dispatch", "order", "paused", "queues", "scales", "token")

    def __init__(self) -> None:
        self.control: deque[Any] = deque()
        self.order: deque[TypeQueue] = deque()
        self.queues: dict[str, ChannelQueue] = {}
        # Held from the beginning: a dispatcher gives the first turn.
        self.token = threading.Lock()
        self.token.acquire()
        self.scales = threading.Lock()
        self.dispatch: Dispatch
        self.component: Runnable | None = None
        self.closed = False
        self.paused = False

    def put(self, item: Any, /) -> None:
        """Put into the control lane (pykka calls this for `tell`, `ask` and `stop`)."""
        self.control.append(item)
        if self.closed:
            self.clear_control()
        elif not self.token.locked() and self.token.acquire(False):
            self.dispatch.ready(self)

    def wake(self) -> None:
        """See that the component gets a turn, unless it has one or is about to."""
        if self.token.acquire(False):
            self.dispatch.ready(self)

    def end_turn(self) -> None:
        """Give the token back, and ask for another turn if something waits."""
        self.token.release()
        if self.control or (self.order and not self.paused):
            self.wake()

    def clear_control(self) -> None:
        """Empty the control lane: a thread that waits for an answer is told that none will come."""
        while self.control:
            try:
                item = self.control.popleft()
            except IndexError:  # another thread clears it as well
                return
            dismiss(item)

    def subscribe(self, channel: str) -> ChannelQueue:
        """Return the queue for a channel, with what waits there."""
        queue = self.queues.get(channel)
        if queue is None:
            queue = self.queues[channel] = ChannelQueue(self)
        return queue

    def take(self) -> Packet | None:
        """Take the oldest packet out; None if nothing waits. By the reader."""
        try:
            return self.order.popleft().take()
        except IndexError:
            return None

    def clear_data(self) -> None:
        """Forget what waits in the data lane and in urgent queues."""
        while self.take() is not None:
            pass
        for queue in list(self.queues.values()):
            queue.clear_urgent()

    def dropped(self) -> int:
        """Return how many packets were lost in all queues; see `ChannelQueue.dropped`."""
        return sum(queue.dropped() for queue in list(self.queues.values()))


class Reference(Runnable, Protocol):
    """All that one actor uses of another, as pykka's `ActorRef`: where it is, its mailbox, and whether it has ended.

    The actor itself stands behind it. What else it has is for that actor only: `tell` brings it a message, and what
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
        """End the actor after what it is doing now."""

    def revoke(self) -> None:
        """Take the right to publish away from an actor that cannot be ended."""


class Call:
    """A function to be called in a component's turn, and in no turn of its successor's.

    Args:
        component: the component.
        function: the function.
        is_own: whether it is a step of what the component awaits, which must not wait for that.
    """

    __slots__ = ("component", "function", "is_own")

    def __init__(self, component: Runnable, function: Callable[[], Any], is_own: bool = False) -> None:
        self.component = component
        self.function = function
        self.is_own = is_own


class Told:
    """A message that waits in a control lane for a turn of its actor, and of none of that actor's successors."""

    __slots__ = ("component", "message")

    def __init__(self, component: Runnable, message: object) -> None:
        self.component = component
        self.message = message


def tell(component: Reference, message: object) -> bool:
    """Give an actor a message, which its `take_message` takes after what it is doing now. Any thread.

    Its successor at the same address does not get it.

    Returns:
        False if the actor has ended, and the message is forgotten.
    """
    alive = not component.actor_stopped.is_set()
    if alive:
        component.actor_inbox.put(Told(component, message))
    return alive


LONGEST_S: Final = 3600.0
"""A thread waits no longer at a time: the system cannot wait further than some centuries ahead."""


class Inbox:
    """Messages for one thread, which waits for the next, or until it has something else to do.

    Not a `queue.SimpleQueue`, whose timed `get` may wait for ever (Python 3.11 and 3.12): if a message was taken
    just before, and the time is up before it has come to wait, it waits without any limit. Counted on a busy machine,
    with waits of 1 ns to 20 µs: once in some thousand. The timer then gave no ticks until a message came.
    """

    def __init__(self) -> None:
        self._messages: deque[Any] = deque()
        # Held while no message has been put.
        self._bell = threading.Lock()
        self._bell.acquire()

    def put(self, message: Any, /) -> None:
        """Add a message. Any thread."""
        self._messages.append(message)
        with contextlib.suppress(RuntimeError):  # it rings already
            self._bell.release()

    def wait(self, timeout_s: float) -> None:
        """Wait for a message if there is none, but not longer than that; it may come back earlier."""
        # First the look, then the bell: a thread that puts a message rings after that.
        if not self._messages and timeout_s > 0:
            self._bell.acquire(timeout=min(timeout_s, LONGEST_S))

    def get(self) -> Any:
        """Take the oldest message out, and wait for it."""
        while not self._messages:
            self.wait(LONGEST_S)
        self._bell.acquire(blocking=False)  # or it would ring for what is taken now
        return self._messages.popleft()

    def empty(self) -> bool:
        """Return whether there is no message."""
        return not self._messages

    def __len__(self) -> int:
        return len(self._messages)


MOST_BYTES: Final = 64 * 1024 * 1024
"""The most bytes of bodies that wait, besides bodies lighter than `LIGHT_BYTES`; one may always wait."""

Item = TypeVar("Item")


class Backlog(Generic[Item]):
    """Keeps the newest packets, each with what belongs to it; of more than there is room for the oldest fall out.

    Any thread may put and take.

    Args:
        limit: the most packets that wait.
        most_bytes: the most bytes of heavy packets that wait.

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
        """Put what belongs to a packet, which is as heavy as the packet's body."""
        weight = weight_of(packet.body)
        with self._lock:
            self._items.append(item)
            self._weights.append(weight)
            self.heavy_bytes += weight
            while len(self._items) > self._limit or (self.heavy_bytes > self._most_bytes and len(self._items) > 1):
                self._pop()
                self.dropped += 1

    def take(self) -> Item | None:
        """Take the oldest out; None if nothing waits."""
        with self._lock:
            return self._pop() if self._items else None

    def clear(self) -> None:
        """Forget what waits, without counting it as fallen out."""
        while self.take() is not None:
            pass

    def __len__(self) -> int:
        return len(self._items)

    def _pop(self) -> Item:
        self.heavy_bytes -= self._weights.popleft()
        return self._items.popleft()
