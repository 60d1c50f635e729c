"""Actors: the base of tasks and services, a pykka actor that talks by packets (paper §3, Figure 2).

`Component` is what users derive from: it has the documented methods, and one private object, `_actor`. That is an
`ActorCore`, which handles one mailbox, in turns that its dispatcher gives, one at a time; it never blocks. An actor of
Pancakes' own derives from `ActorCore` instead, and is its own core.

Other actors know a core as a `Reference`. They give it data with `tell`, never a function; `Call` and `Told` wait in
the control lane and are dropped with their actor, so a successor at the same address never gets them.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from inspect import iscoroutine
from time import thread_time
from typing import TYPE_CHECKING, Any, Final

import pykka

from pancakes.errors import ControlRefusedError, NoPermitError, PancakesError, describe, traceback_of
from pancakes.events import Event, Log, LogLine, check_levels
from pancakes.kernel.dispatchers import is_for_program
from pancakes.kernel.handlers import (
    DEFAULT_QUEUE,
    NO_HANDLERS,
    Handlers,
    Plan,
    Queue,
    Subscription,
    adapted_tick,
    period_of,
    plan_of,
    queue_policy,
)
from pancakes.kernel.mailbox import Call, Mailbox, Told
from pancakes.kernel.pykka_actor import Flag, PykkaActor, handle_envelope
from pancakes.kernel.timer import TaskTimer
from pancakes.packet import CTRL, LOG, THREAD, Cause, Fence, LocalTime, Packet, type_name
from pancakes.util.class_checks import MADE_AS, Made, check_awaits, check_called, check_marks, check_overrides, is_async

if TYPE_CHECKING:
    from collections.abc import Coroutine
    from types import TracebackType

    from pancakes.kernel.awaiting import ActorLoop, Awaited
    from pancakes.kernel.kernel import Kernel
    from pancakes.kernel.timer import OneShot


def _ignore_end(component: Component, error: BaseException | None) -> None:
    """Is told of an end that no other part waits for."""


COMPONENT_HOOKS: Final = ("on_start", "on_stop", "on_failure", "on_receive", "blocking")
"""The names of `Component` that a class of a user may have as well."""


def _awaited_hooks(cls: type) -> tuple[str, ...]:
    """Return which hooks of a class may be `async def`; empty: none of its methods may."""
    made: Made | None = getattr(cls, MADE_AS, None)
    return made.awaited if made is not None else ()


class Component(PykkaActor):
    """The base of what users derive from: an actor with an address, driven by packets and by time.

    Its methods run one at a time, in turns that its dispatcher gives; it never blocks. Any thread may call `call`,
    `log`, `event`, and all of its pykka ref.

    Args:
        kernel: the kernel it belongs to.
        address: its address, `agent/service` or `agent/service/task`; also its pykka URN.
        mailbox: the mailbox of its slot; None: one of its own.

    Attributes:
        address: its address.
        agent: the agent's name.
        name: the last part of the address.
    """

    blocking: bool = False
    """Whether it may wait, and therefore needs a thread of its own."""

    address: str
    agent: str
    name: str
    actor_inbox: Mailbox
    actor_stopped: Flag
    _actor: ActorCore

    def __init_subclass__(cls, **others: Any) -> None:
        """Raise `ClassError` if a method cannot be called as Pancakes calls it."""
        super().__init_subclass__(**others)
        check_overrides(cls, _awaited_hooks(cls))
        check_marks(cls)
        if not _awaited_hooks(cls):
            check_awaits(cls, "a service")
        check_levels(cls)

    def __init__(self, kernel: Kernel, address: str, mailbox: Mailbox | None = None) -> None:
        # pykka's own __init__ would make a UUID and an Event, the most of an actor's cost.
        ActorCore(kernel, address, mailbox, facade=self)

    def now(self) -> float:
        """Return the mission time in seconds. Any thread."""
        return self._actor.kernel.now()

    def local_time(self, packet: Packet) -> LocalTime | None:
        """Return when a packet was published, on this agent's own mission clock, and how well that is known.

        Its stamp is the mission time of its publisher's agent, whose clock began at another moment and runs at another
        rate. The heartbeats of the link between the two tell how the clocks stand to each other (docs/time.md). Any
        thread.

        Returns:
            None if that is not known: there was no link to that agent in its present life, or no heartbeat has come
            back on it yet; one of the missions is held; the packet is from an earlier life of that agent.
        """
        return self._actor.kernel.local_time(packet)

    @cached_property
    def random(self) -> random.Random:
        """Random numbers of this component's own, seeded from the agent's seed and the address."""
        core = self._actor
        return core.kernel.random_for(self.address) if core is self else core.random

    def publish(self, channel: str, body: Any, to: str = "", *, cause: Cause | None = None) -> Packet:
        """Publish a packet.

        Args:
            channel: where.
            body: an instance of a registered packet type.
            to: its destination (see `pancakes.packet`); empty: the subscribers on this agent.
            cause: the packet that led to this one; None: the one that is being handled, if any.

        Returns:
            The packet, whose `seq` a reply would name.

        Raises:
            UnknownChannelError: the stream has no such channel.
            MailboxFullError: a `reliable` subscriber has no room, or too many packets for the task that is its
                destination wait already; no subscriber got the packet.
            LocalProtocolError: the body is of no registered type, or too large to travel.
            NoPermitError: a guarded task does not know now whether another agent runs it.
        """
        core = self._actor
        kernel, fence, in_hand = core.kernel, core.fence, core.in_hand
        if fence is not None and channel != LOG and (permits := kernel.permits).by_task:
            if not permits.may_act(fence):
                permits.hold_back(fence, "packets")
                raise NoPermitError(f"{self.address} may not act until its guardians answer")
            if channel == CTRL and to:
                fence = permits.limited(fence, math.inf)
        if cause is None and in_hand is not None:
            cause = (in_hand.source, in_hand.seq)
        address, stream = core.address, kernel.stream
        route = stream.routes.get((channel, body.__class__, to)) or stream.new_route(channel, body, to, address)
        packet = Packet(channel, route.type, address, to, kernel.now(), next(core.seq), body, cause, fence)
        route.give(packet)
        return packet

    @cached_property
    def log(self) -> Log:
        """Publishes lines for people on `log`: `self.log.warning("no echo")`. Any thread."""
        return Log(self._actor.log_line)

    def event(self, kind: str, /, **fields: Any) -> None:
        """Publish an event for programs on `log`. Any thread."""
        self._actor.tell_log(Event(kind, fields))

    def subscribe(
        self,
        channel: str,
        body: type | str | None,
        handler: Callable[[Packet], None],
        queue: Queue = DEFAULT_QUEUE,
    ) -> None:
        """Call `handler` with each packet on `channel` from now on; for what is known at run time only.

        Raises:
            UnknownChannelError: the stream has no such channel.
            ClassError: the handler cannot be called with a packet; or `queue` is nothing of that kind.
        """
        policy = queue_policy(queue)
        may_await = self._actor.awaits
        wanted = "def handle(packet: Packet) -> None"
        check_called(handler, ("packet",), "subscribe calls it with a packet", wanted, may_await=may_await)
        name = body if body is None or isinstance(body, str) else type_name(body)
        self._actor.add_handler(Subscription(channel, name, policy), handler)

    def open_channel(self, name: str) -> None:
        """Add a channel to the information stream; one that is there already is left alone."""
        self._actor.kernel.stream.open(name)

    def close_channel(self, name: str) -> None:
        """Remove a channel that was added; the five core channels stay.

        Raises:
            UnknownChannelError: there is no such channel, or it is a core channel.
        """
        self._actor.kernel.stream.close(name)

    def after(self, delay_s: float, function: Callable[[], Any]) -> OneShot:
        """Call `function` in this actor in `delay_s` seconds of mission time."""
        return self._actor.kernel.timer.after(delay_s, lambda: self.call(function))

    def after_host(self, delay_s: float, function: Callable[[], Any]) -> OneShot:
        """Call `function` in this actor in `delay_s` seconds of host time (for time-outs between agents)."""
        return self._actor.kernel.timer.after_host(delay_s, lambda: self.call(function))

    def call(self, function: Callable[[], Any]) -> None:
        """Call `function` in this actor, after what it is doing now. Any thread; a stopped actor forgets it.

        It may be `async def` if a method of the task is.
        """
        if not self.actor_stopped.is_set():
            self.actor_inbox.put(Call(self._actor, function))

    def reschedule(self, rate_hz: float, timer: str = "") -> None:
        """Change the rate of a time-driven method, from its next tick on.

        Args:
            rate_hz: ticks for each second of mission time; 0 lets it rest.
            timer: the method's name; empty: the first of the class.

        Raises:
            ValueError: the rate is no rate, or the component has no such timer.
        """
        core = self._actor
        changed = core.timer_of(rate_hz, timer)
        changed.period_s = period_of(rate_hz)
        core.set_timer(changed)

    def pause(self) -> None:
        """Handle no tick and no packet until `resume`; calls (`after`) go on, packets wait. In the actor.

        A pause does not move with a task: on the other agent it runs.
        """
        core = self._actor
        core.is_paused = True
        core.enter_pause()

    def resume(self) -> None:
        """Go on after `pause`, unless Pancakes has frozen it meanwhile, to move it for instance. In the actor."""
        core = self._actor
        core.is_paused = False
        core.leave_pause()

    # Hooks -----------------------------------------------------------------------------------------------------

    def on_start(self) -> Coroutine[Any, Any, None] | None:
        """Called first, in the actor. An error here ends it. A task's may be `async def`."""

    def on_stop(self) -> Coroutine[Any, Any, None] | None:
        """Called last, in the actor, if it was stopped and did not fail. A task's may be `async def`."""

    def on_failure(
        self,
        exception_type: type[BaseException] | None,
        exception_value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Called in the actor if one of its methods raised; it ends after that, and its service decides."""

    def on_receive(self, message: Any) -> Any:
        """Handle what another thread told or asked by the pykka ref; components talk by packets instead."""
        raise TypeError(f"{self.address} takes packets, not {message!r}")

    # What pykka calls ------------------------------------------------------------------------------------------

    @property
    def actor_urn(self) -> str:
        """The address: pykka's name for an actor."""
        return self.address

    @cached_property
    def _actor_ref(self) -> pykka.ActorRef[Any]:
        # Components talk by packets; few are ever asked for the pykka ref that pykka makes for each.
        return pykka.ActorRef(self._actor.facade)

    @staticmethod
    def _create_actor_inbox() -> Any:
        return Mailbox()

    def _start_actor_loop(self) -> None:
        self._actor.kernel.attach(self._actor)

    def _stop(self) -> None:
        self._actor.end_loop()


def core_of(component: Component) -> ActorCore:
    """Return what runs a component: for Pancakes' own parts that made it."""
    return component._actor  # noqa: SLF001


class ActorCore(Component):
    """Runs one actor: its mailbox, its turns, its timers and handlers, how it begins and ends.

    It calls the hooks and handlers of its facade, which is the object that a user wrote. A class of Pancakes' own
    derives from it, and is its own facade.

    Args:
        kernel: the kernel it belongs to.
        address: its address; also its pykka URN.
        mailbox: the mailbox of its slot; None: one of its own.
        facade: the user's object; None: itself.

    Attributes:
        kernel: the kernel.
        facade: the object whose hooks and handlers it calls.
        timers: what ticks, by the name of the method.
        fence: the right under which it speaks; None: it needs none.
        seq: counts its packets.
        in_hand: the packet that it handles now.
        awaited: what it awaits between its turns.
        loop: its event loop; None: it has awaited nothing yet.
        is_paused: whether its author has paused it.
        is_waiting: whether it is paused because somebody drives an actuator of its by hand.
        exited: called when it has ended, with its facade, and the error if it failed.
        after_turn: called in the actor after each of its turns; None: nothing is.
    """

    # In the class, as few ever rest: it saves each actor three attributes.
    is_paused = False
    is_waiting = False
    awaited: Awaited | None = None
    loop: ActorLoop | None = None
    __frozen = False
    __rests = False  # whether it is paused or frozen
    __held: Sequence[Any] = ()
    __stops = False  # whether it awaits `on_stop`, which nothing holds back

    def __init__(
        self, kernel: Kernel, address: str, mailbox: Mailbox | None = None, *, facade: Component | None = None
    ) -> None:
        self.kernel = kernel
        self.facade = self if facade is None else facade
        inbox, stopped, name = mailbox if mailbox is not None else Mailbox(), Flag(), address.rpartition("/")[2]
        inbox.closed = False
        for one in (self,) if facade is None else (self, facade):
            one._actor = self  # noqa: SLF001
            one.address, one.agent, one.name = address, kernel.agent, name
            one.actor_inbox, one.actor_stopped = inbox, stopped
        self.timers: dict[str, TaskTimer] = {}
        self.fence: Fence | None = None
        self.seq = kernel.seq_of(address).numbers  # itself, as each packet takes one
        self.in_hand: Packet | None = None
        self.exited: Callable[[Any, BaseException | None], None] = _ignore_end
        self.after_turn: Callable[[], None] | None = None
        self.__handlers = self.__plan().handlers
        self.__shares_handlers = True
        self.__started = False

    @property
    def awaits(self) -> bool:
        """Whether its class has methods that are awaited, so that it needs a thread of its own."""
        return self.__plan().awaits

    @property
    def answering(self) -> dict[str, str]:
        """The names of its methods that answer requests, by the packet type of the request."""
        return self.__plan().answers

    def __plan(self) -> Plan:
        facade = self.facade
        mine: Any = type(facade)  # mypy takes no class for hashable whose base it does not see
        core: Any = None if facade is self else type(self)
        return plan_of(mine, core)

    @property
    def author_class(self) -> type:
        """The class of which its author would say that it is theirs: a failure shows a line of its package."""
        return type(self.facade)

    # What its facade asks of it --------------------------------------------------------------------------------

    def log_line(self, level: str, text: str, traceback: str) -> None:
        """Publish a line on `log`. Any thread."""
        self.tell_log(LogLine(level, text, traceback))

    def tell_log(self, body: Any) -> None:
        """Publish on `log`, and never fail. Any thread."""
        try:
            self.publish(LOG, body)
        except PancakesError:
            # No component may fail because a reader of `log` has no room, or because the stream is being taken down.
            self.kernel.stream.undelivered += 1

    def add_handler(self, subscription: Subscription, handler: Callable[[Packet], None]) -> None:
        """Call `handler` with the packets of a subscription from now on. In the actor."""
        if self.__shares_handlers:
            self.__handlers = {channel: Handlers(shared) for channel, shared in self.__handlers.items()}
            self.__shares_handlers = False
        handlers = self.__handlers.setdefault(subscription.channel, Handlers())
        if is_async(handler):
            awaited: Callable[[Packet], Any] = handler
            handlers.add(subscription.type, lambda component, packet: self.await_between_turns(awaited(packet)))
        elif self.awaits:
            handlers.add(subscription.type, lambda component, packet: self.after_awaiting(partial(handler, packet)))
        else:
            handlers.add(subscription.type, lambda component, packet: handler(packet))
        self.kernel.stream.subscribe(self.address, self.actor_inbox, subscription)
        self.__bind()

    def timer_of(self, rate_hz: float, timer: str = "") -> TaskTimer:
        """Return the timer that `reschedule` would change; see there."""
        period_of(rate_hz)
        if not self.timers:
            raise ValueError(f"{self.address} is not time-driven")
        name = timer or next(iter(self.timers))
        if name not in self.timers:
            raise ValueError(f"{self.address} has no timer {name!r}, only {', '.join(self.timers)}")
        return self.timers[name]

    def revoke(self) -> None:
        """Take the right to publish away from an actor that cannot be ended. Any thread."""

        def refuse(channel: str, body: Any, to: str = "", *, cause: Cause | None = None) -> Packet:
            raise ControlRefusedError(f"{self.address} was stopped and may publish nothing more")

        self.publish = self.facade.publish = refuse  # type: ignore[method-assign]

    # How it runs -----------------------------------------------------------------------------------------------

    def take_turn(self, slice_s: float | None) -> None:
        """Handle what waits, control first; then hand the token of the mailbox back.

        The dispatcher calls it, in the thread that holds the token.

        Args:
            slice_s: after this time the turn ends even if more waits; None: no limit.
        """
        mailbox, turn = self.actor_inbox, THREAD.turn
        turn.reader = self
        meter = self.kernel.meter
        begun_s = thread_time() if meter is not None else 0.0
        try:
            try:
                if not self.__started:
                    self.__begin()
                if mailbox.control:
                    self.__handle_control()
                # A component that has ended has no mailbox any more.
                if mailbox.order and not mailbox.paused and mailbox.component is self and self.acts():
                    self.__handle_data(slice_s)
            except BaseException as error:  # SystemExit in one actor must not end the others.
                self.__raise_to_program(error)
                if is_for_program(error):
                    self.kernel.unraised(error)
                self.__finish(partial(self.__fail, error))
            if self.after_turn is not None:
                self.__finish(self.after_turn)
        finally:
            try:
                if turn.deferred:
                    self.__do_deferred(turn.deferred)
            finally:
                turn.reader = None
        if meter is not None:
            meter.turn(self.address, thread_time() - begun_s)
        # A component that has ended keeps the token, so that what is put from now on waits for the successor.
        if mailbox.component is self:
            mailbox.end_turn()

    def __finish(self, function: Callable[[], None]) -> None:
        """Do what ends a turn, or this actor. The thread, which may be the timer's, outlives whatever that does."""
        try:
            function()
        except BaseException as error:
            self.__raise_to_program(error)
            self.__tell_failure(f"the end of {self.address}'s turn failed", error)

    def __raise_to_program(self, error: BaseException) -> None:
        """Raise an exception again that is for the program, if this turn runs on the program's own thread.

        Its handlers may have been broken off anywhere, so this actor gets no other turn: it keeps the token, as one
        does whose turn never ends.
        """
        if is_for_program(error) and self.kernel.virtual is not None:
            raise error

    def __do_deferred(self, deferred: list[Callable[[], None]]) -> None:
        try:
            for function in deferred:  # which may put off more
                try:
                    function()
                except Exception as error:  # the thread, and the right to turns, must outlive it
                    text = f"what a turn of {self.address} had put off failed: {type(error).__name__}: {error}"
                    self.kernel.log("error", text)
        finally:
            deferred.clear()

    def __begin(self) -> None:
        self.__started = True
        # Its predecessor may have ended while it was paused.
        self.actor_inbox.paused = False
        plan, facade = self.__plan(), self.facade
        self.before_start()
        for subscription in plan.subscriptions:
            self.kernel.stream.subscribe(self.address, self.actor_inbox, subscription)
        self.__bind()
        self.__call_awaited(facade.on_start, lambda: self.__begin_timers(plan))

    def __begin_timers(self, plan: Plan) -> None:
        facade = self.facade
        for method, period in plan.periods.items():
            period_s = self.initial_period_s(method, period.period_s)
            timer = TaskTimer(self, method, adapted_tick(getattr(type(facade), method)), period_s, self.kernel)
            self.timers[method] = timer
            self.kernel.task_timers.add(timer)
            self.set_timer(timer)
        self.after_start()

    def freeze(self) -> None:
        """For subclasses: lets none of its author's code run until `thaw`: calls, too, wait. In the actor.

        It is apart from `pause`, so that an author's `resume` does not end it, nor `thaw` an author's pause.
        """
        self.__frozen = True
        self.enter_pause()

    def thaw(self) -> None:
        """For subclasses: goes on after `freeze`. In the actor."""
        self.__frozen = False
        self.__release_held()
        self.leave_pause()

    def keep_back(self, item: Any) -> None:
        """For subclasses: keeps something of the control lane until the actor is not frozen and awaits nothing."""
        self.__held = (*self.__held, item)

    def __release_held(self) -> None:
        """Put back in front what was held, in its order."""
        held, self.__held = self.__held, ()
        self.actor_inbox.control.extendleft(reversed(held))
        if held:
            self.actor_inbox.wake()

    @property
    def is_frozen(self) -> bool:
        return self.__frozen

    def enter_pause(self) -> None:
        """Let no tick and no packet be handled until `leave_pause`. In the actor."""
        self.__rests = self.actor_inbox.paused = True
        for timer in self.timers.values():
            self.kernel.timer.cancel(timer)

    def leave_pause(self) -> None:
        """Go on if it is neither paused nor frozen, and waits for nothing. In the actor."""
        if self.is_paused or self.is_waiting or self.__frozen or not self.__rests:
            return
        self.__rests = False
        self.actor_inbox.paused = self.awaited is not None
        for timer in self.timers.values():
            self.set_timer(timer)

    def acts(self) -> bool:
        """For subclasses: returns whether the next tick or packet may be handled. In the actor."""
        return True

    def before_start(self) -> None:
        """For subclasses: comes before `on_start` and before anything is subscribed to."""

    def after_start(self) -> None:
        """For subclasses: comes once everything runs."""

    def initial_period_s(self, method: str, period_s: float) -> float:
        """For subclasses: the period that a time-driven method begins with; `period_s` is what the class says."""
        return period_s

    def set_timer(self, timer: TaskTimer) -> None:
        """Let a timer tick at its period from now on, unless all of them rest. In the actor."""
        if timer.period_s < math.inf and not self.__rests:
            self.kernel.timer.every(timer, timer.period_s)
        else:
            self.kernel.timer.cancel(timer)

    def __handle_control(self) -> None:
        mailbox = self.actor_inbox
        control = mailbox.control
        # Only what waits now: one that tells itself something must not starve the others.
        for _ in range(len(control)):
            if mailbox.component is not self:
                return
            item = control.popleft()
            if isinstance(item, TaskTimer):
                if item.component is not self:
                    continue
                if self.awaited is not None:
                    self.keep_back(item)  # one that waits already, so those that come meanwhile count as missed
                else:
                    item.run()
            elif isinstance(item, Told):
                if item.component is self:
                    self.take_message(item.message)
            elif isinstance(item, Call):
                if item.component is not self:
                    continue
                if self.__stops:
                    if item.is_own:
                        item.function()
                elif self.__frozen or not self.acts() or (self.awaited is not None and not item.is_own):
                    self.keep_back(item)
                else:
                    self.__call_awaited(item.function)
            else:
                handle_envelope(self.facade, item)

    def __handle_data(self, slice_s: float | None) -> None:
        """Handle the packets that wait now, as long as there is time."""
        mailbox, facade = self.actor_inbox, self.facade
        order, control = mailbox.order, mailbox.control
        waiting = len(order)
        host_now, until_s = None, math.inf
        if slice_s is not None and waiting > 1:  # a turn of one packet needs no look at the time
            host_now = self.kernel.host.now
            until_s = host_now() + slice_s
        for _ in range(waiting):
            try:
                queue = order.popleft()
            except IndexError:  # some fell out meanwhile
                return
            # As `queue.take`, without a call for each packet: that would be a tenth of a delivery to many.
            packet = queue.entries.popleft()
            queue.handled += 1
            if packet.__class__ is not Packet:
                packet = queue.unweighed(packet)
            self.in_hand = packet
            for handler in queue.handlers:
                handler(facade, packet)
            self.in_hand = None
            if control:
                self.__handle_control()
                if mailbox.component is not self:  # the mailbox is the successor's now
                    return
            if mailbox.paused or (host_now is not None and host_now() > until_s):
                return

    # What it awaits --------------------------------------------------------------------------------------------

    def __call_awaited(self, function: Callable[[], Any], then: Callable[[], None] | None = None) -> None:
        """Call a function, which may be `async def`, and another one once it has ended."""
        result = function()
        if iscoroutine(result):
            self.await_between_turns(result, then)
        elif then is not None:
            then()

    def await_between_turns(self, coroutine: Coroutine[Any, Any, Any], then: Callable[[], None] | None = None) -> None:
        """Let a coroutine of the author's run between turns, until it has ended or is cancelled. In the actor.

        Packets, ticks and calls wait until then.

        Args:
            coroutine: the coroutine.
            then: called in the actor once it has ended well.

        Raises:
            TypeError: the class has no `async def` method, so the actor has no thread of its own to await in.
        """
        if self.awaited is not None:
            self.awaited.behind.append((partial(self.await_between_turns, coroutine, then), coroutine))
            return
        if not self.awaits:
            coroutine.close()
            raise TypeError(
                f"{self.address} was given a coroutine to call, and only a task with an `async def` method that @on or"
                " @every decorates awaits: write such a method"
            )
        self.__await(coroutine, then)

    def __await(
        self, coroutine: Coroutine[Any, Any, Any], then: Callable[[], None] | None = None, is_stop: bool = False
    ) -> None:
        from pancakes.kernel.awaiting import Awaited  # asyncio takes long to import

        if self.loop is None:
            self.loop = self.kernel.loop_for(self)
        task = self.loop.loop.create_task(coroutine)
        task.add_done_callback(lambda task: self.actor_inbox.put(Call(self, self.__came_back, is_own=True)))
        self.awaited = Awaited(task, self.in_hand, then, is_stop)
        self.actor_inbox.paused = True
        self.settle_in(0.0)

    def after_awaiting(self, function: Callable[[], Any]) -> None:
        """Call a function now, or once what is awaited of the same packet has ended. In the actor."""
        if self.awaited is not None:
            self.awaited.behind.append((function, None))
        else:
            function()

    def settle_in(self, delay_s: float) -> None:
        """In virtual time: let the loop go on after that many seconds of the agent's host clock."""
        if self.kernel.virtual is None:
            return
        step = Call(self, self.__settle, is_own=True)
        if delay_s > 0.0:
            self.kernel.timer.after_host(delay_s, lambda: self.actor_inbox.put(step))
        else:
            self.actor_inbox.put(step)

    def __settle(self) -> None:
        if self.loop is not None and self.awaited is not None:
            self.loop.settle()

    def may_await(self) -> bool:
        # Not only until the coroutine has ended: what the loop does next tells the actor of it.
        return self.awaited is not None and (self.__stops or (not self.__frozen and self.acts()))

    def __came_back(self) -> None:
        """Go on after what was awaited, which has ended."""
        awaited = self.awaited
        if awaited is None or not awaited.task.done():
            return
        self.awaited = None
        if awaited.is_stop:
            self.end_actor(None if awaited.task.cancelled() else awaited.task.exception())
            return
        self.actor_inbox.paused = self.__rests
        self.__release_held()
        self.in_hand = awaited.packet
        try:
            if awaited.task.cancelled():
                raise RuntimeError(f"what {self.address} awaited was cancelled by its own code")
            awaited.task.result()  # raises what it raised, in this turn
        except BaseException:
            awaited.drop_behind()
            for failed in awaited.failed:
                failed()
            raise
        if awaited.then is not None:
            awaited.then()
        while awaited.behind:
            function, _ = awaited.behind.popleft()
            function()
            if self.awaited is not None:
                self.awaited.behind.extend(awaited.behind)
                break
        self.in_hand = None

    def lost(self, what: str, error: BaseException | None) -> None:
        if self.actor_stopped.is_set():
            return  # what its author began ends with it
        if error is not None:
            self.__tell_failure(f"in the event loop of {self.address}: {what}", error)
        else:
            self.kernel.log("error", f"in the event loop of {self.address}: {what}")

    def __cancel_awaited(self) -> None:
        """Cancel what is awaited, and let it end. In the actor, which ends."""
        awaited, self.awaited = self.awaited, None
        if awaited is None or self.loop is None:
            return
        awaited.drop_behind()
        if not self.loop.cancel(awaited.task):
            self.kernel.log(
                "warning", f"{self.address} is stopped, and what it awaits does not end when it is cancelled"
            )
        elif not awaited.task.cancelled() and (error := awaited.task.exception()) is not None:
            self.__tell_failure(f"what {self.address} awaited failed while it was cancelled", error)

    def __bind(self) -> None:
        """Tell each queue what is done with its packets."""
        for channel, queue in self.actor_inbox.queues.items():
            queue.handle(self.__handlers.get(channel, NO_HANDLERS))

    def __handle(self, packet: Packet) -> None:
        self.in_hand = packet
        facade = self.facade
        for handler in self.__handlers.get(packet.channel, NO_HANDLERS)[packet.type]:
            handler(facade, packet)
        self.in_hand = None

    def take_message(self, message: Any) -> Any:
        """For subclasses: handles what `tell` has brought. In the actor."""
        raise TypeError(f"{self.address} knows nothing of {message!r}")

    def run_handlers(self, packet: Packet) -> None:
        """Handle a packet at once, past the queues and their bounds. In the actor."""
        try:
            self.__handle(packet)
        finally:
            self.in_hand = None

    def drain(self) -> None:
        """Handle the packets that still wait: for `on_stop` of a component that must not lose the last of them."""
        while (packet := self.actor_inbox.take()) is not None:
            self.run_handlers(packet)

    # How it ends -----------------------------------------------------------------------------------------------

    def end_loop(self) -> None:
        """End the actor, which was asked to. In the actor."""
        error: BaseException | None = None
        if self.__stops:
            return  # it was asked to before
        try:
            self.__cancel_awaited()
            stopping = self.facade.on_stop()
            if iscoroutine(stopping):
                self.__await_stop(stopping)
                return
        except BaseException as failure:  # SystemExit, too, ends no more than this actor
            self.__raise_to_program(failure)
            error = failure
        self.end_actor(error)

    def __await_stop(self, coroutine: Coroutine[Any, Any, None]) -> None:
        """Await `on_stop` between turns, and end then."""
        from pancakes.kernel.awaiting import STOP_S

        self.__stops = True
        self.__await(coroutine, is_stop=True)
        cut = Call(self, self.__cut_stop, is_own=True)
        self.kernel.timer.after_host(STOP_S, lambda: self.actor_inbox.put(cut))

    def __cut_stop(self) -> None:
        if not self.actor_stopped.is_set():
            self.kernel.log("warning", f"on_stop of {self.address} takes too long, and is cancelled")
            self.end_actor(None)

    def __fail(self, error: BaseException) -> None:
        packet = self.in_hand
        if packet is not None:  # else it was a tick or a call
            self.in_hand = None
            queue = self.actor_inbox.queues[packet.channel].of(packet.type)
            self.kernel.dead_letters.failed(self.address, queue, packet)
        if self.actor_stopped.is_set():
            self.__tell_failure(f"{self.address} failed while it stopped", error)
            return
        try:
            self.facade.on_failure(type(error), error, error.__traceback__)
        except BaseException as second:
            self.__raise_to_program(second)
            self.__tell_failure(f"on_failure of {self.address} failed as well", second)
        self.end_actor(error)

    def __tell_failure(self, what: str, error: BaseException) -> None:
        self.kernel.log("error", f"{what}: {describe(error, self.author_class)}", traceback_of(error))

    def end_actor(self, error: BaseException | None) -> None:
        """For subclasses: ends the actor for good, after its hooks; `error` says why, if it failed. In the actor."""
        self.__cancel_awaited()
        self.actor_stopped.set()
        for timer in self.timers.values():
            self.kernel.timer.cancel(timer)
        self.kernel.task_timers.remove(self)
        self.kernel.registry.remove(self)
        # Its subscriptions stay: its service knows whether a successor will read what is published.
        mailbox = self.actor_inbox
        mailbox.component = None
        if self.loop is not None and self.kernel.virtual is not None:  # else its thread closes it
            self.loop.close()
        mailbox.closed = True
        mailbox.clear_control()
        self.exited(self.facade, error)
