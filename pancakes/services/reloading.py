"""A part of the root: has the tasks of an agent go on in the version of their classes that is on disk.

One reload at a time, in three steps: the new version is imported beside the one in use; all services say whether their
tasks fit; if all do, the version becomes the agent's, and the services exchange the classes. Up to the third step
nothing has changed. All in the root's actor.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import msgspec
from msgspec.structs import replace

from pancakes.control import Refusal, Reload
from pancakes.durable.host_state import IMPORTER, ImportAgain, ImportedAgain, import_again
from pancakes.durable.installed import Installed
from pancakes.durable.reload_types import NewVersion
from pancakes.errors import ControlRefusedError
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.mailbox import Reference, tell
from pancakes.services.service_supervisor import ServicePlace
from pancakes.supervision.lifecycle import Request, State
from pancakes.supervision.messages import ReloadedTask, TakeClasses, TasksReloaded, TryClasses
from pancakes.supervision.supervisor import ANSWERED_S


class Replying(Protocol):
    """What answers requests."""

    def reply(self, request: Request, refusal: Refusal | None = None, result: Any = None) -> None: ...

    def put_off(self, request: Request, reason: str) -> None: ...


class _UnderWay(msgspec.Struct):
    """The reload that is under way.

    Attributes:
        body: what was asked for.
        request: the request for it.
        version: the new version; None: it is being imported.
        taking: whether the services exchange the classes; else they try.
        number: of the question that the services answer now.
        left: the services that have not answered, by name.
        tasks: what the others have said.
    """

    body: Reload
    request: Request
    version: NewVersion | None = None
    taking: bool = False
    number: int = 0
    left: set[str] = set()
    tasks: list[ReloadedTask] = []


class TypeReloading:
    """Has the tasks of an agent go on in the version of their classes that is on disk. All in the root's actor.

    Args:
        root: the root.
        replying: the same root.
        places: the places of its services, by name.
        catalogue: where task types are found.
    """

    def __init__(
        self, root: ActorCore, replying: Replying, places: Mapping[str, ServicePlace], catalogue: Installed
    ) -> None:
        self._root = root
        self._replying = replying
        self._places = places
        self._catalogue = catalogue
        self._now: _UnderWay | None = None
        self._number = 0

    def asked(self, body: Reload, request: Request) -> None:
        """Begin a reload.

        Raises:
            ControlRefusedError: another one is under way, or a service is about to start or to stop.
        """
        if self._now is not None:
            raise ControlRefusedError(f"{self._now.body.type} is being reloaded: try again after that", "busy")
        for place in self._places.values():
            if place.life.state in (State.STARTING, State.STOPPING):
                raise ControlRefusedError(f"{place.address} is {place.life.word}: try again after that", "busy")
        now = self._now = _UnderWay(body, request)
        self._root.after_host(ANSWERED_S, lambda: self._tell_what_waits(now))
        if self._root.kernel.virtual is not None:
            self.imported(import_again(self._catalogue, body.type))
        elif not self._root.kernel.tell(IMPORTER, ImportAgain(self._root, body.type)):
            self._end(Refusal.of(ControlRefusedError(f"the importer of {self._root.agent} is restarting", "busy")))

    def _tell_what_waits(self, now: _UnderWay) -> None:
        if self._now is not now:
            return
        if now.version is None:
            what = f"{now.body.type} is still being imported"
        else:
            services = ", ".join(f"{self._root.agent}/{name}" for name in sorted(now.left))
            does = "begins some tasks again" if now.taking else "asks its tasks what they carry"
            what = f"{services} still {does}"
        self._replying.put_off(now.request, f"{what}; what was asked for is done after that, if it can be")

    def imported(self, message: ImportedAgain) -> None:
        """The new version is there, or cannot be had."""
        now = self._now
        if now is None or now.version is not None:
            return
        if message.version is None:
            self._end(message.refusal)
            return
        now.version = message.version
        self._ask_services(now)

    def _ask_services(self, now: _UnderWay) -> None:
        """Have the services that have such tasks try whether these fit, or exchange their classes."""
        version = now.version
        assert version is not None
        self._number += 1
        now.number, now.tasks = self._number, []
        asked = TryClasses(self._root, now.number, version.classes, version.version)
        concerned = {entry.service for entry in self._root.kernel.tasks.all() if entry.type in version.classes}
        running: dict[str, Reference] = {}
        for name, place in self._places.items():
            if any(it.type in version.classes for it in place.spec.tasks):  # one that begins just now has no tasks yet
                concerned.add(name)
            if place.service is not None:
                running[name] = place.service
        now.left = concerned & running.keys()
        message = TakeClasses(asked, now.request, version.replaces_packets) if now.taking else asked
        for name in sorted(now.left):
            tell(running[name], message)
        self._go_on(now)

    def heard(self, message: TasksReloaded) -> None:
        """A service has answered."""
        now = self._now
        if now is not None and message.number == now.number:
            now.left.discard(message.service)
            now.tasks += message.tasks
            self._go_on(now)

    def service_ended(self, name: str) -> None:
        """A service has ended: it does not answer any more. Its successor begins with the classes of its place."""
        now = self._now
        if now is None or name not in now.left:
            return
        now.left.discard(name)
        address = f"{self._root.agent}/{name}"
        then = "its tasks begin with it in the new classes" if now.taking else "try again"
        refusal = Refusal("failed", f"{address} ended meanwhile: {then}")
        now.tasks.append(ReloadedTask(name, "", now.body.type, "", refusal))
        self._go_on(now)

    def _go_on(self, now: _UnderWay) -> None:
        if now.left:
            return
        refused = [task for task in now.tasks if task.refusal is not None]
        if now.taking or refused or now.body.dry_run:
            self._end(self._refusal_of(now, refused), self._result_of(now))
            return
        version = now.version
        assert version is not None
        version.install()
        for place in self._places.values():
            tasks = tuple(
                replace(it, cls=version.classes[it.type], version=version.version) if it.type in version.classes else it
                for it in place.spec.tasks
            )
            place.spec = replace(place.spec, tasks=tasks)
        fields = {"type": now.body.type, "distribution": version.distribution, "by": now.request.by}
        self._root.event("types_reloaded", before=version.before, version=version.version, **fields)
        now.taking = True
        self._ask_services(now)

    def _refusal_of(self, now: _UnderWay, refused: list[ReloadedTask]) -> Refusal | None:
        first = refused[0].refusal if refused else None
        if first is None:
            return None
        reasons = "; ".join(it.refusal.text for it in refused if it.refusal is not None)
        if now.taking:
            reasons = f"{len(refused)} of {len(now.tasks)} tasks do not run in their new class: {reasons}"
        else:
            reasons = f"no task of {now.body.type} was reloaded, all go on as they are: {reasons}"
        return replace(first, text=reasons)

    def _result_of(self, now: _UnderWay) -> dict[str, Any]:
        version = now.version
        assert version is not None
        return {
            "distribution": version.distribution,
            "before": version.before,
            "version": version.version,
            "tasks": [
                {
                    "service": it.service,
                    "task": it.task,
                    "type": it.type,
                    "state": it.state,
                    "reason": it.refusal.text if it.refusal is not None else "",
                }
                for it in now.tasks
                if it.task
            ],
            "stays": list(version.stays),
        }

    def _end(self, refusal: Refusal | None, result: Any = None) -> None:
        now, self._now = self._now, None
        if now is not None:
            if now.version is not None and not now.taking:
                now.version.forget()
            self._replying.reply(now.request, refusal, result)
