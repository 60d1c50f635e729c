"""The life of tasks under a service: they are started, stood by, and stopped (paper §3.3)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import islice
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import msgspec

from pancakes.control import Hold
from pancakes.errors import ClassError, ControlRefused, describe, traceback_of
from pancakes.kernel.component import Component
from pancakes.kernel.mailbox import Mailbox
from pancakes.packet import CTRL, join
from pancakes.saved_types import check_saved
from pancakes.schema import schema_of
from pancakes.settings import SettingsError, make_settings, plain_settings
from pancakes.slot import Failure, Slot, TaskState
from pancakes.supervision import Next, Supervision
from pancakes.task import Carried, Nothing, Task, TaskSpec

if TYPE_CHECKING:
    from pancakes.kernel.kernel import Kernel


STUCK_S = 2.0
"""A task that has not ended so long after it was asked to, in host time, is stuck."""
STUCK_AT_THE_END_S = 0.4
"""Where the whole agent stops, this must do: the others, wheels among them, want to be stopped in order too."""


FOLLOW_S = 1.0
"""How often, in host time, a task is tried again that was refused, for want of a device, say."""
STARTED_AT_ONCE = 64


class Supervisor(Component):
    """Keeps a registry of tasks, starts and stops them, and stands by them (paper §3.3, duties 1 and 2).

    Attributes:
        settings: an instance of the class's `Settings`.
        slots: its tasks, by name.
        stopped_for_s: while it stops: after how many seconds of mission time it will be started again; None: it
            will not by itself.
    """

    Settings: ClassVar[type] = Nothing
    started_at_once: ClassVar[int] = STARTED_AT_ONCE
    """So many of its tasks it starts in one turn."""

    settings: Any

    def __init_subclass__(cls, **others: Any) -> None:
        """Raises `ClassError` where the class cannot work: a method that Pancakes calls, or `Settings`."""
        super().__init_subclass__(**others)
        check_saved(cls, "Settings")

    def __init__(
        self,
        kernel: Kernel,
        address: str,
        mailbox: Mailbox | None = None,
        *,
        settings: Mapping[str, Any] | None = None,
        tasks: Sequence[TaskSpec] = (),
        ready: Callable[[Supervisor], None] | None = None,
        kept: Mapping[str, Carried] | None = MappingProxyType({}),
    ) -> None:
        super().__init__(kernel, address, mailbox)
        self.settings = make_settings(self.Settings, settings or {}, owner=self.name)
        self._configured = tuple(tasks)
        self._on_ready = ready
        self._kept = kept
        self._unsettled: set[str] = set()
        self._told_ready = False
        # Made once: all tasks are given the same.
        self._hear_start = self._start_heard
        self._hear_end = self._end_heard
        self.closing = False
        self.slots: dict[str, Slot] = {}
        self.stopped_for_s: float | None = None

    # For subclasses --------------------------------------------------------------------------------------------

    def own_tasks(self) -> Sequence[TaskSpec]:
        """Returns the tasks that the service brings itself; called once, before they start."""
        return ()

    def specs(self) -> Sequence[TaskSpec]:
        """Returns all tasks that have a place from the start on; called once."""
        return (*self.own_tasks(), *self._configured)

    def admit(self, slot: Slot) -> str:
        """Says why a task must not be started now; empty: it may."""
        lacking = self.kernel.registry.lacking(slot.spec.cls.requires)
        if lacking:
            return f"{self.agent} lacks the device types {', '.join(lacking)}, which {slot.name} requires"
        return ""

    def refuse_start(self, slot: Slot) -> str:
        """Says why a start of a task would fail now, as far as that is known beforehand; empty: for no reason."""
        reason = self.admit(slot)
        registry = self.kernel.registry
        for device in registry.devices():
            if not reason and device.actuator and device.type in slot.spec.cls.requires:
                reason = registry.taken(device.name, slot.address)
        return reason

    def refuse_stop(self) -> str:
        """Says why the service must not be stopped now; empty: it may. Called in the root's actor."""
        return ""

    def has(self, name: str) -> bool:
        """Returns whether the service has a task of this name, at rest or not. Any thread."""
        return name in self.slots

    def open_slot(self, spec: TaskSpec) -> Slot:
        """Makes the place for a task, without starting it.

        Raises:
            ControlRefused: the service has a task of this name.
        """
        if spec.name in self.slots:
            raise ControlRefused(f"{self.address} already has a task {spec.name}")
        slot = Slot(spec, join(self.agent, self.name, spec.name), Supervision(spec.restart))
        self.slots[spec.name] = slot
        return slot

    def arguments_of(self, slot: Slot) -> Mapping[str, Any]:
        """Returns what a task's class wants besides what every task gets."""
        return slot.spec.arguments

    def launch(self, slot: Slot, then: Callable[[str], None] | None = None) -> None:
        """Starts the task of a slot, with what it carries.

        Args:
            slot: a slot whose task does not run.
            then: called in this actor once it runs, with an empty string, or when it did not start, with the reason.
        """
        slot.supervision.cancel()
        reason = "its service stops" if self.closing else self.admit(slot)
        reason = reason or self.kernel.registry.hold(slot.address, slot.spec.cls.requires)
        if reason:
            is_news = slot.reason != reason
            slot.state = TaskState.STOPPED
            slot.reason = reason
            # Its predecessor may have left subscriptions and actuators to it.
            self._let_go(slot)
            if then is not None:
                then(reason)
            else:
                if is_news:
                    self.log("error", f"{slot.address} was not started: {reason}")
                self.after_host(FOLLOW_S, lambda: self._retry_refused(slot, reason))
            self.settle(slot)
            return
        carried = slot.carried or Carried(slot.spec.settings, {})
        slot.state = TaskState.STARTING
        slot.incarnation += 1
        slot.reason = ""
        if then is not None:
            slot.on_running = (*slot.on_running, then)
        try:
            component = self.kernel.spawn(
                slot.spec.cls,
                slot.address,
                mailbox=slot.mailbox,
                carried=carried,
                rate_hz=slot.spec.rate_hz,
                fence=slot.fence,
                started=self._hear_start,
                exited=self._hear_end,
                **self.arguments_of(slot),
            )
        except Exception as error:  # what a task's author wrote in __init__ may raise anything
            self._task_failed(slot, error, hopeless=isinstance(error, SettingsError))
            return
        assert isinstance(component, Task)
        slot.task = component

    def _retry_refused(self, slot: Slot, reason: str) -> None:
        """Tries a task again that was refused: it follows once what it lacked is there."""
        if slot.state is TaskState.STOPPED and slot.reason == reason and not slot.busy and not self.closing:
            self.launch(slot)

    def halt(
        self,
        slot: Slot,
        then: Callable[[], None] | None = None,
        reason: str = "asked for",
        stuck: Callable[[str], None] | None = None,
    ) -> None:
        """Stops the task of a slot once it has finished the message in hand; a stop that was meant restarts nothing.

        Args:
            slot: the slot.
            then: called in this actor once the task has ended.
            reason: why, for the log.
            stuck: called in this actor, with a sentence, where it does not end in time; `then` still comes if it ever
                ends.
        """
        if slot.state is TaskState.STUCK and stuck is not None:
            stuck(f"{slot.address} is stuck")
        if slot.state in (TaskState.STOPPED, TaskState.FAILED) and slot.supervision.due_s is None:
            self._let_go(slot)
            if then is not None:
                then()
            return
        if then is not None:
            slot.on_ended = (*slot.on_ended, then)
        if slot.supervision.due_s is not None:
            slot.supervision.forget()
            self._rest(slot, reason)
            return
        if slot.state in (TaskState.STOPPING, TaskState.STUCK):
            return
        if stuck is not None:
            slot.on_stuck = (*slot.on_stuck, stuck)
        slot.state = TaskState.STOPPING
        slot.reason = reason
        task = slot.task
        if task is not None and not task.actor_stopped.is_set():
            task.stop()
            self.after_host(STUCK_S, lambda: self._look_for_end(slot, task))

    def _look_for_end(self, slot: Slot, task: Task) -> None:
        """A task should have ended by now. One that has not may say nothing more; no second copy starts beside it."""
        if slot.task is not task or slot.state is not TaskState.STOPPING:
            return
        slot.state = TaskState.STUCK
        task.revoke()
        self.hold_actuators(slot, f"{slot.name} is stuck")
        text = f"{slot.address} is stuck: it was asked to stop and is still busy"
        self.log("error", text)
        self.event("task_stuck", task=slot.name)
        waiting, slot.on_stuck = slot.on_stuck, ()
        for stuck in waiting:
            stuck(text)

    def keep(self) -> Mapping[str, Carried]:
        """Returns what its tasks carried last, by their names, for the next start of the service. Once it has ended."""
        return {name: slot.carried for name, slot in self.slots.items() if slot.carried is not None}

    def close(self, then: Callable[[], None]) -> None:
        """Stops all tasks, last first, then the service itself; `then` is called in its actor just before that."""
        self.closing = True
        slots = [slot for slot in reversed(self.slots.values()) if slot.state is not TaskState.STOPPED]

        def next_one() -> None:
            if slots:
                stop_one(slots.pop(0))
            else:
                self.settle_all(end)

        def stop_one(slot: Slot) -> None:
            gone_on = False

            def go_on() -> None:
                nonlocal gone_on
                if not gone_on:
                    gone_on = True
                    next_one()

            def give_up() -> None:
                # One that does not end must not keep the others from ending.
                if not gone_on and slot.task is not None:
                    self._look_for_end(slot, slot.task)
                go_on()

            self.halt(slot, go_on, "its service stops")
            if not gone_on:
                self.after_host(STUCK_AT_THE_END_S if self.kernel.stopping else STUCK_S, give_up)

        def end() -> None:
            then()
            self.stop()

        next_one()

    def settle_all(self, then: Callable[[], None]) -> None:
        """For subclasses: calls `then`, once, when nothing is under way that must be finished before it ends."""
        then()

    def describe_task(self, slot: Slot) -> dict[str, Any]:
        """Returns what is to be known about a task, as plain values."""
        task = slot.task
        # A copy: the task makes its timers in its own thread.
        timers = list(task.timers.values()) if task is not None else []
        first = timers[0] if timers else None
        return {
            "agent": self.agent,
            "service": self.name,
            "task": slot.name,
            "type": slot.spec.type or slot.spec.cls.__name__,
            "state": slot.state.value,
            "rest": "",
            "rate_hz": first.rate_hz if first is not None else None,
            "incarnation": slot.incarnation,
            "reason": slot.reason,
            **slot.supervision.describe(self.kernel.host.now()),
            "ticks": first.ticks if first is not None else 0,
            "lateness_sum_s": first.lateness_sum_s if first is not None else 0.0,
            "missed": sum(timer.missed_total for timer in timers),
            "lateness_max_s": max((timer.lateness_max_s for timer in timers), default=0.0),
            "dropped": slot.mailbox.dropped(),
        }

    def describe_in_detail(self, slot: Slot) -> dict[str, Any]:
        """Returns all that is to be known about a task, its settings among it, as plain values."""
        task = slot.task
        return {
            **self.describe_task(slot),
            # No configuration names it: it comes with its service, whose settings are where its own come from.
            "own": not slot.spec.type,
            "requires": list(slot.spec.cls.requires),
            "timers": [timer.describe() for timer in list(task.timers.values())] if task is not None else [],
            "reads": self.kernel.stream.readings(slot.address),
            "settings": self.settings_of(slot),
            "settings_schema": self.schema_of_settings(slot),
            "durability": slot.spec.durability,
            "restart": msgspec.structs.asdict(slot.spec.restart),
            "failure": msgspec.to_builtins(slot.failure),
            "fence": {"task_id": slot.fence.task_id, "epoch": slot.fence.epoch[0]} if slot.fence is not None else None,
        }

    def author_of(self, slot: Slot) -> type:
        """Returns the class of which a task's author would say that it is theirs; see `Component._author_class`."""
        return slot.spec.cls

    def settings_class(self, slot: Slot) -> type:
        """Returns the dataclass of a task's settings."""
        return slot.spec.cls.Settings

    def settings_of(self, slot: Slot) -> dict[str, Any]:
        """Returns the settings of a task, or those that it would begin with, as plain values."""
        carried = self.carried_of(slot)
        try:
            settings = slot.task.settings if slot.task is not None else None
            settings = settings or make_settings(self.settings_class(slot), carried.settings)
        except SettingsError:  # it cannot start with them, and whoever asks wants to see why
            return dict(carried.settings)
        try:
            return plain_settings(settings)
        except TypeError as error:  # what its author put there may be anything
            return {"error": f"the settings of {slot.address} cannot be told: {error}"}

    def schema_of_settings(self, slot: Slot) -> dict[str, Any]:
        """Returns the JSON Schema of a task's settings; empty where they have a type that cannot be checked."""
        try:
            return _schema_of(self.settings_class(slot))
        except TypeError:
            return {}

    def carried_of(self, slot: Slot) -> Carried:
        """Returns what a task that does not run would begin with."""
        return slot.carried or Carried(slot.spec.settings, {})

    # Its life --------------------------------------------------------------------------------------------------

    def after_start(self) -> None:
        for spec in self.specs():
            slot = self.open_slot(spec)
            self.take_up(slot, self._kept)
            if self.wants(slot):
                self._unsettled.add(slot.name)
        self.log("debug", f"{self.address} started with {', '.join(self.slots) or 'no tasks'}")
        wanted = [slot for slot in self.slots.values() if slot.name in self._unsettled]
        for slot in wanted:
            slot.busy = True
        self._start_some(iter(wanted))
        if not self._unsettled and not self._told_ready:
            self._tell_ready()

    def _start_some(self, wanted: Iterator[Slot]) -> None:
        """Starts the next few of many tasks; the others follow in turns of their own.

        In one turn ten thousand would hold a thread of the pool for half a second, and fight with those that run
        already for the interpreter: all then takes a third longer. What is asked of a task meanwhile waits.
        """
        some = list(islice(wanted, self.started_at_once))
        for slot in some:
            slot.busy = False
            if self.closing:
                continue
            self.start_configured(slot)
            if slot.commands:
                self.go_on(slot)
        if len(some) == self.started_at_once:
            self.call(lambda: self._start_some(wanted))

    def go_on(self, slot: Slot) -> None:
        """For subclasses: what was asked of a task while it was busy may be carried out now."""

    def take_up(self, slot: Slot, kept: Mapping[str, Carried] | None) -> None:
        """Gives a task that has not started yet what it carried before the service was stopped.

        Args:
            slot: the task's place.
            kept: what `keep` returned; None: all tasks are to begin as their configuration says.
        """
        if kept is not None:
            slot.carried = kept.get(slot.name)

    def wants(self, slot: Slot) -> bool:
        """Returns whether a task is to be started with the service."""
        return slot.spec.start

    def start_configured(self, slot: Slot) -> None:
        """Starts a task that is to be started with the service."""
        self.launch(slot)

    def settle(self, slot: Slot) -> None:
        """A task that was to start with the service has come to run, or has not."""
        if slot.name in self._unsettled:
            self._unsettled.discard(slot.name)
            if not self._unsettled:
                self._tell_ready()

    def _tell_ready(self) -> None:
        self._told_ready = True
        if self._on_ready is not None:
            self._on_ready(self)

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        # As OTP does: the tasks of a service that failed end with it, and begin anew with its successor.
        for slot in self.slots.values():
            if slot.task is not None and not slot.task.actor_stopped.is_set():
                slot.task.stop()

    def _start_heard(self, task: Task) -> None:
        """A task runs (in its thread)."""
        self.call(lambda: self._task_started(task))

    def _task_started(self, task: Task) -> None:
        slot = self.slots.get(task.name)
        if slot is None or slot.task is not task or slot.state is not TaskState.STARTING:
            return
        slot.state = TaskState.RUNNING
        slot.supervision.runs(self.kernel.host.now())
        self.event(
            "task_started",
            task=slot.name,
            service=self.name,
            type=slot.spec.type,
            incarnation=slot.incarnation,
            epoch=slot.fence.epoch[0] if slot.fence is not None else None,
        )
        self.settle(slot)
        self.task_running(slot)
        waiting, slot.on_running = slot.on_running, ()
        for then in waiting:
            then("")

    def task_running(self, slot: Slot) -> None:
        """For subclasses: a task has come to run."""

    def task_ended(self, slot: Slot) -> None:
        """For subclasses: a task has ended, and what it carried last is in the slot."""

    def _end_heard(self, task: Component, error: BaseException | None) -> None:
        """A task's actor has ended (in that actor's thread)."""
        if self.actor_stopped.is_set():
            self.kernel.stream.unsubscribe(task.address)
            self.kernel.registry.release(task.address)
            return
        self.call(lambda: self._task_ended(task, error))

    def _task_ended(self, task: Component, error: BaseException | None) -> None:
        slot = self.slots.get(task.name)
        if slot is None or slot.task is not task:
            return
        assert isinstance(task, Task)
        slot.task = None
        slot.carried = task.last or slot.carried
        lost, slot.on_lost = slot.on_lost, ()
        for tell in lost:
            why = f": {describe(error, self.author_of(slot))}" if error is not None else ""
            tell(f"{slot.address} ended before it had done so{why}")
        asked = slot.state in (TaskState.STOPPING, TaskState.STUCK)
        slot.on_stuck = ()
        if error is not None and not asked:
            self._task_failed(slot, error)
            return
        if error is not None:
            failure = self._note_failure(slot, error)
            self.log("warning", f"{slot.address} failed while it stopped: {failure.text}", failure.traceback)
        if asked:
            self._rest(slot, slot.reason)
        else:
            self._decide(slot, failed=False, text="it stopped itself")

    def _task_failed(self, slot: Slot, error: BaseException, hopeless: bool = False) -> None:
        hopeless = hopeless or isinstance(error, ClassError)
        self._decide(slot, failed=True, text=self._note_failure(slot, error).text, hopeless=hopeless)

    def _note_failure(self, slot: Slot, error: BaseException) -> Failure:
        slot.failure = Failure(describe(error, self.author_of(slot)), traceback_of(error), self.now())
        return slot.failure

    def _decide(self, slot: Slot, failed: bool, text: str, hopeless: bool = False) -> None:
        """A task ended unasked: restart it, let it rest, or give up on it."""
        slot.reason = text
        supervision, now_s = slot.supervision, self.kernel.host.now()
        following = supervision.ended(failed, now_s, self.random, hopeless)
        if self.closing:
            supervision.forget()
        restart = following is Next.RESTART and not self.closing
        if restart:
            slot.state = TaskState.RESTARTING
        waiting, slot.on_running = slot.on_running, ()
        traceback = slot.failure.traceback if failed and slot.failure is not None else ""
        if failed:
            self.event("task_failed", task=slot.name, error=text, then=following.value)
        for then in waiting:
            then(f"{slot.address} failed to start: {text}")
        due_s = supervision.due_s
        if due_s is not None:
            self.after_host(due_s - now_s, lambda: self._try_again(slot, due_s))
        if restart:
            self.log("warning", f"{slot.address} is started again {supervision.when(now_s)}: {text}", traceback)
            # The agent is ready without it, and goes on to what can start.
            self.settle(slot)
            return
        if following is Next.GIVE_UP:
            slot.state = TaskState.FAILED
            then_again = "" if due_s is None else f", and tried again {supervision.when(now_s)}"
            spec = supervision.spec
            why = "" if hopeless else f" ({spec.policy}, {spec.at_most} restarts in {spec.within_s:g} s)"
            self.log("error", f"{slot.address} is given up{then_again}: {text}{why}", traceback)
            self.event("task_given_up", task=slot.name, error=text)
            self._let_go(slot)
            self.settle(slot)
            self.task_ended(slot)
            return
        if failed:
            self.log("warning", f"{slot.address} failed as its service stops: {text}", traceback)
        self._rest(slot, text)

    def _try_again(self, slot: Slot, due_s: float) -> None:
        if not self.closing and slot.supervision.take(due_s):
            slot.state = TaskState.STOPPED
            self.relaunch(slot)

    def relaunch(self, slot: Slot) -> None:
        """Starts a task again that has failed."""
        self.launch(slot)

    def _rest(self, slot: Slot, reason: str) -> None:
        slot.state = TaskState.STOPPED
        self._let_go(slot)
        self.event("task_stopped", task=slot.name, service=self.name, reason=reason)
        unstarted, slot.on_running = slot.on_running, ()
        for then_not in unstarted:
            then_not(f"{slot.address} was stopped before it ran: {reason}")
        self.settle(slot)
        self.task_ended(slot)
        waiting, slot.on_ended = slot.on_ended, ()
        for then in waiting:
            then()

    def _let_go(self, slot: Slot) -> None:
        """Takes back what a task held, once it has ended."""
        self.kernel.stream.unsubscribe(slot.address)
        self.hold_actuators(slot, f"{slot.name} let go of it")
        self.kernel.registry.release(slot.address)

    def hold_actuators(self, slot: Slot, reason: str) -> None:
        """Brings the actuators that a task holds to their safe hold."""
        for device in self.kernel.registry.held_by(slot.address):
            self.publish(CTRL, Hold(reason), to=self.kernel.registry.address_of(device))


@lru_cache(maxsize=256)
def _schema_of(cls: type) -> dict[str, Any]:
    """As `schema_of`, which takes milliseconds, once for each class: pages ask again and again. Not to be changed."""
    return schema_of(cls)
