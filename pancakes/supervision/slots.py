"""The slots of a service's tasks: start, stop, commands, description and news of each task.

A `Slot` outlives the actors that fill it. A service starts its tasks a few at a time (`Startup`), because thousands
in one turn would block a thread of the pool. It stops them one after the other, the last first (`Closing`).
`COMMANDS` has a function for each control packet about a task (paper §3.4). All runs in the service's actor, except
`describe_task`, which any thread may call.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from itertools import islice
from typing import Any, Final, Protocol, assert_never

import msgspec
from msgspec.structs import replace

from pancakes.control import (
    Adopt,
    Command,
    Configure,
    Describe,
    Forget,
    Migrate,
    Refusal,
    Remove,
    Reschedule,
    Restart,
    SetFence,
    Start,
    Stop,
)
from pancakes.errors import ControlRefusedError
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.handlers import reliable
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import Mailbox, Reference, tell
from pancakes.kernel.registry import TaskEntry
from pancakes.packet import Fence
from pancakes.settings import SettingsError, change_plain, make_settings, plain_settings
from pancakes.supervision.lifecycle import CLOSES, Life, News, Overdue, Request, StartAsked, State, StopAsked, Tell
from pancakes.supervision.messages import Carried, ChangeTask
from pancakes.task import TaskSpec
from pancakes.util.schema import schema_of


class Failure(msgspec.Struct, frozen=True):
    """How a task failed.

    Attributes:
        text: in one line, with the line of its author's code.
        traceback: the whole of it.
        t_s: the mission time.
    """

    text: str
    traceback: str
    t_s: float


class Slot(msgspec.Struct):
    """The place of one task in its service: it outlives the actors that fill it.

    Requests and commands stand in tuples: empty ones cost nothing, and empty lists and a deque for each of ten thousand
    tasks are 11 MiB.

    Attributes:
        name: the task's name.
        life: how far the task is.
        task: its actor; None: none runs.
        carried: what its next actor begins with; None: what the configuration says.
        rest: of a task that can move and does not run: why, in a word.
        fresh: whether its next actor begins as the configuration says, whatever it carried.
        failure: how it failed the last time; None: it has not.
        changing: the requests for a change that its actor has not answered yet.
        commands: those that wait until the one that is being carried out is done.
    """

    name: str
    spec: TaskSpec
    address: str
    life: Life
    mailbox: Mailbox = msgspec.field(default_factory=Mailbox)
    task: Reference | None = None
    carried: Carried | None = None
    rest: str = ""
    fresh: bool = False
    fence: Fence | None = None
    failure: Failure | None = None
    changing: tuple[Request, ...] = ()
    commands: tuple[Command, ...] = ()

    @property
    def how_it_is(self) -> str:
        """How it is in the word that people see in every list, as a clause: `a/client/Scan is stopped`."""
        if self.rest in ("", self.life.word):
            return f"{self.address} is {self.life.word}"
        return f"{self.address} does not run: {self.rest}"


STARTED_AT_ONCE: Final = 64
"""How many tasks of a service start in one turn."""


class Startup:
    """Starts the tasks that start with their service. All in the service's actor.

    In one turn ten thousand would occupy a thread of the pool for half a second, and fight with those that run already
    for the interpreter. What is asked of a task meanwhile waits.

    Args:
        service: the service.
        at_once: how many of its tasks it starts in one turn.
        start: starts one of them.
        ready: called once it is decided of each whether it runs.
    """

    def __init__(
        self, service: ActorCore, at_once: int, start: Callable[[Slot], None], ready: Callable[[], None]
    ) -> None:
        self._service = service
        self._at_once = at_once
        self._start = start
        self._ready = ready
        self._unsettled: set[str] = set()
        self._unstarted: set[str] = set()

    def begin(self, slots: Sequence[Slot]) -> None:
        """Start these tasks, in this order."""
        self._unsettled = {slot.name for slot in slots}
        self._unstarted = set(self._unsettled)
        if slots:
            self._start_some(iter(slots))
        else:
            self._ready()

    def _start_some(self, slots: Iterator[Slot]) -> None:
        some = list(islice(slots, self._at_once))
        for slot in some:
            self._unstarted.discard(slot.name)
            self._start(slot)
        if len(some) == self._at_once:
            self._service.call(partial(self._start_some, slots))

    def is_to_start(self, slot: Slot) -> bool:
        """Return whether the turn of a task to start has not come yet."""
        return slot.name in self._unstarted

    def settled(self, slot: Slot) -> None:
        """The start of a task is decided."""
        if slot.name in self._unsettled:
            self._unsettled.discard(slot.name)
            if not self._unsettled:
                self._ready()


STUCK_S: Final = 2.0
"""A task that has not ended this long after it was asked to, in host time, is stuck."""
STUCK_AT_THE_END_S: Final = 0.4
"""Where the whole agent stops, this must do: the others, wheels among them, want to be stopped in order too."""


class Closing:
    """Ends the tasks of a service before the service itself. All in the service's actor.

    Args:
        service: the service.
        feed: feeds an event to the life of a task.
        let_go: takes back what a task at rest held.
        then: called when all have ended, or are stuck.
    """

    def __init__(
        self,
        service: ActorCore,
        feed: Callable[[Slot, StopAsked | Overdue], None],
        let_go: Callable[[Slot], None],
        then: Callable[[], None],
    ) -> None:
        self._service = service
        self._feed = feed
        self._let_go = let_go
        self._then = then
        self._left: list[Slot] = []
        self._ends: Slot | None = None

    def begin(self, slots: Iterable[Slot]) -> None:
        """End these tasks, the last first."""
        self._left = [slot for slot in slots if slot.life.state not in (State.STOPPED, State.REFUSED)]
        self._next()

    def _next(self) -> None:
        while self._left:
            slot = self._left.pop()
            if slot.life.at_rest:
                self._let_go(slot)
                continue
            self._ends = slot
            patience_s = STUCK_AT_THE_END_S if self._service.kernel.stopping else STUCK_S
            self._service.after_host(patience_s, partial(self._give_up, slot))
            self._feed(slot, StopAsked(reason=CLOSES))
            return
        self._ends = None
        self._then()

    def rested(self, slot: Slot) -> None:
        """A task has come to rest: the next one's turn."""
        if self._ends is slot:
            self._next()

    def _give_up(self, slot: Slot) -> None:
        """One task that does not end must not keep the others from ending."""
        if self._ends is not slot:
            return
        if slot.task is not None:
            self._feed(slot, Overdue(slot.life.incarnation))
        self._next()


WAITING: Final = reliable(1024)
"""How many control packets of each type wait if they come in faster than they can be carried out. The sender of one
more is refused, and told so: none may be lost without a word."""


class Commanded(Protocol):
    """What the commands need of a service."""

    kernel: Kernel

    @property
    def address(self) -> str: ...

    def feed(self, slot: Slot, event: Any) -> None: ...

    def reply(self, request: Request, refusal: Refusal | None = None, result: Any = None) -> None: ...

    def tell_asked(self, what: str, task: str, request: Request) -> None: ...

    def command_waits(self, slot: Slot, request: Request) -> None: ...

    def refuse_start(self, slot: Slot) -> str: ...

    def carried_of(self, slot: Slot) -> Carried: ...

    def settings_class(self, slot: Slot) -> type: ...

    def describe_in_detail(self, slot: Slot) -> dict[str, Any]: ...

    @property
    def keeps_changes(self) -> bool: ...


TaskCommand = Callable[[Commanded, Slot, Any, Request], None]


def start(service: Commanded, slot: Slot, body: Start, request: Request) -> None:
    """Start a task; the answer comes once it runs."""
    life = slot.life
    if life.state not in (State.STOPPED, State.REFUSED, State.FAILED, State.RESTARTING):
        raise ControlRefusedError(f"{slot.address} is {life.word} already")
    carried = service.carried_of(slot)
    if body.settings is not None:
        _check_paths(service, slot, body.settings)
        change_plain(service.settings_class(slot), carried.settings, body.settings, slot.name)
        carried = replace(carried, settings={**carried.settings, **body.settings})
    if body.dry_run:
        service.reply(request, Refusal.if_any(service.refuse_start(slot)))
        return
    if life.restarts.due_s is not None and (reason := service.refuse_start(slot)):
        raise ControlRefusedError(reason, "unable")  # its next try stays due
    service.tell_asked("start", slot.name, request)
    service.command_waits(slot, request)
    if body.settings is not None:
        slot.carried = carried
    service.feed(slot, StartAsked(request))


def stop(service: Commanded, slot: Slot, body: Stop, request: Request) -> None:
    """Stop a task; the answer comes once it has ended."""
    if slot.life.state is State.STOPPED and slot.rest != State.FAILED.value:  # as its record may say
        raise ControlRefusedError(f"{slot.address} is stopped already")
    if body.for_s is not None:
        raise ControlRefusedError(f"{slot.address} is a task: only a service can be stopped for a time")
    if body.then:
        raise ControlRefusedError(f"{slot.address} is a task of a service that starts none in its place", "unsupported")
    if body.dry_run:
        service.reply(request)
        return
    service.tell_asked("stop", slot.name, request)
    service.command_waits(slot, request)
    service.feed(slot, StopAsked(request, f"asked for by {request.by}"))


def restart(service: Commanded, slot: Slot, body: Restart, request: Request) -> None:
    """Stop a task, if it runs, and start it; the answer comes once it runs."""
    if body.dry_run:
        service.reply(request, Refusal.if_any(service.refuse_start(slot)))
        return
    service.command_waits(slot, request)
    service.tell_asked("restart", slot.name, request)
    slot.fresh = not body.keep_state
    service.feed(slot, StopAsked(request, f"restart asked for by {request.by}", again=True))


def change(
    service: Commanded, slot: Slot, body: Reschedule | Configure | Describe | SetFence, request: Request
) -> None:
    """Have a running task change, or say how it stands, in its own turn; the answer comes after that.

    Raises:
        ControlRefusedError: the task does not run, or a path of a file lies outside of the folders that may be set.
    """
    if slot.task is None or slot.life.state is not State.RUNNING:
        how = slot.how_it_is
        raise ControlRefusedError(how if "does not run" in how else f"{how}, not running")
    if isinstance(body, Configure):
        _check_paths(service, slot, body.settings)
    slot.changing = (*slot.changing, request)
    lasting = isinstance(body, (Reschedule, Configure)) and not body.dry_run
    tell(slot.task, ChangeTask(request, body, carry=lasting and service.keeps_changes))


def _check_paths(service: Commanded, slot: Slot, settings: Mapping[str, Any]) -> None:
    """Raise `ControlRefusedError` if settings have a path outside of the folders that the configuration names."""
    if reason := service.kernel.folders.refusal_of(service.settings_class(slot), settings):
        raise ControlRefusedError(f"bad settings for {slot.name}: {reason}", "invalid")


def tell_of(service: Commanded, slot: Slot, body: Describe, request: Request) -> None:
    """Tell what is known about a task."""
    if body.state or body.began:
        change(service, slot, body, request)
    else:
        service.reply(request, result=service.describe_in_detail(slot))


def refuse_removal(service: Commanded, slot: Slot, body: Any, request: Request) -> None:
    """Refuse what is about tasks that can be created."""
    raise ControlRefusedError(
        f"{slot.address} cannot be removed: what {service.address} looks after is not created", "unsupported"
    )


def refuse_move(service: Commanded, slot: Slot, body: Any, request: Request) -> None:
    """Refuse what is about tasks that can move."""
    raise ControlRefusedError(
        f"{slot.address} cannot move: what {service.address} looks after stays with its agent", "unsupported"
    )


CHANGES: Final[Mapping[type, str]] = {
    Reschedule: "rate_changed",
    Configure: "settings_changed",
    SetFence: "fence_set",
}
"""The event that tells of a change, by what asked for it."""
COMMANDS: Final[Mapping[type, TaskCommand]] = {
    Start: start,
    Stop: stop,
    Restart: restart,
    Reschedule: change,
    Configure: change,
    Describe: tell_of,
    SetFence: change,
    Migrate: refuse_move,
    Adopt: refuse_move,
    Forget: refuse_move,
    Remove: refuse_removal,
}
"""What can be asked of a task. A new control packet about tasks has a row here, and one in `pancakes.control.CONTROLS`.

What a running task does itself has `change` here, a row in `CHANGES`, and a case in `TaskCore`.
"""
OF_TASKS_ONLY: Final = frozenset(COMMANDS) - {Start, Stop, Restart, Describe}
"""What cannot be asked of a service."""


PAUSED: Final = "paused"
"""How a task rests that runs and does not act: it is guarded and has no permit, or an actuator of its is driven by
hand. It goes on by itself."""

SILENT: Final = "silent"
"""How a device is that runs, and has had no reading for too long."""


HALTED: Final = "halted"
"""How an actuator is that runs, and stands until a person ends the halt."""


def describe_task(kernel: Kernel, entry: TaskEntry) -> dict[str, Any]:
    """Return what is known about each task. Any thread.

    Args:
        kernel: the kernel that it runs on.
        entry: what its service has entered of it.
    """
    life = entry.life
    timers = kernel.task_timers.of(entry.address)
    first = timers[0] if timers else None
    told: dict[str, Any] = {
        "agent": kernel.agent,
        "service": entry.service,
        "task": entry.name,
        "type": entry.type,
        "state": life.word,
        # It is wanted, and starts by itself once it can: what it lacks is in `reason`.
        "waits": life.state is State.REFUSED,
        "rest": entry.rest,
        "rate_hz": first.rate_hz if first is not None else None,
        "incarnation": life.incarnation,
        "reason": life.reason,
        **life.restarts.describe(kernel.host.now()),
        "ticks": first.ticks if first is not None else 0,
        "lateness_sum_s": first.lateness_sum_s if first is not None else 0.0,
        "missed": sum(timer.missed_total for timer in timers),
        "lateness_max_s": max((timer.lateness_max_s for timer in timers), default=0.0),
        "dropped": entry.mailbox.dropped(),
    }
    note = kernel.guard_notes.of(entry.address)
    if note is not None:
        told["guarding"] = note.plain(kernel.host.now(), kernel.permits.left_s(note.right))
        if not told["guarding"]["permit_s"] and (life.state is State.RUNNING or told["guarding"]["copied"]):
            told["rest"] = PAUSED
    if (waits_for := kernel.registry.waits_for(entry.address)) is not None and life.state is State.RUNNING:
        told["rest"], told["reason"] = PAUSED, waits_for.why
    if not entry.device:
        return told
    holder = kernel.registry.holder(entry.name)
    if (readings := kernel.registry.readings(entry.name)) is not None:
        told["readings"] = readings.describe(kernel.mission.now())
        if told["readings"]["silent_s"] is not None and life.state is State.RUNNING:
            told["rest"] = SILENT
    if kernel.halt.why and kernel.registry.is_actuator(entry.name):
        told["rest"] = HALTED
    if (filters := kernel.registry.filters(entry.name)) is not None:
        told["filters"] = filters.describe(kernel.mission.now())
    if (loan := kernel.registry.loan(entry.name)) is not None:
        told["driven_by"] = loan.by
    return {**told, "device": entry.device, **({"holder": holder} if holder else {})}


def describe_in_detail(kernel: Kernel, slot: Slot, settings_class: type, carried: Carried) -> dict[str, Any]:
    """Return what else is known about one task, its settings among it.

    Args:
        kernel: the kernel that it runs on.
        slot: its place.
        settings_class: the dataclass of its settings.
        carried: what it would begin with if it does not run.
    """
    spec = slot.spec
    return {
        # No configuration names it: it comes with its service, whose settings are where its own come from.
        "own": not spec.type,
        # No configuration names it either: it was asked for by `Create`.
        "created": spec.created,
        "requires": list(spec.cls.requires),
        "timers": [timer.describe() for timer in kernel.task_timers.of(slot.address)],
        "reads": kernel.stream.readings(slot.address),
        "settings": settings_of(kernel, slot, settings_class, carried),
        "settings_schema": _schema_of_settings(settings_class),
        "durability": spec.durability,
        "guard": msgspec.structs.asdict(spec.guard) if spec.guard is not None else None,
        "restart": msgspec.structs.asdict(spec.restart),
        "failure": msgspec.to_builtins(slot.failure),
        "fence": {"task_id": slot.fence.task_id, "epoch": slot.fence.epoch[0]} if slot.fence is not None else None,
    }


def settings_of(kernel: Kernel, slot: Slot, settings_class: type, carried: Carried) -> dict[str, Any]:
    """Return the settings of a task, or those that it would begin with; arguments as in `describe_in_detail`."""
    try:
        note = kernel.tasks.settings_of(slot.address) if slot.task is not None else None
        settings = note.settings if note is not None else make_settings(settings_class, carried.settings)
    except SettingsError:  # it cannot start with them, and the person who asks wants to see why
        return dict(carried.settings)
    try:
        return plain_settings(settings)
    except TypeError as error:  # what its author put there may be anything
        return {"error": f"the settings of {slot.address} cannot be told: {error}"}


def _schema_of_settings(cls: type) -> dict[str, Any]:
    """Return the JSON Schema of a task's settings; empty if they have a type that cannot be checked."""
    try:
        return _schema_of(cls)
    except TypeError:
        return {}


@lru_cache(maxsize=256)
def _schema_of(cls: type) -> dict[str, Any]:
    """As `schema_of`, which takes milliseconds, once for each class: pages ask again and again. Not to be changed."""
    return schema_of(cls)


def tell_of_task(service: ActorCore, slot: Slot, effect: Tell) -> None:
    """Tell people and programs what has happened to a task, in the name of its service."""
    restarts, text = slot.life.restarts, effect.text
    traceback = slot.failure.traceback if slot.failure is not None else ""
    now_s = service.kernel.host.now()
    match effect.news:
        case News.REFUSED:
            service.log("error", f"{slot.address} was not started: {text}")
        case News.STARTED:
            service.event(
                "task_started",
                task=slot.name,
                service=service.name,
                type=slot.spec.type,
                incarnation=slot.life.incarnation,
                epoch=slot.fence.epoch[0] if slot.fence is not None else None,
            )
        case News.FAILED:
            following = effect.following.value if effect.following is not None else ""
            service.event("task_failed", task=slot.name, error=text, then=following)
        case News.RESTARTS:
            if slot.failure is None or slot.failure.text != text:
                traceback = ""
            service.log("warning", f"{slot.address} is started again {restarts.when(now_s)}: {text}", traceback)
        case News.GIVEN_UP:
            spec = restarts.spec
            then_again = "" if restarts.due_s is None else f", and tried again {restarts.when(now_s)}"
            why = "" if effect.hopeless else f" ({spec.policy}, {spec.at_most} restarts in {spec.within_s:g} s)"
            service.log("error", f"{slot.address} is given up{then_again}: {text}{why}", traceback)
            service.event("task_given_up", task=slot.name, error=text)
        case News.FAILED_WHILE_STOPPING:
            service.log("warning", f"{slot.address} failed while it stopped: {text}", traceback)
        case News.FAILED_AT_THE_END:
            service.log("warning", f"{slot.address} failed as its service stops: {text}", traceback)
        case News.STOPPED:
            service.event("task_stopped", task=slot.name, service=service.name, reason=text)
        case News.STUCK:
            service.log("error", text)
            service.event("task_stuck", task=slot.name)
        case _:
            assert_never(effect.news)
