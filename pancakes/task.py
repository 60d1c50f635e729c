"""Tasks: the main actors, which sense, control and decide (paper §3.2).

A task says what it depends on and what it reacts to, and owns no thread, socket or lock:

    class Blink(Task):
        @dataclass
        class Settings:
            colour: str = "red"

        @every(hz=1)
        def blink(self, tick: Tick) -> None:
            self.log.info(f"{self.settings.colour} at {tick.time_s:.0f} s")

With `class Blink(Task[BlinkSettings, BlinkState])` type checkers know what `self.settings` and `self.state` are; both
are classes of their own then. The second may be left out, and None stands for no settings.

A method may be `async def`, for what waits: a web API, a camera service, a database.

    class Report(Task):
        async def on_start(self) -> None:
            self.http = httpx.AsyncClient()

        @every(hz=0.1)
        async def report(self, tick: Tick) -> None:
            await self.http.post("https://example.org/reports", json={"time_s": tick.time_s})

It is awaited on an event loop of the task's own; packets, ticks and calls wait until it has ended, as they do behind
any method. The task can be stopped and migrated meanwhile: see `pancakes.kernel.awaiting`.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, TypeVar, get_args, get_origin, overload

import msgspec

from pancakes.control import Migrate
from pancakes.errors import PancakesError
from pancakes.kernel.actor import COMPONENT_HOOKS, Component
from pancakes.kernel.handlers import HOOKS_AWAITED, Tick, answers_of, every, on, reliable
from pancakes.kernel.mailbox import Mailbox
from pancakes.migration import CostChoice, GuardRule, MigrationRule
from pancakes.packet import SYSCTRL
from pancakes.supervision.restart import RestartSpec
from pancakes.supervision.serializable_types import check_offers, check_saved, check_words
from pancakes.supervision.task_core import NONE, Nothing, TaskCore
from pancakes.util.class_checks import Made, check_made, check_own_names

if TYPE_CHECKING:
    import typing_extensions

    from pancakes.kernel.kernel import Kernel
    from pancakes.request import Answer, AnswerT, Asked, FeedbackT, Pending, Request

    SettingsT = typing_extensions.TypeVar("SettingsT", default=Any)
    StateT = typing_extensions.TypeVar("StateT", default=Any)
else:
    SettingsT = TypeVar("SettingsT")
    StateT = TypeVar("StateT")

__all__ = ["Task", "TaskSpec", "Tick", "every", "on", "reliable"]


class TaskSpec(msgspec.Struct, frozen=True):
    """All that a service needs to start a task, as data.

    Attributes:
        name: its name; its address is the service's with the name appended.
        cls: its class.
        type: name of its class's entry point; empty if it has none, and then it cannot move.
        version: version of the distribution that the class comes from.
        settings: its settings, as plain values.
        rate_hz: the rate of its first timer, if it shall differ from what the class says.
        start: whether it is started with its service.
        restart: what happens when it ends by itself.
        durability: `lazy`: a checkpoint each second if something changed; `each`: before each acknowledgement.
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
    settings: Mapping[str, Any] = NONE
    rate_hz: float | None = None
    start: bool = True
    restart: RestartSpec = RestartSpec()
    durability: str = "lazy"
    rule: MigrationRule | None = None
    guard: GuardRule | None = None
    created: bool = False
    device: str = ""
    arguments: Mapping[str, Any] = NONE


_HOOKS: Final = (*COMPONENT_HOOKS, "on_settings", "on_cancel", "Settings", "State", "requires", "offers")
_MADE_WITH: Final = ("kernel", "address", "mailbox", "carried", "rate_hz", "fence", "owner", "tells_each_turn")


def _given_types(cls: type) -> tuple[Any, ...]:
    """Return what stands in the brackets behind `Task` among the bases of a class: settings, state; empty: nothing."""
    for base in vars(cls).get("__orig_bases__", ()):
        origin = get_origin(base)
        if origin is Task:
            return get_args(base)
        if isinstance(origin, type) and issubclass(origin, Task):
            given = dict(zip(origin.__parameters__, get_args(base), strict=False))  # type: ignore[attr-defined]
            return tuple(given.get(it, it) for it in _given_types(origin))
    return ()


class Task(Component, Generic[SettingsT, StateT]):
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
    _made_as: ClassVar[Made] = Made(_MADE_WITH, "a task", "`def on_start(self)`", "_actor", HOOKS_AWAITED)

    state: StateT
    _actor: TaskCore

    if not TYPE_CHECKING:

        def __class_getitem__(cls, types: Any) -> Any:
            """Return the class with its settings and state, of which the second may be left out."""
            given = types if isinstance(types, tuple) else (types,)
            missing = max(0, len(cls.__parameters__) - len(given)) if cls is Task else 0
            return super().__class_getitem__((*given, *[Any] * missing))

    def __init_subclass__(cls, **others: Any) -> None:
        """Raise `ClassError` if the class cannot work: a method that Pancakes calls, what it saves and offers."""
        check_own_names(cls, Task, _HOOKS, ("settings", "state"))
        super().__init_subclass__(**others)
        for name, given in zip(("Settings", "State"), _given_types(cls), strict=False):
            if isinstance(given, type) and given not in (Any, type(None)) and name not in vars(cls):
                setattr(cls, name, given)
        check_made(cls)
        answers_of(cls)
        check_words(cls, "requires", "offers")
        check_saved(cls, "Settings", "State")
        check_offers(cls.__qualname__, cls.State, cls.offers)

    def __init__(self, kernel: Kernel, address: str, mailbox: Mailbox | None = None, **others: Any) -> None:
        TaskCore(kernel, address, mailbox, facade=self, **others)

    @property
    def settings(self) -> SettingsT:
        return self._actor.kept_settings

    @settings.setter
    def settings(self, settings: SettingsT) -> None:
        self._actor.keep_settings(settings)

    def on_settings(self) -> None:
        """Called in the actor after the settings were changed while it runs."""

    def on_cancel(self, pending: Pending[Any, Any]) -> None:
        """Called in the actor when a request that it answers later is not wanted any more: cancelled, or out of time.

        It is closed already. A method that answers by what it returns is not told: one that awaits is cancelled.
        """

    @overload
    def ask(
        self,
        to: str,
        request: Request[AnswerT, FeedbackT],
        *,
        timeout_s: float = 5.0,
        feedback: Callable[[FeedbackT], object] | None = None,
    ) -> Coroutine[Any, Any, AnswerT]: ...

    @overload
    def ask(
        self,
        to: str,
        request: Request[AnswerT, FeedbackT],
        *,
        then: Callable[[Answer[AnswerT]], object],
        timeout_s: float = 5.0,
        feedback: Callable[[FeedbackT], object] | None = None,
    ) -> Asked: ...

    def ask(
        self,
        to: str,
        request: Request[Any, Any],
        *,
        then: Callable[[Answer[Any]], object] | None = None,
        timeout_s: float = 5.0,
        feedback: Callable[[Any], object] | None = None,
    ) -> Any:
        """Ask another task for something. It answers once at most, and never blocks this one.

        In an `async def` method: `position = await self.ask("task:robot2/Finder", Where("cup"))`. It waits between
        turns. If it is cancelled, because the task is stopped or moves for instance, so is the request. In any method:
        `self.ask(..., then=self.found)` returns at once, and `self.found` gets an `Answer`, also if the task has moved
        meanwhile.

        Args:
            to: the task: `task:birthplace/name` (see `task_address`) finds it wherever it is, and waits while it
                moves; `agent/service/task` means the one that is there now.
            request: the request.
            then: the method of this task that takes the answer; None: the result is awaited.
            timeout_s: after this time in mission seconds the request is called off.
            feedback: takes each feedback on the way; with `then`, a method of this task.

        Returns:
            What to await, for the answer; with `then`, the request that may be cancelled.

        Raises:
            RequestError: awaited: it was refused, failed, or the other task was not found. Also if too many requests
                wait already, or this one cannot be sent.
            RequestTimeoutError: awaited: the time was up.
            PancakesError: an argument makes no sense; or what `publish` raises.
        """
        core = self._actor
        if then is not None:
            return core.requests.ask(to, request, timeout_s, then, feedback)
        if not core.awaits:
            raise PancakesError(
                f"{self.address} has no `async def` method that could await the answer: name a method that takes it, as"
                " in `self.ask(..., then=self.answered)`"
            )
        return core.requests.answer_to(to, request, timeout_s, feedback)

    def migrate(self, to: str = "", then: str = "", cost: CostChoice = "tasks") -> None:
        """Ask for this task to be moved to the neighbour that takes it for the lowest cost.

        It goes on until one has been found, and for good if none is. The answer comes as a `Reply` on
        `sysctrl`.

        Args:
            to: the only neighbour to ask; empty: all.
            then: a task to start here once this one has gone.
            cost: the cost function that neighbours answer with, or the weight of each of several.
        """
        service = self.address.split("/")[1]
        self.publish(SYSCTRL, Migrate(f"{service}/{self.name}", to=to, then=then, cost=cost))

    def may_act(self) -> bool:
        """Return whether the task may act now. Any thread.

        It may, unless it is guarded and its guardians do not answer, or it was revoked because it was stuck. Pancakes
        looks before each turn and when a packet or a command leaves; a task that acts past Pancakes (on a file, a
        socket, a subprocess) asks right before it does.
        """
        core = self._actor
        return not core.is_revoked and core.kernel.permits.may_act(core.fence)
