"""Tasks: the main actors, which sense, control and decide (paper §3.2).

A task says what it depends on and what it reacts to, and owns no thread, socket or lock:

    class Blink(Task):
        @dataclass
        class Settings:
            colour: str = "red"

        @every(hz=1)
        def blink(self, tick: Tick) -> None:
            self.log.info(f"{self.settings.colour} at {tick.time_s:.0f} s")
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Final

import msgspec

from pancakes.control import Configure, Describe, Migrate, Refusal, Reschedule, SetFence
from pancakes.durable.delivery import Incoming
from pancakes.durable.rules import CostChoice, GuardRule, MigrationRule
from pancakes.errors import ControlRefused, PancakesError
from pancakes.kernel.actor import COMPONENT_HOOKS, Component
from pancakes.kernel.handlers import Tick, checked_period, every, on, period_of, queue, reliable
from pancakes.kernel.mailbox import Mailbox, Reference, tell
from pancakes.kernel.registry import SettingsNote
from pancakes.packet import SYSCTRL, Fence, Packet
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
    Look,
    Looked,
    StandStill,
    Stood,
    TaskBegan,
    TaskEnded,
)
from pancakes.supervision.restart import RestartSpec
from pancakes.supervision.serializable_types import check_offers, check_saved, check_words
from pancakes.util.class_checks import Made, check_made, check_own_names

if TYPE_CHECKING:
    from pancakes.kernel.kernel import Kernel

__all__ = ["Task", "TaskSpec", "Tick", "every", "on", "queue", "reliable"]


@dataclass
class Nothing:
    """Settings or state of a task that has none."""


_NONE: Final[Mapping[str, Any]] = MappingProxyType({})
"""One empty table for all that have none."""


class TaskSpec(msgspec.Struct, frozen=True):
    """All that a service needs to start a task, as data.

    Attributes:
        name: its name; its address is the service's with the name appended.
        cls: its class.
        type: name of its class's entry point; empty where it has none, and then it cannot move.
        version: version of the distribution that the class comes from.
        settings: its settings, as plain values.
        rate_hz: the rate of its first timer, where it shall differ from what the class says.
        start: whether it is started with its service.
        restart: what happens when it ends by itself.
        durability: `lazy`: a checkpoint each second where something changed; `each`: before each acknowledgement.
        rule: when it moves to another agent by itself.
        guard: how it is guarded; None: it is not.
        created: whether no configuration file names it, although it has a type.
        device: of the task of a device its type; else empty.
        arguments: what else its class wants, for tasks that a service makes of its own classes.
    """

    name: str
    cls: type[Task]
    type: str = ""
    version: str = ""
    settings: Mapping[str, Any] = _NONE
    rate_hz: float | None = None
    start: bool = True
    restart: RestartSpec = RestartSpec()
    durability: str = "lazy"
    rule: MigrationRule | None = None
    guard: GuardRule | None = None
    created: bool = False
    device: str = ""
    arguments: Mapping[str, Any] = _NONE


_HOOKS: Final = (*COMPONENT_HOOKS, "on_settings", "Settings", "State", "requires", "offers")
_MADE_WITH: Final = ("kernel", "address", "mailbox", "carried", "rate_hz", "fence", "owner", "tells_each_turn")


class Task(Component):
    """The base of all tasks.

    Attributes:
        requires: the device types that the agent must have. A task that requires an actuator is its only holder
            while it runs.
        offers: the fields of its state that agents are told that bid for it, for cost functions that know the task.
        settings: an instance of the class's `Settings`; replaced as a whole when they are changed, before
            `on_settings` is called.
        state: an instance of the class's `State`; it moves with the task.
    """

    requires: ClassVar[tuple[str, ...]] = ()
    offers: ClassVar[tuple[str, ...]] = ()
    Settings: ClassVar[type] = Nothing
    State: ClassVar[type] = Nothing
    _made_as: ClassVar[Made] = Made(_MADE_WITH, "a task", "`def on_start(self)`", gives="actor_stopped")

    state: Any

    def __init_subclass__(cls, **others: Any) -> None:
        """Raises `ClassError` if the class cannot work: a method that Pancakes calls, what it saves and offers."""
        check_own_names(cls, Task, _HOOKS, ("settings", "state"))
        super().__init_subclass__(**others)
        check_made(cls)
        check_words(cls, "requires", "offers")
        check_saved(cls, "Settings", "State")
        check_offers(cls.__qualname__, cls.State, cls.offers)

    def __init__(
        self,
        kernel: Kernel,
        address: str,
        mailbox: Mailbox | None = None,
        *,
        carried: Carried | None = None,
        rate_hz: float | None = None,
        fence: Fence | None = None,
        owner: Reference | None = None,
        tells_each_turn: bool = False,
    ) -> None:
        super().__init__(kernel, address, mailbox)
        carried = carried or Carried(_NONE, _NONE)
        self.settings = make_settings(self.Settings, carried.settings, owner=self.name)
        self.state = make_settings(self.State, carried.state, allow_nan=True, owner=self.name, noun="state")
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
        self.__revoked = False

    @property
    def settings(self) -> Any:
        return self.__settings

    @settings.setter
    def settings(self, settings: Any) -> None:
        self.__settings = settings
        self.kernel.tasks.note_settings(self.address, SettingsNote(settings))

    def on_settings(self) -> None:
        """Called in the actor after the settings were changed while it runs."""

    def migrate(self, to: str = "", then: str = "", cost: CostChoice = "tasks") -> None:
        """Asks for this task to be moved to the neighbour that takes it for the lowest cost.

        It goes on until one has been found, and for good where none is. The answer comes as a `Reply` on
        `sysctrl`.

        Args:
            to: the only neighbour to ask; empty: all.
            then: a task to start here once this one has gone.
            cost: the cost function that neighbours answer with, or the weight of each of several.
        """
        service = self.address.split("/")[1]
        self.publish(SYSCTRL, Migrate(f"{service}/{self.name}", to=to, then=then, cost=cost))

    def initial_period_s(self, method: str, period_s: float) -> float:
        carried_s = self.__carried.periods_s.get(method)
        if carried_s is not None:
            return checked_period(carried_s)  # it may come from another agent
        return period_of(self.__rate_hz) if self.__rate_hz is not None and not self.timers else period_s

    def acts(self) -> bool:
        # A guarded task that does not know whether another agent runs it stands still until its service tells it.
        if self.kernel.permits.may_act(self.fence):
            return True
        if not self.is_frozen:
            self.freeze()
            self.__tell(HasNoPermit(self))
        return False

    def may_act(self) -> bool:
        """Returns whether the task may act now. Any thread.

        It may, unless it is guarded and its guardians do not answer, or it was revoked because it was stuck. Pancakes
        looks before each turn and where a packet or a command leaves; a task that acts past Pancakes (on a file, a
        socket, a subprocess) asks right before it does.
        """
        return not self.__revoked and self.kernel.permits.may_act(self.fence)

    def revoke(self) -> None:
        self.__revoked = True
        super().revoke()

    def before_start(self) -> None:
        super().before_start()
        self.__began_s = (self.kernel.host.now(), self.now())

    def began(self) -> dict[str, Any]:
        """Returns when this actor began, on the agent's own clock and in mission time, and what it carried then."""
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
        self.__tell(TaskBegan(self))

    def change_settings(self, changes: Mapping[str, Any]) -> None:
        """Changes some settings: all of them are good, or nothing changes. In the actor.

        Raises:
            SettingsError: names every mistake.
            PancakesError, ValueError: `on_settings` refuses them.
        """
        before = self.settings
        self.settings = change_settings(before, changes, self.name)
        try:
            self.on_settings()
        except (PancakesError, ValueError):
            self.settings = before
            raise

    def carry(self) -> Carried:
        """Returns what the task would carry to another actor now, as plain values. In the actor.

        Raises:
            TypeError: its settings or its state cannot be written down, or could not be read again.
        """
        return Carried(
            self.__plain_settings(),
            self.__plain("state", self.state, self.State),
            {name: timer.period_s for name, timer in self.timers.items()},
            self.__heard.heard(),
        )

    def __plain_settings(self) -> Mapping[str, Any]:
        # They are replaced as a whole where they are changed: so they are written down once, and not each second.
        note = self.kernel.tasks.settings_of(self.address)
        if note is not None and note.plain is not None and note.settings is self.__settings:
            return note.plain
        plain = self.__plain("settings", self.__settings, self.Settings)
        self.kernel.tasks.note_settings(self.address, SettingsNote(self.__settings, plain))
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

    def take_letter(self, stream: str, seq: int, first: int, packet: Packet | None, sender: str = "") -> bool:
        """Handles a packet addressed to this task wherever it is, if it is the next of its stream. In the actor.

        Args:
            stream: its sender's stream.
            seq: its number in that stream.
            first: the lowest number that may still come.
            packet: the packet; None: it is given up, and the next one may follow.
            sender: the agent that sent it.

        Returns:
            Whether it has had its effect, now or before.
        """
        if self.actor_inbox.paused or self.actor_stopped.is_set() or not self.acts():
            return False
        if self.__heard.is_old(stream, seq):
            return True
        if not self.__heard.is_next(stream, seq, first):
            return False
        if packet is not None:
            self.run_handlers(packet)
        self.__heard.took(stream, seq, sender)
        return True

    def take_message(self, message: Any) -> Any:
        match message:
            case ChangeTask():
                self.__take_change(message)
            case Look():
                self.__look()
            case StandStill():
                self.__stand_still(message)
            case GoOn():
                self.fence = message.fence or self.fence
                self.thaw()
            case Give():
                self.__take(message)
            case _:
                return super().take_message(message)
        return None

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
            stood = Stood(self, message.offer, self.carry())
        except Exception as error:  # what a task keeps in its state may be anything
            stood = Stood(self, message.offer, None, str(error))
            self.thaw()
        self.__tell(stood)

    def __take(self, message: Give) -> None:
        letter = message.letter
        try:
            took = self.take_letter(letter.stream, letter.seq, letter.first, message.packet, letter.sender)
        except BaseException:
            self.__tell(LetterGiven(self, message, LetterOutcome.FAILED))
            raise
        self.__tell(LetterGiven(self, message, LetterOutcome.TAKEN if took else LetterOutcome.EARLY))

    def answer_change(self, change: ChangeTask, reason: str, result: Mapping[str, Any]) -> None:
        """Answers a change that took longer than one turn; an empty reason means that it has been done."""
        self.__tell(Changed(self, change, Refusal.if_any(reason), result))

    def set_fence(self, change: ChangeTask) -> None:
        """Sets the fence of an actuator, and answers; every other task refuses.

        Raises:
            ControlRefused: it is no actuator.
        """
        raise ControlRefused(f"{self.address} is no actuator: it has no fence", "unsupported")

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
                    change_settings(self.settings, body.settings, self.name)
                else:
                    self.change_settings(body.settings)
                return {"settings": dict(body.settings)}
            case Describe():
                return self.describe_state(body)

    def describe_state(self, asked: Describe) -> dict[str, Any]:
        """Returns how this task began, and its settings and state, as far as `Describe` asks for them. In the actor.

        Raises:
            ControlRefused: what it keeps in its state cannot be written down.
        """
        told: dict[str, Any] = {"began": self.began()} if asked.began else {}
        if not asked.state:
            return told
        try:
            carried = self.carry()
        except Exception as error:  # what a task keeps in its state may be anything
            raise ControlRefused(f"the state of {self.address} cannot be written down: {error}", "failed") from None
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
        if self.__owner is not None and not self.__tell(TaskEnded(self, error, last)):
            # Its service has ended before.
            self.kernel.stream.unsubscribe(self.address)
            self.kernel.registry.release(self.address)
