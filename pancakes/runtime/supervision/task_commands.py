"""What a service does for each control packet that is about one of its tasks (paper §3.4)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, Protocol

from msgspec.structs import replace

from pancakes.control import Adopt, Configure, Describe, Forget, Migrate, Reschedule, Restart, SetFence, Start, Stop
from pancakes.creation import Remove
from pancakes.errors import ControlRefused
from pancakes.runtime.kernel.keep import reliable
from pancakes.runtime.kernel.kernel import Kernel
from pancakes.runtime.kernel.tell import tell
from pancakes.runtime.life.life import State
from pancakes.runtime.life.life_event import StartAsked, StopAsked
from pancakes.runtime.life.request import Request
from pancakes.runtime.supervision.slot import Slot
from pancakes.runtime.supervision.task_messages import Carried, ChangeTask
from pancakes.settings import change_plain

WAITING: Final = reliable(1024)
"""So many control packets of each type wait where they come in faster than they can be carried out. The sender of one
more is refused, and told so: none may be lost without a word."""


class Commanded(Protocol):
    """What the commands need of a service."""

    kernel: Kernel

    @property
    def address(self) -> str: ...

    def feed(self, slot: Slot, event: Any) -> None: ...

    def reply(self, request: Request, reason: str = "", result: Any = None) -> None: ...

    def tell_asked(self, what: str, slot: Slot, request: Request) -> None: ...

    def command_waits(self, slot: Slot, request: Request) -> None: ...

    def refuse_start(self, slot: Slot) -> str: ...

    def carried_of(self, slot: Slot) -> Carried: ...

    def settings_class(self, slot: Slot) -> type: ...

    def describe_in_detail(self, slot: Slot) -> dict[str, Any]: ...

    @property
    def keeps_changes(self) -> bool: ...


Command = Callable[[Commanded, Slot, Any, Request], None]


def start(service: Commanded, slot: Slot, body: Start, request: Request) -> None:
    """Starts a task; the answer comes once it runs."""
    life = slot.life
    if life.state not in (State.STOPPED, State.REFUSED, State.FAILED, State.RESTARTING):
        raise ControlRefused(f"{slot.address} is {life.word} already")
    carried = service.carried_of(slot)
    if body.settings is not None:
        _check_paths(service, slot, body.settings)
        change_plain(service.settings_class(slot), carried.settings, body.settings, slot.name)
        carried = replace(carried, settings={**carried.settings, **body.settings})
    if body.dry_run:
        service.reply(request, service.refuse_start(slot))
        return
    if life.restarts.due_s is not None and (reason := service.refuse_start(slot)):
        raise ControlRefused(reason)  # its next try stays due
    service.tell_asked("start", slot, request)
    service.command_waits(slot, request)
    if body.settings is not None:
        slot.carried = carried
    service.feed(slot, StartAsked(request))


def stop(service: Commanded, slot: Slot, body: Stop, request: Request) -> None:
    """Stops a task; the answer comes once it has ended."""
    if slot.life.state is State.STOPPED and slot.rest != State.FAILED.value:  # as its record may say
        raise ControlRefused(f"{slot.address} is stopped already")
    if body.for_s is not None:
        raise ControlRefused(f"{slot.address} is a task: only a service can be stopped for a time")
    if body.dry_run:
        service.reply(request)
        return
    service.tell_asked("stop", slot, request)
    service.command_waits(slot, request)
    service.feed(slot, StopAsked(request, f"asked for by {request.by}"))


def restart(service: Commanded, slot: Slot, body: Restart, request: Request) -> None:
    """Stops a task, if it runs, and starts it; the answer comes once it runs."""
    if body.dry_run:
        service.reply(request, service.refuse_start(slot))
        return
    service.command_waits(slot, request)
    service.tell_asked("restart", slot, request)
    slot.fresh = not body.keep_state
    service.feed(slot, StopAsked(request, f"restart asked for by {request.by}", again=True))


def change(
    service: Commanded, slot: Slot, body: Reschedule | Configure | Describe | SetFence, request: Request
) -> None:
    """Has a running task change, or say how it stands, in its own turn; the answer comes after that.

    Raises:
        ControlRefused: the task does not run, or a path of a file lies where none may be set.
    """
    if slot.task is None or slot.life.state is not State.RUNNING:
        how = slot.how_it_is
        raise ControlRefused(how if "does not run" in how else f"{how}, not running")
    if isinstance(body, Configure):
        _check_paths(service, slot, body.settings)
    slot.changing = (*slot.changing, request)
    lasting = isinstance(body, (Reschedule, Configure)) and not body.dry_run
    tell(slot.task, ChangeTask(request, body, carry=lasting and service.keeps_changes))


def _check_paths(service: Commanded, slot: Slot, settings: Mapping[str, Any]) -> None:
    """Raises `ControlRefused` where settings have a path outside of the folders that the configuration names."""
    if reason := service.kernel.folders.refusal_of(service.settings_class(slot), settings):
        raise ControlRefused(f"bad settings for {slot.name}: {reason}")


def tell_of(service: Commanded, slot: Slot, body: Describe, request: Request) -> None:
    """Tells what is to be known about a task."""
    if body.state or body.began:
        change(service, slot, body, request)
    else:
        service.reply(request, result=service.describe_in_detail(slot))


def refuse_removal(service: Commanded, slot: Slot, body: Any, request: Request) -> None:
    """Refuses what is about tasks that can be created."""
    raise ControlRefused(f"{slot.address} cannot be removed: what {service.address} looks after is not created")


def refuse_move(service: Commanded, slot: Slot, body: Any, request: Request) -> None:
    """Refuses what is about tasks that can move."""
    raise ControlRefused(f"{slot.address} cannot move: what {service.address} looks after stays with its agent")


CHANGES: Final[Mapping[type, str]] = {
    Reschedule: "rate_changed",
    Configure: "settings_changed",
    SetFence: "fence_set",
}
"""The event that tells of a change, by what asked for it."""
COMMANDS: Final[Mapping[type, Command]] = {
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
"""What can be asked of a task."""
