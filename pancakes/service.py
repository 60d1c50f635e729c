"""Services: they look after tasks, and do what control packets ask of them (paper §3.3, §3.4)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final

import msgspec
from msgspec.structs import replace

from pancakes.answers import Answers
from pancakes.control import (
    Adopt,
    Command,
    Configure,
    Describe,
    Forget,
    Migrate,
    Reschedule,
    Restart,
    Start,
    Stop,
)
from pancakes.errors import ControlRefused, PancakesError, describe
from pancakes.kernel.handlers import on
from pancakes.kernel.keep import reliable
from pancakes.packet import SYSCTRL, Packet
from pancakes.settings import change_plain, change_settings
from pancakes.slot import Request, Slot, TaskState
from pancakes.supervision import RestartSpec
from pancakes.supervisor import Supervisor
from pancakes.task import Task, TaskSpec


class ServiceSpec(msgspec.Struct, frozen=True):
    """All that the kernel's root needs to start a service, as data.

    Attributes:
        name: its name.
        cls: its class.
        settings: its settings, as plain values.
        tasks: its tasks, in the order in which they start.
        restart: what happens when it ends by itself.
        arguments: what else its class wants.
    """

    name: str
    cls: type[Service]
    settings: Mapping[str, Any] = msgspec.field(default_factory=dict)
    tasks: tuple[TaskSpec, ...] = ()
    restart: RestartSpec = RestartSpec()
    arguments: Mapping[str, Any] = msgspec.field(default_factory=dict)


WAITING: Final = reliable(1024)
"""So many control packets of each type wait where they come in faster than they can be carried out. Whoever sends one
more is refused, and told so: none may be lost without a word."""


class Service(Supervisor):
    """The base of all services.

    A service of one's own subclasses it, may bring tasks of its own (`own_tasks`), and is named in the entry point
    group `pancakes.services`. Control packets reach it as commands, one at a time and numbered.

    Attributes:
        only_name: the one name that it can have in a configuration, for a service that an agent can have only once;
            empty: it may be there several times, under any names.
    """

    only_name: ClassVar[str] = ""

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        self._answers = Answers(self)
        self._newest_command = 0

    @on(SYSCTRL, Command, keep=WAITING, addressed=True)
    def on_command(self, packet: Packet) -> None:
        """Carries out one command and answers it."""
        command: Command = packet.body
        if command.body is None:
            self.close(lambda: None)
            return
        request = _request(command)
        self._newest_command = request.number
        self._answers.owe(request)
        slot = self.slots.get(command.task) if command.task else None
        if slot is not None and (slot.busy or slot.commands) and not isinstance(command.body, Describe):
            # One after the other, so that the last of several that contradict each other is the one that holds.
            slot.commands = (*slot.commands, lambda: self._begin_command(command, request))
            self.command_waits(slot, request)
            return
        self._begin_command(command, request)

    def _begin_command(self, command: Command, request: Request) -> None:
        try:
            slot = self._slot(command.task) if command.task else None
            self.carry_out_command(command.body, slot, request)
        except (PancakesError, ValueError) as error:
            self.reply(request, str(error))

    def go_on(self, slot: Slot) -> None:
        self.call(lambda: self._next_command(slot))

    def _next_command(self, slot: Slot) -> None:
        while slot.commands and not slot.busy:
            following, *later = slot.commands
            slot.commands = tuple(later)
            following()

    def reply(self, request: Request, reason: str = "", result: Any = None) -> None:
        """Answers whoever asked; an empty reason means that it has been done."""
        self._answers.give(request, reason, result)

    def put_off(self, request: Request, reason: str) -> None:
        """Tells the asker what a command waits for; what becomes of it in the end is said on `log`."""
        self._answers.put_off(request, reason)

    def waits(self, request: Request) -> bool:
        """Returns whether the asker has not been told yet what becomes of a command."""
        return self._answers.waits(request)

    def command_waits(self, slot: Slot, request: Request) -> None:
        """For subclasses: a command begins to start or stop a task, or waits behind one that does."""

    def close(self, then: Callable[[], None]) -> None:
        def answered() -> None:
            self._answer_all(f"{self.address} was stopped before it came to that")
            then()

        super().close(answered)

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        super().on_failure(exception_type, exception_value, traceback)
        self._answer_all(f"{self.address} failed before it had done that: {describe(exception_value, type(self))}")

    def unheard(self) -> list[Request]:
        """Returns, once it has ended, the commands that it has not answered, and forgets them."""
        queue = self.actor_inbox.queues.get(SYSCTRL)
        left = self._answers.forget_all()
        while queue is not None and (packet := queue.take()) is not None:
            command = packet.body
            # The one that it failed on lies here again.
            if isinstance(command, Command) and command.body is not None and command.number > self._newest_command:
                left.append(_request(command))
        return left

    def _answer_all(self, reason: str) -> None:
        """Tells everybody who still waits for an answer that there will be none, as the service ends."""
        for slot in self.slots.values():
            slot.commands = ()
        self._answers.refuse_all(reason)

    def _slot(self, name: str) -> Slot:
        slot = self.slots.get(name)
        if slot is None:
            known = f"only {', '.join(self.slots)}" if self.slots else "nor any other"
            raise ControlRefused(f"{self.address} has no task {name!r}, {known}")
        return slot

    def carry_out_command(self, body: Any, slot: Slot | None, request: Request) -> None:
        """Does what a command asks, and sees that it is answered; subclasses add their own.

        Args:
            body: the control packet's body.
            slot: the task that it is about; None: the service itself.
            request: whom to answer.

        Raises:
            ControlRefused: it cannot be done; becomes the answer.
        """
        if slot is None:
            if not isinstance(body, Describe):
                raise ControlRefused(
                    f"{self.address} is a service and cannot be asked for {type(body).__name__.lower()}"
                )
            self.reply(request, result=[self.describe_task(other) for other in self.slots.values()])
        elif isinstance(body, Start):
            self.start_asked(slot, body, request)
        elif isinstance(body, Stop):
            if body.for_s is not None:
                raise ControlRefused(f"{slot.address} is a task: only a service can be stopped for a time")
            self.stop_asked(slot, body, request)
        elif isinstance(body, Restart):
            self.restart_asked(slot, body, request)
        elif isinstance(body, Reschedule):
            self.reschedule_asked(slot, body, request)
        elif isinstance(body, Configure):
            self.configure_asked(slot, body, request)
        elif isinstance(body, Describe):
            self._describe_asked(slot, body, request)
        elif isinstance(body, (Migrate, Adopt, Forget)):
            raise ControlRefused(f"{slot.address} cannot move: what {self.address} looks after stays with its agent")
        else:
            raise ControlRefused(f"{slot.address} cannot be asked for {type(body).__name__.lower()}")

    def start_asked(self, slot: Slot, body: Start, request: Request) -> None:
        """Starts a task; the answer comes once it runs."""
        if slot.state not in (TaskState.STOPPED, TaskState.FAILED, TaskState.RESTARTING):
            raise ControlRefused(f"{slot.address} is {slot.state.value} already")
        carried = self.carried_of(slot)
        if body.settings is not None:
            change_plain(self.settings_class(slot), carried.settings, body.settings, slot.name)
            carried = replace(carried, settings={**carried.settings, **body.settings})
        if body.dry_run:
            self.reply(request, self.refuse_start(slot))
            return
        if slot.supervision.due_s is not None and (reason := self.refuse_start(slot)):
            raise ControlRefused(reason)  # its next try stays due
        answer = self._occupy(slot, request)

        def begin() -> None:
            if body.settings is not None:
                slot.carried = carried
            slot.supervision.forget()
            self.start_anew(slot, answer)

        self.tell_asked("start", slot, request)
        if slot.supervision.due_s is None:
            begin()
        else:
            self.halt(slot, begin, f"start asked for by {request.by}")

    def stop_asked(self, slot: Slot, body: Stop, request: Request) -> None:
        """Stops a task; the answer comes once it has ended."""
        if slot.state is TaskState.STOPPED:
            raise ControlRefused(f"{slot.address} is stopped already")
        if body.dry_run:
            self.reply(request)
            return
        self.tell_asked("stop", slot, request)
        answer = self._occupy(slot, request)
        self.halt(slot, lambda: self.when_stopped(slot, answer), f"asked for by {request.by}", answer)

    def when_stopped(self, slot: Slot, then: Callable[[str], None]) -> None:
        """For subclasses: calls `then` once a stop that was asked for will last; with a reason where it may not."""
        then("")

    def _occupy(self, slot: Slot, request: Request) -> Callable[[str], None]:
        """Lets all later commands for a task wait for this one.

        Returns:
            What answers it and lets the others go on; at its first call only, for a stuck task may end after all.
        """
        slot.busy = True
        answered = False
        self.command_waits(slot, request)

        def answer(reason: str) -> None:
            nonlocal answered
            if answered:
                return
            answered = True
            self.reply(request, reason)
            slot.busy = False
            self.go_on(slot)

        return answer

    def restart_asked(self, slot: Slot, body: Restart, request: Request) -> None:
        """Stops a task, if it runs, and starts it; the answer comes once it runs."""
        if body.dry_run:
            self.reply(request, self.refuse_start(slot))
            return
        answer = self._occupy(slot, request)

        def again() -> None:
            if not body.keep_state:
                self.drop_state(slot)
            slot.supervision.forget()
            self.start_anew(slot, answer)

        self.tell_asked("restart", slot, request)
        self.halt(slot, again, f"restart asked for by {request.by}", answer)

    def drop_state(self, slot: Slot) -> None:
        """Forgets what a task carried: it begins as the configuration says."""
        slot.carried = None

    def start_anew(self, slot: Slot, then: Callable[[str], None]) -> None:
        """Starts a task because somebody asked for it; `then` is told an empty string, or why not."""
        self.launch(slot, then)

    def reschedule_asked(self, slot: Slot, body: Reschedule, request: Request) -> None:
        """Changes a task's rate; the answer comes once it has taken effect."""

        def change(task: Task) -> dict[str, Any]:
            timer = task.timer_of(body.rate_hz, body.timer)
            before_hz = timer.rate_hz
            if not body.dry_run:
                task.reschedule(body.rate_hz, body.timer)
            return {"timer": timer.method, "rate_hz": body.rate_hz, "before_hz": before_hz}

        self.in_task(slot, request, "" if body.dry_run else "rate_changed", change)

    def configure_asked(self, slot: Slot, body: Configure, request: Request) -> None:
        """Changes a running task's settings; the answer comes once they have taken effect."""

        def change(task: Task) -> dict[str, Any]:
            if body.dry_run:
                change_settings(task.settings, body.settings, slot.name)
            else:
                task.change_settings(body.settings)
            return {"settings": dict(body.settings)}

        self.in_task(slot, request, "" if body.dry_run else "settings_changed", change)

    def _describe_asked(self, slot: Slot, body: Describe, request: Request) -> None:
        detail = self.describe_in_detail(slot)
        if body.state or body.began:
            self.in_task(slot, request, "", lambda task: with_state(detail, task, body))
        else:
            self.reply(request, result=detail)

    def in_task(self, slot: Slot, request: Request, kind: str, change: Callable[[Task], dict[str, Any]]) -> None:
        """Makes a change in a running task's own actor, then tells `log` and whoever asked.

        Args:
            slot: the task.
            request: whom to answer.
            kind: the event on `log`; empty where nothing was changed.
            change: makes the change, and returns what is to be told of it.

        Raises:
            ControlRefused: the task does not run.
        """
        task = slot.task
        if task is None or slot.state is not TaskState.RUNNING:
            raise ControlRefused(f"{slot.address} is {slot.state.value}, not running")

        def refuse(reason: str) -> None:
            self.reply(request, reason)

        def no_longer_lost() -> None:
            slot.on_lost = tuple(tell for tell in slot.on_lost if tell is not refuse)

        def make() -> None:
            try:
                told = change(task)
            except (PancakesError, ValueError, TypeError) as error:  # TypeError: what cannot be saved
                reason = str(error)
                self.call(lambda: told_off(reason))
                return
            self.call(lambda: done(told))

        def told_off(reason: str) -> None:
            no_longer_lost()
            refuse(reason)

        def done(told: dict[str, Any]) -> None:
            no_longer_lost()
            self._changed(slot, request, kind, told)

        slot.on_lost = (*slot.on_lost, refuse)
        task.call(make)

    def _changed(self, slot: Slot, request: Request, kind: str, told: dict[str, Any]) -> None:
        if kind:
            self.event(kind, task=slot.name, service=self.name, by=request.by, number=request.number, **told)
        self.reply(request, result=told)

    def tell_asked(self, what: str, slot: Slot, request: Request) -> None:
        self.event("asked", what=what, task=slot.name, service=self.name, by=request.by, number=request.number)


def with_state(detail: Mapping[str, Any], task: Task, asked: Describe) -> dict[str, Any]:
    """Returns what `describe_in_detail` says of a task, and its states as far as they are asked for. In its actor.

    Raises:
        ControlRefused: what it keeps in its state cannot be written down.
    """
    told = {**detail, "began": task.began()} if asked.began else dict(detail)
    if not asked.state:
        return told
    try:
        carried = task.carry()
    except Exception as error:  # what a task keeps in its state may be anything
        raise ControlRefused(f"the state of {task.address} cannot be written down: {error}") from None
    now = {"host_s": task.kernel.host.now(), "mission_s": task.now()}
    return {**told, **now, "settings": carried.settings, "state": carried.state}


def _request(command: Command) -> Request:
    return Request(command.request[0], command.request, command.number)
