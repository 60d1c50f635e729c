"""The inside of a service: the lives of its tasks, and the commands that it carries out (paper §3.3, §3.4).

`ServiceCore` is the private object of a `pancakes.service.Service`. Each of its tasks has a life
(`pancakes.supervision.lifecycle`), which this actor feeds with events and whose effects it carries out. Control packets
reach it as commands, one at a time and numbered. A service of Pancakes' own that needs the inside derives from
`ServiceCore` and `Service`, and is its own core.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

from pancakes.control import Command, Describe, Hold, Refusal
from pancakes.errors import (
    ClassError,
    ControlRefusedError,
    MissingExtraError,
    NoPermitError,
    PancakesError,
    describe,
    traceback_of,
)
from pancakes.kernel.actor import ActorCore, core_of
from pancakes.kernel.handlers import on
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import Mailbox, Reference, tell
from pancakes.kernel.registry import TaskEntry
from pancakes.packet import CTRL, SYSCTRL, Packet, join
from pancakes.settings import SettingsError, make_settings
from pancakes.supervision.lifecycle import (
    CLOSES,
    Admitted,
    Answer,
    Began,
    Finished,
    LeaveRefused,
    Life,
    Overdue,
    Request,
    StartAsked,
    State,
    Tell,
    Written,
    request_of,
)
from pancakes.supervision.messages import (
    Carried,
    Changed,
    Close,
    Looked,
    ServiceEnded,
    ServiceReady,
    TakeClasses,
    TaskBegan,
    TaskEnded,
    TryClasses,
)
from pancakes.supervision.restart import Restarts
from pancakes.supervision.slots import (
    CHANGES,
    COMMANDS,
    STARTED_AT_ONCE,
    STUCK_S,
    WAITING,
    Closing,
    Failure,
    Slot,
    Startup,
    describe_in_detail,
    describe_task,
    tell_of_task,
)
from pancakes.supervision.supervisor import Answers, Keeper
from pancakes.task import TaskSpec

if TYPE_CHECKING:
    from pancakes.service import Service
    from pancakes.supervision.reloads import Reloads


class ServiceCore(ActorCore):
    """Runs one service.

    Args:
        kernel: the kernel.
        address: `agent/service`.
        mailbox: its mailbox; None: one of its own.
        facade: the user's object; None: itself.
        settings: its settings, as plain values.
        tasks: the tasks of the configuration.
        owner: hears when it is ready, and when it has ended; None: nothing does.
        kept: what its tasks carried when it was stopped, by their names; None: all begin as configured.

    Attributes:
        slots: its tasks, by name.
        closing: whether it ends, and starts nothing any more.
        keeps_changes: whether `changed` wants to know what a task carries after a change.
        started_at_once: how many of its tasks it starts in one turn, at most.
    """

    keeps_changes: ClassVar[bool] = False
    started_at_once: ClassVar[int] = STARTED_AT_ONCE
    facade: Service

    def __init__(
        self,
        kernel: Kernel,
        address: str,
        mailbox: Mailbox | None = None,
        *,
        facade: Service | None = None,
        settings: Mapping[str, Any] | None = None,
        tasks: Sequence[TaskSpec] = (),
        owner: Reference | None = None,
        kept: Mapping[str, Carried] | None = MappingProxyType({}),
    ) -> None:
        super().__init__(kernel, address, mailbox, facade=facade)
        service = self.facade
        service.settings = make_settings(service.Settings, settings or {}, owner=self.name)
        self.slots: dict[str, Slot] = {}
        self.closing = False
        self._configured = tuple(tasks)
        self._owner = owner
        self._kept = kept
        self.keeper: Keeper[Slot] = Keeper(self, self)
        self._answers = Answers(self)
        self._newest_command = 0
        self._startup = Startup(self, self.started_at_once, self._start, self._tell_ready)
        self._closing = Closing(self, self.feed, self.let_go, self.settle_all)
        self._reloads_made: Reloads | None = None

    # For subclasses --------------------------------------------------------------------------------------------

    def specs(self) -> Sequence[TaskSpec]:
        """Return all tasks that have a place from the start on; called once."""
        return (*self.facade.own_tasks(), *self._configured)

    def admit(self, slot: Slot) -> str:
        """Say why a task must not be started now; empty: it may."""
        lacking = self.kernel.registry.lacking(slot.spec.cls.requires)
        if lacking:
            return f"{self.agent} lacks the device types {', '.join(lacking)}, which {slot.name} requires"
        return ""

    def refuse_start(self, slot: Slot) -> str:
        """Say why a start of a task would fail now, as far as that is known beforehand; empty: for no reason."""
        reason = self.admit(slot)
        registry = self.kernel.registry
        for device in registry.devices():
            if not reason and device.actuator and device.type in slot.spec.cls.requires:
                reason = registry.taken(device.name, slot.address)
        if not reason and (loan := registry.waits_for(slot.address)) is not None:
            reason = loan.why  # once it has ended, it no longer holds the actuator
        return reason

    def refuse_reload(self, slot: Slot) -> None:
        """Raise `ControlRefusedError` if a task cannot go on in a new class now, whatever that class is."""

    def set_settings(self, slot: Slot, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return those settings of a task that were set, by its configuration or since, and are not defaults."""
        from pancakes.durable.checkpoints import set_of  # which knows of services

        return set_of(slot.spec, settings)

    def arguments_of(self, slot: Slot) -> Mapping[str, Any]:
        """Return what a task's class wants besides what every task gets."""
        return slot.spec.arguments

    def author_of(self, slot: Slot) -> type:
        """Return the class of which a task's author would say that it is theirs; see `ActorCore.author_class`."""
        return slot.spec.cls

    def settings_class(self, slot: Slot) -> type:
        """Return the dataclass of a task's settings."""
        return slot.spec.cls.Settings

    def carried_of(self, slot: Slot) -> Carried:
        """Return what a task that does not run would begin with."""
        return slot.carried or Carried(slot.spec.settings, {})

    def drop_state(self, slot: Slot) -> None:
        """Forget what a task carried: it begins as the configuration says."""
        slot.carried = None

    def describe_in_detail(self, slot: Slot) -> dict[str, Any]:
        """Return all that is known about a task, its settings among it, as plain values."""
        described = describe_in_detail(self.kernel, slot, self.settings_class(slot), self.carried_of(slot))
        return {**describe_task(self.kernel, TaskEntry.of(self.name, slot)), **described}

    def take_up(self, slot: Slot, kept: Mapping[str, Carried] | None) -> None:
        """Give a task that has not started yet what it carried before the service was stopped.

        Args:
            slot: the task's place.
            kept: what `keep` returned; None: all tasks begin as their configuration says.
        """
        if kept is not None:
            slot.carried = kept.get(slot.name)

    def keep(self) -> Mapping[str, Carried]:
        """Return what its tasks carried last, by their names, for the next start of the service. Once it has ended."""
        return {name: slot.carried for name, slot in self.slots.items() if slot.carried is not None}

    def wants(self, slot: Slot) -> bool:
        """Return whether a task starts with the service."""
        return slot.spec.start

    def start_configured(self, slot: Slot) -> None:
        """Start a task with the service."""
        self.feed(slot, StartAsked())

    def task_running(self, slot: Slot) -> None:
        """A task has come to run."""

    def changed(self, slot: Slot, carried: Carried) -> None:
        """A running task was changed; `carried` is what it carries now."""

    def command_waits(self, slot: Slot, request: Request) -> None:
        """A command begins to start or stop a task, or waits behind one that does."""

    def settle_all(self) -> None:
        """All tasks have ended; calls `end_at_last`, once, when nothing is under way that must be finished."""
        self.end_at_last()

    # Its own life ----------------------------------------------------------------------------------------------

    def after_start(self) -> None:
        for spec in self.specs():
            self.take_up(self.open_slot(spec), self._kept)
        self.log("debug", f"{self.address} started with {', '.join(self.slots) or 'no tasks'}")
        self._startup.begin([slot for slot in self.slots.values() if self.wants(slot)])

    def open_slot(self, spec: TaskSpec) -> Slot:
        """Make the place for a task, without starting it.

        Raises:
            ControlRefusedError: the service has a task of this name.
        """
        if spec.name in self.slots:
            raise ControlRefusedError(f"{self.address} already has a task {spec.name}")
        address = join(self.agent, self.name, spec.name)
        slot = self.slots[spec.name] = Slot(spec.name, spec, address, Life(address, Restarts(spec.restart)))
        self.show(slot)
        return slot

    def _start(self, slot: Slot) -> None:
        if not self.closing:
            self.start_configured(slot)
        if slot.commands:
            self.call(partial(self._next_command, slot))

    def _tell_ready(self) -> None:
        if self._owner is not None:
            tell(self._owner, ServiceReady(self))

    def close(self, for_s: float | None = None) -> None:
        """Stop all tasks, last first, then the service itself.

        Args:
            for_s: after how many seconds of mission time it will be started again; None: it will not by itself.
        """
        self.closing = True
        self._closing.begin(self.slots.values())

    def end_at_last(self) -> None:
        """End this actor, now that all of its tasks have ended."""
        self._refuse_all(f"{self.address} was stopped before it came to that")
        self.stop()

    def end_actor(self, error: BaseException | None) -> None:
        if error is not None:
            # As OTP does: the tasks of a service that failed end with it, and begin again with its successor.
            for slot in self.slots.values():
                if slot.task is not None:
                    slot.task.stop()
            self._refuse_all(f"{self.address} failed before it had done that: {describe(error, self.author_class)}")
        super().end_actor(error)
        self.kernel.tasks.strike_out(self.name)
        if self._owner is None:
            return
        kept: Mapping[str, Carried] = {}
        if error is None:
            try:
                kept = self.keep()
            except Exception as failure:  # what a service's author wrote may raise anything
                self.kernel.log("error", f"what the tasks of {self.address} carried is lost: {describe(failure)}")
        tell(self._owner, ServiceEnded(self, error, kept, self._unheard()))

    def _unheard(self) -> tuple[Request, ...]:
        """Return the commands that it has not answered, and forget them."""
        queue = self.actor_inbox.queues.get(SYSCTRL)
        left = self._answers.forget_all()
        for packet in queue.drain() if queue is not None else ():
            command = packet.body
            # The one that it failed on lies here again.
            if isinstance(command, Command) and command.body is not None and command.number > self._newest_command:
                left.append(request_of(command))
        return tuple(left)

    def _refuse_all(self, reason: str) -> None:
        """Tell the senders of all requests that wait that they are not done, as the service ends."""
        for slot in self.slots.values():
            slot.commands = ()
        self._answers.refuse_all(reason)

    # What its tasks' actors tell -------------------------------------------------------------------------------

    def take_message(self, message: Any) -> Any:
        match message:
            case TaskBegan():
                slot = self.slots.get(message.task.name)
                if slot is not None and slot.task is message.task:
                    self.feed(slot, Began())
            case TaskEnded():
                self._task_ended(message if self._reloads_made is None else self._reloads_made.ended(message))
            case Changed():
                self._task_changed(message)
            case Close():
                self.close(message.for_s)
            case Looked():
                if self._reloads_made is not None:
                    self._reloads_made.looked(message)
            case TryClasses():
                self._reloads().attempt(message)
            case TakeClasses():
                self._reloads().take(message)
            case _:
                return super().take_message(message)
        return None

    def _reloads(self) -> Reloads:
        if self._reloads_made is None:
            from pancakes.supervision.reloads import Reloads  # few services are ever asked

            self._reloads_made = Reloads(self)
        return self._reloads_made

    def _task_ended(self, ended: TaskEnded) -> None:
        slot = self.slots.get(ended.task.name)
        if slot is None or slot.task is not ended.task:
            return
        error = ended.error
        slot.task = None
        slot.carried = ended.last or slot.carried
        lost, slot.changing = slot.changing, ()
        why = f": {describe(error, self.author_of(slot))}" if error is not None else ""
        for request in lost:
            self.reply(request, Refusal("failed", f"{slot.address} ended before it had done so{why}"))
        if error is not None:
            self._fail(slot, error)
        else:
            self.feed(slot, Finished("it stopped itself", closing=self.closing))

    def _fail(self, slot: Slot, error: BaseException, hopeless: bool = False) -> None:
        hopeless = hopeless or isinstance(error, (ClassError, MissingExtraError))
        blameless = isinstance(error, NoPermitError)
        slot.failure = Failure(describe(error, self.author_of(slot)), traceback_of(error), self.now())
        self.feed(slot, Finished(slot.failure.text, True, hopeless, self.closing, blameless))

    def _task_changed(self, changed: Changed) -> None:
        slot = self.slots.get(changed.task.name)
        if slot is None or slot.task is not changed.task:
            return
        request, body = changed.change.request, changed.change.body
        slot.changing = tuple(other for other in slot.changing if other != request)
        if changed.refusal is not None:
            self.reply(request, changed.refusal, changed.result or None)
            return
        result = changed.result
        if isinstance(body, Describe):
            result = {**self.describe_in_detail(slot), **result}
        elif not body.dry_run:
            told = {"service": self.name, "by": request.by, "number": request.number, **result}
            self.event(CHANGES[type(body)], task=slot.name, **told)
        if changed.carried is not None:
            self.changed(slot, changed.carried)
        self.reply(request, result=result)

    # What the lives of its tasks ask for -----------------------------------------------------------------------

    def feed(self, slot: Slot, event: Any) -> None:
        """Feed an event to the life of a task, and carry out what follows."""
        self.keeper.feed(slot, event)

    def show(self, slot: Slot) -> None:
        self.kernel.tasks.enter(TaskEntry.of(self.name, slot))

    def ask_leave(self, slot: Slot) -> None:
        """See whether a task may start, and feed `Admitted` or `LeaveRefused`."""
        if slot.fresh:
            slot.fresh = False
            self.drop_state(slot)
        reason = CLOSES if self.closing else self.admit(slot)
        reason = reason or self.kernel.registry.hold(slot.address, slot.spec.cls.requires)
        self.feed(slot, LeaveRefused(reason) if reason else Admitted())

    def spawn(self, slot: Slot) -> None:
        try:
            task = self.kernel.spawn(
                slot.spec.cls,
                slot.address,
                mailbox=slot.mailbox,
                carried=slot.carried or Carried(slot.spec.settings, {}),
                rate_hz=slot.spec.rate_hz,
                fence=slot.fence,
                owner=self,
                keeps_subscriptions=True,  # this service knows whether a successor will read what they bring
                **self.arguments_of(slot),
            )
            slot.task = core_of(task)
        except (Exception, SystemExit) as error:  # what a task's author wrote in __init__ may raise anything
            self.kernel.tasks.note_settings(slot.address, None)
            self._fail(slot, error, hopeless=isinstance(error, SettingsError))

    def halt(self, slot: Slot) -> None:
        if slot.task is not None:
            slot.task.stop()
        overdue = Overdue(slot.life.incarnation)
        self.after_host(STUCK_S, lambda: self.feed(slot, overdue))

    def revoke_rights(self, slot: Slot) -> None:
        if slot.task is not None:
            slot.task.revoke()
        self.hold_actuators(slot, f"{slot.name} is stuck")

    def let_go(self, slot: Slot) -> None:
        """Take back what a task held, once it has ended."""
        self.kernel.stream.unsubscribe(slot.address)
        self.hold_actuators(slot, f"{slot.name} let go of it")
        self.kernel.registry.release(slot.address)

    def hold_actuators(self, slot: Slot, reason: str) -> None:
        """Bring the actuators that a task holds to their safe hold."""
        for device in self.kernel.registry.held_by(slot.address):
            self.publish(CTRL, Hold(reason), to=self.kernel.registry.address_of(device))

    def settle(self, slot: Slot) -> None:
        """The start of a task is decided: it runs, or does not."""
        self._startup.settled(slot)
        if slot.life.state is State.RUNNING:
            self.task_running(slot)

    def write_rest(self, slot: Slot) -> None:
        """A task has come to rest: feeds `Written` once that will last."""
        self.feed(slot, Written())
        self.rested(slot)

    def rested(self, slot: Slot) -> None:
        """A task has come to rest: if the service ends, the next one's turn has come."""
        self._closing.rested(slot)

    def answer(self, slot: Slot, effect: Answer) -> None:
        """Answer a request to start or stop a task; the commands that wait behind it go on."""
        if self._reloads_made is None or not self._reloads_made.answered(slot, effect):
            self.reply(effect.asker, Refusal.if_any(effect.reason))
        self.call(lambda: self._next_command(slot))

    def tell_news(self, slot: Slot, effect: Tell) -> None:
        """Tell `log` what has happened to a task."""
        tell_of_task(self, slot, effect)

    # Commands --------------------------------------------------------------------------------------------------

    @on(SYSCTRL, Command, queue=WAITING, addressed=True)
    def on_command(self, packet: Packet) -> None:
        """Carry out one command and answer it."""
        command: Command = packet.body
        if command.body is None:
            self.close(command.for_s)
            return
        request = request_of(command)
        self._newest_command = request.number
        self._answers.owe(request)
        slot = self.slots.get(command.task) if command.task else None
        if slot is not None and (slot.commands or self._is_busy(slot)) and not isinstance(command.body, Describe):
            # One after the other, so that the last of several that contradict each other is the one that holds.
            slot.commands = (*slot.commands, command)
            self.command_waits(slot, request)
            return
        self.begin_command(command, request)

    def _is_busy(self, slot: Slot) -> bool:
        return slot.life.asker is not None or self._startup.is_to_start(slot)

    def begin_command(self, command: Command, request: Request) -> None:
        """Carry out one command whose turn has come, and answer it if that fails."""
        try:
            slot = self._slot(command.task) if command.task else None
            self.carry_out_command(command.body, slot, request)
        except (PancakesError, ValueError) as error:
            self.reply(request, Refusal.of(error))

    def _next_command(self, slot: Slot) -> None:
        while slot.commands and not self._is_busy(slot):
            command, slot.commands = slot.commands[0], slot.commands[1:]
            self.begin_command(command, request_of(command))

    def _slot(self, name: str) -> Slot:
        slot = self.slots.get(name)
        if slot is None:
            known = f"only {', '.join(self.slots)}" if self.slots else "nor any other"
            raise ControlRefusedError(f"{self.address} has no task {name!r}, {known}", "not_found")
        return slot

    def carry_out_command(self, body: Any, slot: Slot | None, request: Request) -> None:
        """Do what a command asks, and see that it is answered; subclasses add their own.

        Args:
            body: the control packet's body.
            slot: the task that it is about; None: the service itself.
            request: what to answer.

        Raises:
            ControlRefusedError: it cannot be done; becomes the answer.
        """
        asked_for = type(body).__name__.lower()
        if slot is not None:
            command = COMMANDS.get(type(body))
            if command is None:
                raise ControlRefusedError(f"{slot.address} cannot be asked for {asked_for}", "unsupported")
            command(self, slot, body, request)
        elif isinstance(body, Describe):
            self.reply(request, result=[describe_task(self.kernel, task) for task in self.kernel.tasks.of(self.name)])
        else:
            raise ControlRefusedError(f"{self.address} is a service and cannot be asked for {asked_for}", "unsupported")

    def reply(self, request: Request, refusal: Refusal | None = None, result: Any = None) -> None:
        """Answer the sender of a request; without a refusal, it has been done."""
        self._answers.give(request, refusal, result)

    def put_off(self, request: Request, reason: str) -> None:
        """Tell the sender of a request what it waits for; what becomes of it in the end is said on `log`."""
        self._answers.put_off(request, reason)

    def waits(self, request: Request) -> bool:
        """Return whether the sender of a request has not been told yet what becomes of it."""
        return self._answers.waits(request)

    def tell_asked(self, what: str, task: str, request: Request) -> None:
        """Tell `log` what was asked for."""
        self.event("asked", what=what, task=task, service=self.name, by=request.by, number=request.number)
