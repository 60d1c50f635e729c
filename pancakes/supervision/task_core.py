"""The inside of a task: what it carries, how it is frozen and changed, and what it tells its service.

`TaskCore` is the private object of a `pancakes.task.Task`. It carries settings, state and rates from one actor to the
next, and answers what the task's service asks for (`pancakes.supervision.messages`). A task of Pancakes' own that needs
the inside derives from `TaskCore` and `Task`, and is its own core.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec.structs import replace

from pancakes.control import Configure, Describe, Refusal, Reschedule, SetFence
from pancakes.durable.delivery import Incoming
from pancakes.errors import ControlRefusedError, PancakesError
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.handlers import checked_period, period_of
from pancakes.kernel.mailbox import ASK_TYPE, REQUEST_TYPES, Mailbox, Reference, Told, Urgent, tell
from pancakes.kernel.registry import SettingsNote
from pancakes.packet import Fence, Packet
from pancakes.settings import SettingsError, change_settings, make_settings, plain_settings, why_unreadable
from pancakes.supervision.messages import (
    Carried,
    Changed,
    ChangeTask,
    Give,
    GoOn,
    HasNoPermit,
    LetterGiven,
    LetterOutcome,
    LoanChanged,
    Look,
    Looked,
    RequestDue,
    StandStill,
    Stood,
    TaskBegan,
    TaskEnded,
)

if TYPE_CHECKING:
    from pancakes.kernel.kernel import Kernel
    from pancakes.supervision.requests import Requests
    from pancakes.task import Task


@dataclass
class Nothing:
    """Settings or state of a component that has none."""


NONE: Final[Mapping[str, Any]] = MappingProxyType({})
"""One empty table for all that have none."""


class TaskCore(ActorCore):
    """Runs one task.

    Args:
        kernel: the kernel it belongs to.
        address: its address.
        mailbox: the mailbox of its slot; None: one of its own.
        facade: the user's object; None: itself.
        carried: what its predecessor carried; None: it begins with defaults.
        rate_hz: the rate of its first timer; None: what the class says.
        fence: the right under which it speaks; None: it needs none.
        owner: its service, which hears of it; None: nothing does.
        tells_each_turn: whether its service hears what it carries after each turn.
    """

    facade: Task[Any, Any]

    def __init__(
        self,
        kernel: Kernel,
        address: str,
        mailbox: Mailbox | None = None,
        *,
        facade: Task | None = None,
        carried: Carried | None = None,
        rate_hz: float | None = None,
        fence: Fence | None = None,
        owner: Reference | None = None,
        tells_each_turn: bool = False,
    ) -> None:
        super().__init__(kernel, address, mailbox, facade=facade)
        task = self.facade
        carried = carried or Carried(NONE, NONE)
        self.keep_settings(make_settings(task.Settings, carried.settings, owner=self.name))
        task.state = make_settings(task.State, carried.state, allow_nan=True, owner=self.name, noun="state")
        self.__heard = Incoming(carried.heard)
        self.__rate_hz = rate_hz
        self.fence = fence
        self.__owner = owner
        if tells_each_turn:
            self.after_turn = self.__look
        # A copy: what the state has lists in may share them.
        self.__carried_state = copy.deepcopy(carried.state) if carried.state else {}
        self.__carried = carried
        self.__began_s = (0.0, 0.0)
        self.__requests: Requests | None = None
        self.__has_begun = False
        self.is_revoked = False

    def keep_settings(self, settings: Any) -> None:
        """Take an instance of the task's `Settings` in the place of the one before."""
        self.kept_settings = settings
        self.kernel.tasks.note_settings(self.address, SettingsNote(settings))

    def initial_period_s(self, method: str, period_s: float) -> float:
        carried_s = self.__carried.periods_s.get(method)
        if carried_s is not None:
            return checked_period(carried_s)  # it may come from another agent
        return period_of(self.__rate_hz) if self.__rate_hz is not None and not self.timers else period_s

    def acts(self) -> bool:
        # A guarded task that does not know whether another agent runs it is paused until its service tells it.
        permits = self.kernel.permits
        if not permits.by_task or permits.may_act(self.fence):
            return True
        if not self.is_frozen:
            self.freeze()
            self.__tell(HasNoPermit(self))
        return False

    def revoke(self) -> None:
        self.is_revoked = True
        super().revoke()

    @property
    def requests(self) -> Requests:
        """Its open requests. In the actor."""
        if self.__requests is None:
            from pancakes.supervision.requests import Requests  # few tasks ever ask, or are asked

            self.__requests = Requests(self, self.answering, self.__requests_changed, self.__carried.requests)
            if self.__has_begun:
                self.__requests.begin()
        return self.__requests

    def __requests_changed(self) -> None:
        """Let the next checkpoint look at the task, which may have no state of its own. In the actor."""
        self.kernel.tasks.note_settings(self.address, SettingsNote(self.kept_settings))

    def before_start(self) -> None:
        super().before_start()
        if self.answering or self.__carried.requests is not None:
            self.requests.subscribe()
        self.__began_s = (self.kernel.host.now(), self.now())

    def began(self) -> dict[str, Any]:
        """Return when this actor began, on the agent's own clock and in mission time, and what it carried then."""
        host_s, mission_s = self.__began_s
        carried = self.__carried
        return {
            "host_s": host_s,
            "mission_s": mission_s,
            "settings": dict(carried.settings),
            "state": dict(self.__carried_state),
            "periods_s": dict(carried.periods_s),
            "rate_hz": self.__rate_hz,
        }

    def after_start(self) -> None:
        self.__has_begun = True
        self.__tell(TaskBegan(self))
        if self.__requests is not None:
            self.__requests.begin()
            self.__requests.look()
        self.__wait_or_go_on()

    def change_settings(self, changes: Mapping[str, Any]) -> None:
        """Change some settings: all of them are good, or nothing changes. In the actor.

        Raises:
            SettingsError: names every mistake.
            PancakesError, ValueError: `on_settings` refuses them.
        """
        before = self.kept_settings
        self.keep_settings(change_settings(before, changes, self.name))
        try:
            self.facade.on_settings()
        except (PancakesError, ValueError):
            self.keep_settings(before)
            raise

    def carry(self) -> Carried:
        """Return what the task would carry to another actor now, as plain values. In the actor.

        Raises:
            TypeError: its settings or its state cannot be written down, or could not be read again.
        """
        return Carried(
            self.__plain_settings(),
            self.__plain("state", self.facade.state, self.facade.State),
            {name: timer.period_s for name, timer in self.timers.items()},
            self.__heard.heard(),
            self.__requests.carried() if self.__requests is not None else self.__carried.requests,
        )

    def __plain_settings(self) -> Mapping[str, Any]:
        # They are replaced as a whole when they change: so they are written down once, and not each second.
        note = self.kernel.tasks.settings_of(self.address)
        if note is not None and note.plain is not None and note.settings is self.kept_settings:
            return note.plain
        plain = self.__plain("settings", self.kept_settings, self.facade.Settings)
        self.kernel.tasks.note_settings(self.address, SettingsNote(self.kept_settings, plain))
        return plain

    def __plain(self, name: str, value: Any, cls: type) -> Mapping[str, Any]:
        if not isinstance(value, cls):
            raise TypeError(f"`self.{name}` is of the class {type(value).__name__}, and not {cls.__qualname__}")
        plain = plain_settings(value)
        if cls is not Nothing:
            # A task may assign anything to a field: what the next actor could not begin with must not replace what is
            # good. As costly as to encode it, which follows each time.
            problems = why_unreadable(cls, plain, allow_nan=name == "state")
            if problems:
                raise TypeError("; ".join(str(msgspec.structs.replace(it, path=(name, *it.path))) for it in problems))
        return plain

    def take_message(self, message: Any) -> Any:
        match message:
            case ChangeTask():
                if self.awaited is not None and isinstance(message.body, Configure):
                    self.keep_back(
                        Told(self, message)
                    )  # `on_settings` is its author's code, and waits as all of it does
                else:
                    self.__take_change(message)
            case Look():
                self.__look()
            case StandStill():
                self.__stand_still(message)
            case LoanChanged():
                self.__wait_or_go_on()
            case GoOn():
                self.fence = message.fence or self.fence
                self.thaw()
            case Give():
                self.__take(message)
            case Urgent() | RequestDue():
                self.__look_at_requests(message)
            case _:
                return super().take_message(message)
        return None

    def __wait_or_go_on(self) -> None:
        """Let all ticks and packets wait while somebody drives an actuator of this task by hand."""
        before, self.is_waiting = self.is_waiting, self.kernel.registry.waits_for(self.address) is not None
        if self.is_waiting:
            self.enter_pause()
        elif before:
            self.leave_pause()

    def leave_pause(self) -> None:
        super().leave_pause()
        if self.__requests is not None and not (self.is_paused or self.is_waiting or self.is_frozen):
            self.__requests.go_on()

    def __tell(self, message: object) -> bool:
        return self.__owner is not None and tell(self.__owner, message)

    def __look(self) -> None:
        if self.is_frozen or self.actor_stopped.is_set() or not self.acts():
            return
        try:
            looked = Looked(self, self.carry())
        except Exception as error:  # what a task keeps in its state may be anything
            looked = Looked(self, None, str(error))
        self.__tell(looked)

    def __stand_still(self, message: StandStill) -> None:
        self.freeze()
        try:
            carried = self.carry()
            if self.__requests is not None:
                carried = replace(carried, requests=self.__requests.carried(exactly=True))
            stood = Stood(self, message.number, carried)
        except Exception as error:  # what a task keeps in its state may be anything
            stood = Stood(self, message.number, None, str(error))
            self.thaw()
        self.__tell(stood)

    def __take(self, message: Give) -> None:
        """Handle a packet addressed to this task wherever it is, if it is the next of its stream; then say so."""
        letter = message.letter
        if message.packet is not None and message.packet.type in REQUEST_TYPES:
            self.__take_request(message, message.packet)
        elif self.actor_inbox.paused or self.actor_stopped.is_set() or not self.acts():
            self.__tell(LetterGiven(self, message, LetterOutcome.EARLY))
        elif self.__heard.is_old(letter.stream, letter.seq):
            self.__tell(LetterGiven(self, message, LetterOutcome.TAKEN))
        elif not self.__heard.is_next(letter.stream, letter.seq, letter.first):
            self.__tell(LetterGiven(self, message, LetterOutcome.EARLY))
        elif message.packet is None:  # it is given up, and the next one may follow
            self.__took(message)
        else:
            try:
                self.run_handlers(message.packet)
            except BaseException:
                self.__tell(LetterGiven(self, message, LetterOutcome.FAILED))
                raise
            if self.awaited is not None:
                self.awaited.failed.append(lambda: self.__tell(LetterGiven(self, message, LetterOutcome.FAILED)))
            self.after_awaiting(lambda: self.__took(message))

    def __take_request(self, message: Give, packet: Packet) -> None:
        """Take a packet of requests, also while the task awaits: it may wait for this answer.

        For the same reason an answer, feedback and a cancellation go past letters that came before them in their
        stream. They come again in their turn, and have no second effect then.
        """
        letter = message.letter
        if self.is_frozen or self.actor_stopped.is_set() or not self.acts():
            self.__tell(LetterGiven(self, message, LetterOutcome.EARLY))
        elif self.__heard.is_old(letter.stream, letter.seq):
            self.__tell(LetterGiven(self, message, LetterOutcome.TAKEN))
        else:
            is_next = self.__heard.is_next(letter.stream, letter.seq, letter.first)
            if is_next or packet.type != ASK_TYPE:
                self.requests.take(packet)
            if is_next:
                self.__took(message)
            else:
                self.__tell(LetterGiven(self, message, LetterOutcome.EARLY))

    def __look_at_requests(self, message: Urgent | RequestDue) -> None:
        if self.is_frozen or not self.acts():
            self.keep_back(Told(self, message))
        elif isinstance(message, RequestDue):
            self.requests.due(message)
        else:
            self.requests.look()

    def __took(self, message: Give) -> None:
        letter = message.letter
        self.__heard.took(letter.stream, letter.seq, letter.sender)
        self.__tell(LetterGiven(self, message, LetterOutcome.TAKEN))

    def answer_change(self, change: ChangeTask, reason: str, result: Mapping[str, Any]) -> None:
        """Answer a change that took longer than one turn; an empty reason means that it has been done."""
        self.__tell(Changed(self, change, Refusal.if_any(reason), result))

    def set_fence(self, change: ChangeTask) -> None:
        """Set the fence of an actuator, and answer; every other task refuses.

        Raises:
            ControlRefusedError: it is no actuator.
        """
        raise ControlRefusedError(f"{self.address} is no actuator: it has no fence", "unsupported")

    def __take_change(self, message: ChangeTask) -> None:
        try:
            if isinstance(message.body, SetFence):
                self.set_fence(message)
                return
            result = self.__change(message.body)
            carried = self.carry() if message.carry else None
            changed = Changed(self, message, None, result, carried)
        except SettingsError as error:
            changed = Changed(self, message, Refusal.of(error), {"problems": error.plain()})
        except (PancakesError, ValueError, TypeError) as error:  # TypeError: what cannot be saved
            changed = Changed(self, message, Refusal.of(error), {})
        self.__tell(changed)

    def __change(self, body: Reschedule | Configure | Describe) -> Mapping[str, Any]:
        match body:
            case Reschedule():
                timer = self.timer_of(body.rate_hz, body.timer)
                before_hz = timer.rate_hz
                if not body.dry_run:
                    self.reschedule(body.rate_hz, body.timer)
                return {"timer": timer.method, "rate_hz": body.rate_hz, "before_hz": before_hz}
            case Configure():
                if body.dry_run:
                    change_settings(self.kept_settings, body.settings, self.name)
                else:
                    self.change_settings(body.settings)
                return {"settings": dict(body.settings)}
            case Describe():
                return self.describe_state(body)

    def describe_state(self, asked: Describe) -> dict[str, Any]:
        """Return how this task began, and its settings and state, as far as `Describe` asks for them. In the actor.

        Raises:
            ControlRefusedError: what it keeps in its state cannot be written down.
        """
        told: dict[str, Any] = {"began": self.began()} if asked.began else {}
        if not asked.state:
            return told
        try:
            carried = self.carry()
        except Exception as error:  # what a task keeps in its state may be anything
            raise ControlRefusedError(
                f"the state of {self.address} cannot be written down: {error}", "failed"
            ) from None
        now = {"host_s": self.kernel.host.now(), "mission_s": self.now()}
        return {**told, **now, "settings": carried.settings, "state": carried.state}

    def end_actor(self, error: BaseException | None) -> None:
        last = None
        if error is None:
            try:
                last = self.carry()
            except Exception as failure:  # what a task keeps in its state may be anything
                self.log("error", f"the state of {self.address} is lost, because it cannot be written down: {failure}")
        self.kernel.tasks.note_settings(self.address, None)
        super().end_actor(error)
        if self.__requests is not None:
            self.__requests.end()
        if self.__owner is not None and not self.__tell(TaskEnded(self, error, last)):
            # Its service has ended before.
            self.kernel.stream.unsubscribe(self.address)
            self.kernel.registry.release(self.address)
