"""Has the tasks of one service go on in new classes: tries whether they could, and then exchanges the classes.

A running task is stopped and started, as by `Restart`: it keeps its record, its identity and its guardians. In between
its slot gets the new class, if what the task carried at the end fits; otherwise the task starts in its old one. All in
the service's actor.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, Protocol

import msgspec
from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.errors import ControlRefusedError, PancakesError
from pancakes.kernel.handlers import period_of, plan_of
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import tell
from pancakes.settings import make_settings
from pancakes.supervision.lifecycle import ACTOR, Answer, Request, State, StopAsked
from pancakes.supervision.messages import (
    Carried,
    Look,
    Looked,
    ReloadedTask,
    TakeClasses,
    TaskEnded,
    TasksReloaded,
    TryClasses,
)
from pancakes.supervision.slots import STUCK_S, Slot
from pancakes.task import TaskSpec


class Reloading(Protocol):
    """What a reload needs of a service."""

    kernel: Kernel
    slots: dict[str, Slot]

    @property
    def name(self) -> str: ...

    def feed(self, slot: Slot, event: Any) -> None: ...

    def show(self, slot: Slot) -> None: ...

    def refuse_start(self, slot: Slot) -> str: ...

    def refuse_reload(self, slot: Slot) -> None: ...

    def carried_of(self, slot: Slot) -> Carried: ...

    def set_settings(self, slot: Slot, settings: Mapping[str, Any]) -> dict[str, Any]: ...

    def event(self, kind: str, /, **fields: Any) -> None: ...

    def after_host(self, delay_s: float, function: Any) -> Any: ...


class _Exchange(msgspec.Struct):
    """A task that ends to begin in a new class.

    Attributes:
        spec: how it starts then.
        request: the request for it.
        forgets: whether the packets that wait for it are dropped.
        refusal: why it begins in its old class; None: it does not.
        ended: whether it has ended.
    """

    spec: TaskSpec
    request: Request
    forgets: bool
    refusal: Refusal | None = None
    ended: bool = False


class _Order(msgspec.Struct):
    """A question or an order of the root that is not answered yet.

    Attributes:
        asked: what it said.
        left: the tasks that have not answered, by name.
        told: what is known of the others.
    """

    asked: TryClasses
    left: set[str]
    told: list[ReloadedTask]


class Reloads:
    """Has the tasks of one service go on in new classes. All in that service's actor.

    Args:
        service: the service.
    """

    def __init__(self, service: Reloading) -> None:
        self._service = service
        self._trying: _Order | None = None
        self._taking: _Order | None = None
        self._exchanges: dict[str, _Exchange] = {}

    # Trying ----------------------------------------------------------------------------------------------------

    def attempt(self, asked: TryClasses) -> None:
        """See whether the tasks of these types could go on in new classes; those that run are asked what they carry."""
        order = self._trying = _Order(asked, set(), [])
        for slot in self._slots_of(asked):
            refusal = self._refusal_now(slot, self._spec_of(slot, asked))
            if refusal is None and slot.life.state is State.RUNNING and slot.task is not None:
                order.left.add(slot.name)
                tell(slot.task, Look())
            else:
                order.told.append(self._row(slot, refusal))
        if order.left:
            self._service.after_host(STUCK_S, partial(self._overdue, order))
        self._answer(order)

    def looked(self, looked: Looked) -> None:
        """A task says what it carries."""
        order = self._trying
        slot = self._service.slots.get(looked.task.name)
        if order is None or slot is None or slot.task is not looked.task or slot.name not in order.left:
            return
        if looked.carried is None:
            reason = f"what {slot.address} carries cannot be written down: {looked.reason}"
            self._tried(order, slot, Refusal("failed", reason))
        else:
            self._tried(order, slot, self._misfit(slot, self._spec_of(slot, order.asked), looked.carried))

    def _overdue(self, order: _Order) -> None:
        for name in sorted(order.left):
            slot = self._service.slots.get(name)
            if slot is None:  # it was removed, or has moved
                order.left.discard(name)
                continue
            reason = (
                f"{slot.address} did not tell within {STUCK_S:g} s what it carries: it is busy, or paused. Try again"
            )
            self._tried(order, slot, Refusal("busy", reason, STUCK_S))
        self._answer(order)

    def _tried(self, order: _Order, slot: Slot, refusal: Refusal | None) -> None:
        order.left.discard(slot.name)
        order.told.append(self._row(slot, refusal))
        self._answer(order)

    def _refusal_now(self, slot: Slot, spec: TaskSpec) -> Refusal | None:
        """Return why a task cannot go on in a new class now, as far as its service knows that without it."""
        life = slot.life
        try:
            self._service.refuse_reload(slot)
        except PancakesError as error:
            return Refusal.of(error)
        if life.state is State.STUCK:
            return Refusal("conflict", f"{slot.address} is stuck: restart the agent")
        if life.asker is not None or (life.state in ACTOR and life.state is not State.RUNNING):
            return Refusal.of(ControlRefusedError(f"{slot.address} is {life.word}: try again", "busy"))
        if life.state is not State.RUNNING:
            return None  # what it carries is looked at when it starts, as always
        if (loan := self._service.kernel.registry.waits_for(slot.address)) is not None:
            return Refusal("busy", f"{slot.address} is paused, {loan.why}: try again after that")
        return Refusal.if_any(self._service.refuse_start(replace(slot, spec=spec)))

    def _misfit(self, slot: Slot, spec: TaskSpec, carried: Carried) -> Refusal | None:
        """Return why what a task carries does not fit a new class; the message names each field."""
        settings = self._service.set_settings(slot, carried.settings)
        try:
            make_settings(spec.cls.Settings, settings, owner=slot.address)
            make_settings(spec.cls.State, carried.state, allow_nan=True, owner=slot.address, noun="state")
        except PancakesError as error:
            drop = f"`pancakes task restart --drop-state {slot.address}` begins it without its state"
            return replace(Refusal.of(error), text=f"{error}: keep what it has; or stop it, reload, and {drop}")
        if outside := self._service.kernel.folders.refusal_of(spec.cls.Settings, settings):
            return Refusal("invalid", f"bad settings for {slot.address}: {outside}")
        asked = carried.requests.asked if carried.requests is not None else ()
        for to, method in ((one.to, method) for one in asked for method in (one.then, one.feedback) if method):
            if not callable(getattr(spec.cls, method, None)):
                waits = f"{slot.address} waits for what {to} answers, which its method {method!r} takes"
                return Refusal("busy", f"{waits}: keep that method, or try again when the answer has come")
        return None

    # Exchanging ------------------------------------------------------------------------------------------------

    def take(self, message: TakeClasses) -> None:
        """Exchange the classes: of tasks at rest at once, of those that run when they have ended."""
        order = self._taking = _Order(message.order, set(), [])
        for slot in self._slots_of(order.asked):
            spec = self._spec_of(slot, order.asked)
            refusal = self._refusal_now(slot, spec)
            if refusal is not None:
                order.told.append(self._row(slot, refusal))
            elif slot.life.state is State.RUNNING:
                order.left.add(slot.name)
                self._exchanges[slot.name] = _Exchange(spec, message.request, message.forgets)
                reason = f"reload asked for by {message.request.by}"
                self._service.feed(slot, StopAsked(message.request, reason, again=True))
            else:
                if slot.carried is not None:
                    slot.carried = self._what_was_set(slot, slot.carried)
                self._exchange(slot, spec, message.forgets)
                order.told.append(self._row(slot, None))
        self._answer(order)

    def ended(self, ended: TaskEnded) -> TaskEnded:
        """A task has ended: it gets its new class, if there is one; return what it carries from here on."""
        slot = self._service.slots.get(ended.task.name)
        exchange = self._exchanges.get(slot.name) if slot is not None and slot.task is ended.task else None
        if slot is None or exchange is None or exchange.ended:
            return ended
        exchange.ended = True
        carried = ended.last or self._service.carried_of(slot)
        exchange.refusal = self._misfit(slot, exchange.spec, carried)
        if exchange.refusal is not None:
            return ended
        if ended.last is not None:
            ended = replace(ended, last=self._what_was_set(slot, carried))
        self._exchange(slot, exchange.spec, exchange.forgets)
        return ended

    def _what_was_set(self, slot: Slot, carried: Carried) -> Carried:
        """Return what a task carries without what its old class says: the defaults and rates of the new one count."""
        cls: Any = slot.spec.cls  # mypy takes no class for hashable whose base it does not see
        periods_s = {name: it.period_s for name, it in plan_of(cls).periods.items()}
        if slot.spec.rate_hz is not None and periods_s:
            periods_s[next(iter(periods_s))] = period_of(slot.spec.rate_hz)
        changed_s = {name: it for name, it in carried.periods_s.items() if it != periods_s.get(name)}
        settings = self._service.set_settings(slot, carried.settings)
        return replace(carried, settings=settings, periods_s=changed_s)

    def _exchange(self, slot: Slot, spec: TaskSpec, forgets: bool) -> None:
        slot.spec = spec
        if forgets:
            slot.mailbox.clear_data()
        self._service.show(slot)

    def answered(self, slot: Slot, effect: Answer) -> bool:
        """Return whether the answer to a request was for a reload: the root gives that, once all tasks have begun."""
        exchange = self._exchanges.get(slot.name)
        if exchange is None or effect.asker != exchange.request:
            return False
        if exchange.ended:
            del self._exchanges[slot.name]  # else it is stuck, and gets its new class should it end
        refusal = Refusal.if_any(effect.reason, "failed") or exchange.refusal
        if refusal is None:
            fields = {"service": self._service.name, "type": slot.spec.type, "version": slot.spec.version}
            self._service.event("task_reloaded", task=slot.name, **fields, by=effect.asker.by)
        if self._taking is not None and slot.name in self._taking.left:
            self._taking.left.discard(slot.name)
            self._taking.told.append(self._row(slot, refusal))
            self._answer(self._taking)
        return True

    # Both ------------------------------------------------------------------------------------------------------

    def _slots_of(self, asked: TryClasses) -> list[Slot]:
        slots = self._service.slots.values()
        return [slot for slot in slots if slot.spec.type in asked.classes and not slot.spec.device]

    def _spec_of(self, slot: Slot, asked: TryClasses) -> TaskSpec:
        return replace(slot.spec, cls=asked.classes[slot.spec.type], version=asked.version)

    def _row(self, slot: Slot, refusal: Refusal | None) -> ReloadedTask:
        return ReloadedTask(self._service.name, slot.name, slot.spec.type, slot.rest or slot.life.word, refusal)

    def _answer(self, order: _Order) -> None:
        if order.left or (order is not self._trying and order is not self._taking):
            return
        if order is self._trying:
            self._trying = None
        else:
            self._taking = None
        asked = order.asked
        tell(asked.asker, TasksReloaded(self._service.name, asked.number, tuple(order.told)))
