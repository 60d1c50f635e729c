"""A component's mailbox: bounded, with two lanes.

Control (pykka's own messages, ticks, calls) goes before data. Data waits in one queue for each channel, so
that two types on one channel never overtake each other. The mailbox belongs to a task's slot, not to its
actor: a restart loses nothing that waits.

Any thread may put; one thread at a time (the holder of the token) takes out.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import Any, Protocol

from pancakes.runtime.kernel.channel_queue import ChannelQueue
from pancakes.runtime.kernel.flag import Flag
from pancakes.runtime.kernel.pykka_actor import dismiss


class Runnable(Protocol):
    """What gets turns: what the kernel knows of a component."""

    @property
    def address(self) -> str:
        """Where it is."""

    @property
    def author_class(self) -> type:
        """See `Component.author_class`."""

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
        """Handles what waits; see `Component.take_turn`."""


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
