"""A component's mailbox: bounded, with two lanes, without a lock.

Control (pykka's own messages, ticks, calls) goes before data. Data waits in one queue for each channel, so
that two types on one channel never overtake each other. The mailbox belongs to a task's slot, not to its
actor: a restart loses nothing that waits.

Any thread may put; one thread at a time (the holder of the token) takes out.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

from pykka import ActorDeadError
from pykka._envelope import Envelope
from pykka.messages import _ActorStop

from pancakes.kernel.channel_queue import ChannelQueue
from pancakes.kernel.keep import Keep
from pancakes.kernel.shared_queue import SharedQueue
from pancakes.weight import heavy_weight

if TYPE_CHECKING:
    from pancakes.kernel.component import Component


class Dispatch(Protocol):
    """What a mailbox needs of the dispatcher that its component runs on."""

    def ready(self, mailbox: Mailbox) -> None:
        """The mailbox has something in it and its token is held: see that its component gets a turn."""
        ...


class Mailbox:
    """What waits for one component.

    Attributes:
        control: the lane that goes first: pykka's envelopes, ticks and calls, in order.
        waiting: the channel queues that have something in them, in the order in which it came.
        queues: all channel queues, by channel.
        token: the right to give its component turns. It is there while nobody has it, that is, while no turn goes on
            or is about to; `del` takes it away, which only one thread can.
        held: whether somebody has the token. To take it where it is not there fails at ten times the cost, so ask
            this first; only the token itself is right at any moment.
        dispatch: the dispatcher that gives the turns.
        component: the component that reads it now; None between an actor and its successor.
        paused: whether the data lane rests: its packets wait.
        closed: whether its component has ended, and no successor is there yet; who asks then is told so at once.
    """

    __slots__ = (
        "closed",
        "component",
        "control",
        "dispatch",
        "held",
        "paused",
        "queues",
        "token",
        "waiting",
    )

    def __init__(self) -> None:
        self.control: deque[Any] = deque()
        # A list: it is never longer than the task has channels, and a deque takes 760 bytes.
        self.waiting: list[ChannelQueue] = []
        self.queues: dict[str, ChannelQueue] = {}
        # Nobody reads it yet: there is no token until a dispatcher has given a component its first turn. An attribute
        # and no lock, which lies in two more places of the memory: 8 % of a delivery to 100 tasks that were at rest.
        self.token: bool
        self.held = True
        self.dispatch: Dispatch
        self.component: Component | None = None
        self.closed = False
        self.paused = False

    def put(self, item: Any, /) -> None:
        """Puts into the control lane (pykka calls this for `tell`, `ask` and `stop`)."""
        self.control.append(item)
        if self.closed:
            self.clear_control()
        elif self.take_token():
            self.dispatch.ready(self)

    def take_token(self) -> bool:
        """Takes the token, if it is there. Returns whether it was. Any thread."""
        if self.held:
            return False
        try:
            del self.token
        except AttributeError:  # somebody was faster
            return False
        self.held = True
        return True

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
            made.earlier = before.dropped()
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
        """Returns how many packets were lost in all queues; see `ChannelQueue.dropped`."""
        return sum(queue.dropped() for queue in list(self.queues.values()))
