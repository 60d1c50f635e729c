"""The root of an agent: it stands by the services, and is where all control packets come in (paper §3.4).

All control packets to an agent pass here and are numbered, so that contradictory ones are applied in one order. Each is
handed to the service that it concerns; what is about a service itself is done here, because a service that sleeps
cannot wake itself.
"""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace

from pancakes.answers import Answers
from pancakes.control import (
    CONTROLS,
    Adopt,
    Begin,
    Channels,
    Command,
    Configure,
    Describe,
    Follow,
    Forget,
    History,
    Migrate,
    Migrations,
    Reschedule,
    Restart,
    Shutdown,
    Start,
    Stop,
    Traces,
    Unfollow,
)
from pancakes.errors import ClassError, ControlRefused, PancakesError, describe, traceback_of
from pancakes.kernel.component import Component
from pancakes.kernel.dispatch import defer
from pancakes.packet import CORE_CHANNELS, SYSCTRL, Packet, agent_of, join
from pancakes.printable import printable_line
from pancakes.service import WAITING, Service, ServiceSpec
from pancakes.services.network import NetworkService
from pancakes.settings import SettingsError
from pancakes.slot import Request, Slot
from pancakes.suggestion import suggestion
from pancakes.supervision import Next, Supervision
from pancakes.supervisor import STUCK_S
from pancakes.task import Carried

if TYPE_CHECKING:
    from pancakes.kernel.kernel import Kernel
    from pancakes.kernel.timer import OneShot

WATCH_S = 0.02
"""How often, in host time, a service that failed is looked at until the last of its tasks has ended."""
ANSWERED_S = 2.5
"""An asker whose command for a service is not done after so long, in host time, is told what it waits for."""
NETWORK = "network"
LOG_SERVICE = "log"


class ServiceState(Enum):
    """What a service does now."""

    STOPPED = "stopped"
    STARTING = "starting"
    RUNNING = "running"
    STOPPING = "stopping"
    RESTARTING = "restarting"
    FAILED = "failed"


class ServicePlace(msgspec.Struct):
    """The place of one service; it outlives the actors that fill it.

    Attributes:
        busy: whether a command that starts or stops the service is being carried out.
        commands: those that wait for that.
        alarm: what will wake the service, where it was stopped for a time.
        kept: what its tasks carried when it was stopped, by their names.
        keep_state: whether they go on with that when it is started.
    """

    spec: ServiceSpec
    address: str
    supervision: Supervision
    state: ServiceState = ServiceState.STOPPED
    service: Service | None = None
    reason: str = ""
    on_running: list[Callable[[str], None]] = msgspec.field(default_factory=list)
    on_ended: list[Callable[[], None]] = msgspec.field(default_factory=list)
    busy: bool = False
    commands: deque[Callable[[], None]] = msgspec.field(default_factory=deque)
    alarm: OneShot | None = None
    kept: Mapping[str, Carried] = msgspec.field(default_factory=dict)
    keep_state: bool = True


class Root(Component):
    """Starts the services in order, stands by them, and takes all control packets.

    Args:
        kernel: the kernel.
        address: `agent/kernel`.
        specs: the services, in the order in which they start; they stop in reverse.
        identity: what `Describe` says of the agent besides its tasks.
        migrations: what `Migrations` is answered with.
        ready: called in this actor once every service has started all that it should.
        shutdown: ends the agent, after this actor's turn; returns why it cannot. With True it only says that.
    """

    def __init__(
        self,
        kernel: Kernel,
        address: str,
        *,
        specs: Sequence[ServiceSpec],
        identity: Callable[[], dict[str, Any]] = dict,
        migrations: Callable[[], list[dict[str, Any]]] = list,
        ready: Callable[[], None] = lambda: None,
        shutdown: Callable[[bool], str] = lambda dry_run: "it was not started in a way that it could be ended by",
    ) -> None:
        super().__init__(kernel, address)
        self.places = {
            spec.name: ServicePlace(spec, join(self.agent, spec.name), Supervision(spec.restart)) for spec in specs
        }
        self._identity = identity
        self._migrations = migrations
        self._on_ready = ready
        self._shutdown = shutdown
        self._answers = Answers(self)
        self._number = 0
        self._closing = False
        self.ready = False

    def on_start(self) -> None:
        for body in CONTROLS:
            self.subscribe(SYSCTRL, body, self.on_control, keep=WAITING)
        self._start_next(list(self.places.values()))

    def _start_next(self, places: list[ServicePlace]) -> None:
        """Starts the services one after the other: tasks need the devices that come before them."""
        if self._closing:
            return
        if not places:
            self.ready = True
            self.event("ready")
            self._on_ready()
            return
        self.launch(places[0], lambda reason: self._start_next(places[1:]))

    # Services --------------------------------------------------------------------------------------------------

    def launch(self, place: ServicePlace, then: Callable[[str], None] | None = None) -> None:
        """Starts a service; `then` is called once it runs, or with the reason why it does not."""
        place.state = ServiceState.STARTING
        place.reason = ""
        place.supervision.cancel()
        if place.alarm is not None:
            place.alarm.cancel()
        if then is not None:
            place.on_running.append(then)
        spec = place.spec
        kept = place.kept if place.keep_state else None
        try:
            service = self.kernel.spawn(
                spec.cls,
                place.address,
                settings=spec.settings,
                tasks=spec.tasks,
                kept=kept,
                ready=lambda service: self.call(lambda: self._service_ready(place, service)),
                exited=lambda service, error: self.call(lambda: self._service_ended(place, service, error)),
                **spec.arguments,
            )
        except Exception as error:  # what a service's author wrote in __init__ may raise anything
            self._service_failed(place, error, hopeless=isinstance(error, SettingsError))
            return
        # Not before: the next try begins with the same where its constructor fails.
        place.kept, place.keep_state = {}, True
        assert isinstance(service, Service)
        place.service = service

    def halt(self, place: ServicePlace, then: Callable[[], None], request: Request | None = None) -> None:
        """Stops a service and all of its tasks; `then` is called once it has ended.

        Args:
            place: the service's place.
            then: called in this actor.
            request: who asked for it: what was asked for before is begun before; None: it stops at once.
        """
        if place.state in (ServiceState.STOPPED, ServiceState.FAILED) and place.supervision.due_s is None:
            then()
            return
        place.on_ended.append(then)
        if place.service is None:
            # It has failed, and waits for its next try, or for the last of its tasks to end.
            place.supervision.cancel()
            self._rest(place)
            return
        if place.state is ServiceState.STOPPING:
            return
        place.state = ServiceState.STOPPING
        service = place.service
        if request is not None:
            try:
                self.publish(SYSCTRL, Command(request.number, request.cause, ""), to=place.address)
                return
            except PancakesError as error:
                self.log("warning", f"{place.address} ends before it did all that it was asked: {error}")
        service.call(lambda: service.close(lambda: None))

    def close(self, then: Callable[[], None]) -> None:
        """Stops all services, last first; `then` is called in this actor when the last has ended."""
        self._closing = True
        places = list(self.places.values())

        def next_one() -> None:
            if places:
                self.halt(places.pop(), next_one)
            else:
                then()
                self.stop()

        next_one()

    def _service_ready(self, place: ServicePlace, service: Component) -> None:
        if place.service is not service or place.state is not ServiceState.STARTING:
            return
        place.state = ServiceState.RUNNING
        place.supervision.runs(self.kernel.host.now())
        self.event("service_started", service=place.spec.name)
        self._tell_running(place, "")

    def _service_ended(self, place: ServicePlace, service: Component, error: BaseException | None) -> None:
        if place.service is not service:
            return
        self.kernel.stream.unsubscribe(place.address)
        assert isinstance(service, Service)
        for request in service.unheard():
            self.reply(request, f"{place.address} ended before it came to that")
        if error is None:
            place.kept = self._kept_by(service)
        place.service = None
        if error is not None and place.state is not ServiceState.STOPPING:
            self._service_failed(place, error)
            return
        self._rest(place)

    def _kept_by(self, service: Service) -> Mapping[str, Carried]:
        try:
            return service.keep()
        except Exception as error:  # what a service's author wrote may raise anything, and must not end the root
            self.log("error", f"what the tasks of {service.address} carried is lost: {describe(error)}")
            return {}

    def _rest(self, place: ServicePlace) -> None:
        place.state = ServiceState.STOPPED
        self.event("service_stopped", service=place.spec.name)
        self._tell_running(place, f"{place.address} was stopped before it ran")
        waiting, place.on_ended = place.on_ended, []
        for then in waiting:
            then()

    def _service_failed(self, place: ServicePlace, error: BaseException, hopeless: bool = False) -> None:
        text, traceback = describe(error, place.spec.cls), traceback_of(error)
        place.reason = text
        supervision, now_s = place.supervision, self.kernel.host.now()
        following = supervision.ended(True, now_s, self.random, hopeless or isinstance(error, ClassError))
        self.event("service_failed", service=place.spec.name, error=text, then=following.value)
        if self._closing:
            supervision.cancel()
        due_s = supervision.due_s
        if due_s is not None:
            self.after_host(due_s - now_s, lambda: self._try_again(place, due_s))
        if following is Next.RESTART and not self._closing:
            self.log("warning", f"{place.address} is started again {supervision.when(now_s)}: {text}", traceback)
            place.state = ServiceState.RESTARTING
        else:
            place.state = ServiceState.FAILED
            then_again = "" if due_s is None else f", and tried again {supervision.when(now_s)}"
            self.log("error", f"{place.address} is given up{then_again}: {text}", traceback)
            if place.spec.name == LOG_SERVICE:
                # The console is a task of this service, so it is said here.
                line = f"{place.address} is given up, so nothing is shown of what is logged: {text}"
                print(printable_line(line), file=sys.stderr)
        self._tell_running(place, f"{place.address} failed: {text}")

    def _try_again(self, place: ServicePlace, due_s: float) -> None:
        """Starts a failed service anew once the last of its old tasks has ended: no task may run twice."""
        if self._closing or place.supervision.due_s != due_s:
            return
        prefix = place.address + "/"
        old = [it.address for it in self.kernel.registry.components() if it.address.startswith(prefix)]
        if not old:
            self.launch(place)
            return
        self.after_host(WATCH_S, lambda: self._try_again(place, due_s))
        if self.kernel.host.now() > due_s + STUCK_S:
            self._tell_running(place, f"{place.address} waits for the end of {old[0]}, which is stuck")

    def begin_anew(self, place: ServicePlace, then: Callable[[str], None]) -> None:
        """Starts a service because that was asked for, at once; `then` is told as by `launch`."""
        place.on_running.append(then)
        self._try_again(place, place.supervision.hasten(self.kernel.host.now()))

    def _tell_running(self, place: ServicePlace, reason: str) -> None:
        """Tells all that wait for a service to run an empty string, or why it does not."""
        waiting, place.on_running = place.on_running, []
        for then in waiting:
            then(reason)

    # Control ---------------------------------------------------------------------------------------------------

    def on_control(self, packet: Packet) -> None:
        """Numbers a control packet and hands it on."""
        request = self._numbered(packet)
        self._answers.owe(request)
        self._attempt(request, lambda: self._resolve(packet.body, request))

    def _numbered(self, packet: Packet) -> Request:
        self._number += 1
        return Request(packet.source, (packet.source, packet.seq), self._number)

    def _attempt(self, request: Request, do: Callable[[], None]) -> None:
        """Does what was asked for, and answers with the reason where that fails."""
        try:
            do()
        except (PancakesError, ValueError) as error:
            self.reply(request, str(error))
        except Exception as error:  # what a service's author wrote may raise anything, and must not end the root
            text = f"what {request.by} asked for failed: {describe(error)}"
            self.log("error", text, traceback_of(error))
            self.reply(request, text)

    def refuse(self, packet: Packet, reason: str) -> None:
        """Answers a control packet that found no room here; it has its place in the order like any other."""
        self.reply(self._numbered(packet), reason)

    def refuse_all(self, reason: str) -> None:
        """Answers, once this actor has ended, all control packets that it took or that still wait for it."""
        queue = self.actor_inbox.queues.get(SYSCTRL)
        while queue is not None and (packet := queue.take()) is not None:
            # The one that it failed on lies here again, and has its number.
            if not self._answers.owes((packet.source, packet.seq)):
                self.refuse(packet, reason)
        self._answers.refuse_all(reason)

    def reply(self, request: Request, reason: str = "", result: Any = None) -> None:
        """Answers whoever asked; an empty reason means that it has been done."""
        self._answers.give(request, reason, result)

    def _resolve(self, body: Any, request: Request) -> None:
        if isinstance(body, Begin):
            if not 0 <= body.in_s < math.inf:
                raise ControlRefused(f"a mission cannot begin in {body.in_s} s")
            self.kernel.begin(body.in_s)
            self.reply(request)
            return
        if isinstance(body, (Follow, Unfollow)):
            self._hand(NETWORK, "", body, request)
            return
        if isinstance(body, (History, Traces)):
            self._hand(LOG_SERVICE, "", body, request)
            return
        if isinstance(body, Channels):
            self.reply(request, result=self.describe_channels(body.channel))
            return
        if isinstance(body, Shutdown):
            self._end_agent(body, request)
            return
        if isinstance(body, Migrations):
            self.reply(request, result=self._migrations())
            return
        target = body.target
        if isinstance(body, Describe) and not target:
            self._tell_description(request)
            return
        service, task = self.find(target)
        if isinstance(body, (Adopt, Forget)) and task:
            # A task that was given away has no place in its service any more: the service is asked, not the task.
            self._hand(service, "", replace(body, target=task), request)
        elif task:
            self._hand(service, task, body, request)
        else:
            self._control_service(self.places[service], body, request)

    def find(self, target: str) -> tuple[str, str]:
        """Returns the service and the task that a target means; the task is empty where it means a service.

        Raises:
            ControlRefused: it means nothing here, or two things.
        """
        parts = target.split("/")
        if parts and parts[0] == self.agent and len(parts) > 1:
            parts = parts[1:]
        if len(parts) == 2 and parts[0]:
            if parts[0] not in self.places:
                raise ControlRefused(f"{self.agent} has no service {parts[0]!r}, only {', '.join(self.places)}")
            return parts[0], parts[1]
        if len(parts) != 1 or not parts[0]:
            raise ControlRefused(f"{target!r} is no target: it must read task, service/task or service")
        name = parts[0]
        owners = [
            place.spec.name for place in self.places.values() if place.service is not None and place.service.has(name)
        ]
        if len(owners) > 1:
            raise ControlRefused(f"{self.agent} has {name!r} in {' and in '.join(owners)}: say which")
        if owners:
            return owners[0], name
        if name in self.places:
            return name, ""
        for place in self.places.values():
            if place.service is None and name in [spec.name for spec in place.spec.tasks]:
                raise ControlRefused(f"{place.address} is {place.state.value}, and {name} with it")
        known = [
            *self.places,
            *(slot.name for place in self.places.values() if place.service for slot in _slots(place.service)),
        ]
        meant = suggestion(name, known)
        raise ControlRefused(
            f"{self.agent} has no task or service {name!r}" + (f", did you mean {meant!r}?" if meant else "")
        )

    def _hand(self, service: str, task: str, body: Any, request: Request) -> None:
        place = self.places.get(service)
        if place is None or place.service is None or place.state is not ServiceState.RUNNING:
            raise ControlRefused(f"{join(self.agent, service)} is {place.state.value if place else 'not there'}")
        self.publish(SYSCTRL, Command(request.number, request.cause, task, body), to=place.address)
        self._answers.pass_on(request)

    def _control_service(self, place: ServicePlace, body: Any, request: Request) -> None:
        if isinstance(body, (Start, Stop, Restart)):
            self.after_host(ANSWERED_S, lambda: self._tell_what_waits(place, request))
            if place.busy or place.commands:
                # One after the other, so that the last of several that contradict each other is the one that holds.
                place.commands.append(
                    lambda: self._attempt(request, lambda: self._change_service(place, body, request))
                )
            else:
                self._change_service(place, body, request)
        elif isinstance(body, (Reschedule, Configure, Migrate, Adopt, Forget)):
            raise ControlRefused(f"{place.address} is a service: name one of its tasks")
        elif place.service is not None:
            self._hand(place.spec.name, "", body, request)
        else:
            self.reply(request, result=[])

    def _tell_what_waits(self, place: ServicePlace, request: Request) -> None:
        """Tells the asker of a command that takes long why it does, before the asker stops waiting."""
        why = f"{place.address} is {place.state.value}: that waits for a task that is busy, or for the journal"
        self._answers.put_off(request, f"{why}. What was asked for is done after that")

    def _change_service(self, place: ServicePlace, body: Start | Stop | Restart, request: Request) -> None:
        name = place.spec.name
        if isinstance(body, Start):
            if place.state not in (ServiceState.STOPPED, ServiceState.FAILED, ServiceState.RESTARTING):
                raise ControlRefused(f"{place.address} is {place.state.value} already")
            if body.settings is not None:
                raise ControlRefused(f"{place.address} is a service: only a task can be started with other settings")
            if body.dry_run:
                self.reply(request)
                return
            self._tell_asked("start", name, request)
            self.begin_anew(place, self._occupy(place, request))
        elif isinstance(body, Stop):
            self._stop_service(place, body, request)
        elif body.dry_run:
            self.reply(request)
        else:
            place.keep_state = body.keep_state
            self._tell_asked("restart", name, request)
            if name == NETWORK and place.service is not None:
                place.service.stopped_for_s = 0.0  # who is told goodbye shall dial again soon
            self._halt_as_asked(place, request, lambda answer: self.begin_anew(place, answer))

    def _occupy(self, place: ServicePlace, request: Request, answered: bool = False) -> Callable[[str], None]:
        """Lets later commands for a service wait; returns what answers this one and lets them go on."""
        place.busy = True

        def answer(reason: str) -> None:
            if not answered:
                self.reply(request, reason)
            place.busy = False
            self.call(lambda: self._next_command(place))

        return answer

    def _next_command(self, place: ServicePlace) -> None:
        while place.commands and not place.busy:
            place.commands.popleft()()

    def _stop_service(self, place: ServicePlace, body: Stop, request: Request) -> None:
        waits = place.supervision.due_s is not None  # for its next try, which a stop calls off
        if place.state is not ServiceState.RUNNING and not waits:
            raise ControlRefused(f"{place.address} is {place.state.value}, not running")
        if body.for_s is not None and not 0 < body.for_s < math.inf:
            raise ControlRefused(f"{place.address} cannot be stopped for {body.for_s} s")
        elsewhere = agent_of(request.by) != self.agent
        if elsewhere and place.spec.name == NETWORK and body.for_s is None:
            raise ControlRefused(
                f"{place.address} can be stopped from elsewhere only for a time (for_s): nobody could start it again"
            )
        reason = place.service.refuse_stop() if place.service is not None else ""
        if reason:
            raise ControlRefused(reason)
        if body.dry_run:
            self.reply(request)
            return
        if place.service is not None:
            place.service.stopped_for_s = body.for_s
        self._tell_asked("stop", place.spec.name, request)
        wakes_s = self.now() + body.for_s if body.for_s is not None else None

        def halted(answer: Callable[[str], None]) -> None:
            # Not before: to stop may take longer than the sleep that was asked for, and there is nobody to wake yet.
            if wakes_s is not None:
                place.alarm = self.after(max(0.0, wakes_s - self.now()), lambda: self._wake(place))
            answer("")

        self._halt_as_asked(place, request, halted)

    def _halt_as_asked(
        self, place: ServicePlace, request: Request, then: Callable[[Callable[[str], None]], None]
    ) -> None:
        """Stops a service for who asked for it; `then` is called with what answers."""
        if place.spec.name != NETWORK:
            answer = self._occupy(place, request)
            self.halt(place, lambda: then(answer), request)
            return
        # The answer has to leave before the way out is closed. It leaves at the end of this turn, and the service may
        # have its own turn before that, in another thread.
        self.reply(request)
        answered = self._occupy(place, request, answered=True)
        defer(lambda: self.halt(place, lambda: then(answered), request))

    def _wake(self, place: ServicePlace) -> None:
        if place.state is ServiceState.STOPPED and not self._closing:
            self.event("asked", what="wake", service=place.spec.name, by=self.address)
            self.launch(place)

    def _end_agent(self, body: Shutdown, request: Request) -> None:
        reason = self._shutdown(True)
        if reason:
            raise ControlRefused(f"{self.agent} cannot be ended: {reason}")
        if not body.dry_run:
            self.event("asked", what="shutdown", by=request.by, number=request.number)
        # The answer has to leave before the way out is closed.
        self.reply(request)
        if not body.dry_run:
            self._shutdown(False)

    def _tell_asked(self, what: str, service: str, request: Request) -> None:
        self.event("asked", what=what, service=service, by=request.by, number=request.number)

    # Describing ------------------------------------------------------------------------------------------------

    def _tell_description(self, request: Request) -> None:
        """Answers `Describe` in three turns: pages ask it each second, and in one it would put off ticks by 1 ms."""
        description: dict[str, Any] = {}

        def tell_parts() -> None:
            description.update(self._describe_parts())
            self.call(lambda: self._attempt(request, tell_identity))

        def tell_identity() -> None:
            description.update(self._identity())
            self.call(lambda: self.reply(request, result=description))

        # What a packet's handler asks for is still done in its turn, what is asked for from there on in the next.
        self.call(lambda: self._attempt(request, tell_parts))

    def describe(self) -> dict[str, Any]:
        """Returns what is to be known about the agent, as plain values."""
        return {**self._describe_parts(), **self._identity()}

    def _describe_parts(self) -> dict[str, Any]:
        return {
            "agent": self.agent,
            "ready": self.ready,
            "mission_s": self.kernel.mission.now(),
            "held": self.kernel.mission.held,
            "channels": self.kernel.stream.channels(),
            "devices": self.kernel.registry.device_types(),
            "services": [self.describe_service(place) for place in self.places.values()],
            "tasks": [
                place.service.describe_task(slot)
                for place in self.places.values()
                if place.service is not None
                for slot in _slots(place.service)
            ],
            "dead_letters": self.kernel.letters.count,
            "undelivered": self.kernel.stream.undelivered,
        }

    def describe_channels(self, channel: str) -> list[dict[str, Any]]:
        """Returns what is to be known about one channel, or about all, as plain values.

        Raises:
            UnknownChannel: there is no such channel.
        """
        stream = self.kernel.stream
        network = self.places[NETWORK].service
        return [
            {
                "agent": self.agent,
                "channel": name,
                "core": name in CORE_CHANNELS,
                "subscribers": stream.describe(name),
                "followers": network.followers(name) if isinstance(network, NetworkService) else [],
            }
            for name in ([channel] if channel else stream.channels())
        ]

    def describe_service(self, place: ServicePlace) -> dict[str, Any]:
        """Returns what is to be known about a service, as plain values."""
        return {
            "agent": self.agent,
            "service": place.spec.name,
            "type": place.spec.cls.__name__,
            "state": place.state.value,
            "reason": place.reason,
            **place.supervision.describe(self.kernel.host.now()),
            "tasks": [slot.name for slot in _slots(place.service)] if place.service is not None else [],
        }


def _slots(service: Service) -> list[Slot]:
    # The service changes its table in its own actor; a copy made in one step is a consistent picture.
    return list(service.slots.values())
