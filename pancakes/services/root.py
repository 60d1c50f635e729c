"""The root of an agent: it supervises the services and receives all control packets (paper §3.4).

All control packets to an agent pass here and are numbered, so contradictory ones are applied in one order. Each is
handed to the service that it concerns. What is about a service itself is done here, because a service that sleeps
cannot wake itself. `Measuring` answers `Measure`: it notes all counters, and again after the time that was asked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from pancakes.control import (
    CONTROLS,
    LONGEST_S,
    SHORTEST_S,
    Adopt,
    Allocate,
    Begin,
    Channels,
    Checkpoints,
    Command,
    Create,
    Describe,
    EndHalt,
    Follow,
    Forget,
    Guarding,
    Halt,
    History,
    Measure,
    Migrations,
    Refusal,
    Reload,
    ReloadKeys,
    Restart,
    Revive,
    Shutdown,
    Start,
    Stop,
    Take,
    Traces,
    Unfollow,
)
from pancakes.durable.host_state import ImportedAgain, processor_time_s
from pancakes.durable.installed import Installed
from pancakes.errors import ControlRefusedError, PancakesError, describe, traceback_of
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.dispatchers import defer
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.registry import TaskEntry
from pancakes.kernel.timer import NOTHING, MeterReading, TurnMeter
from pancakes.packet import CORE_CHANNELS, SYSCTRL, Packet, agent_of, join
from pancakes.security.access import right_of
from pancakes.services.halt import HaltKeeping, Halts, PeerMet
from pancakes.services.service_supervisor import LOG_SERVICE, MissionStart, ServiceKeeper, ServicePlace, ServiceSpec
from pancakes.supervision.lifecycle import Request, StartAsked, State, StopAsked
from pancakes.supervision.messages import (
    GUARDIAN,
    AskedOfGuardian,
    Close,
    GuardianAnswers,
    NoRoom,
    ServiceEnded,
    ServiceReady,
    TasksReloaded,
)
from pancakes.supervision.slots import OF_TASKS_ONLY, WAITING, describe_task
from pancakes.supervision.supervisor import ANSWERED_S, Answers
from pancakes.util.cpu import host_id, processor_count, processor_times, yardstick_s
from pancakes.util.text import fault_of_name, suggestion

if TYPE_CHECKING:
    from pancakes.services.reloading import TypeReloading


@dataclass(frozen=True)
class _Mark:
    """All that is counted, at one moment."""

    host_s: float
    processor_s: float
    busy_s: float
    whole_s: float
    yardstick_s: float
    battery: float | None
    meter: MeterReading
    missed: dict[tuple[str, str], int]


class Measuring:
    """A part of the root: the measurements that are under way, in its actor.

    Args:
        root: the root.
        battery: returns what is left of the agent's battery; None: it has none, or has not read it.
    """

    def __init__(self, root: ActorCore, battery: Callable[[], float | None]) -> None:
        self._root = root
        self._kernel: Kernel = root.kernel
        self._battery = battery
        self._under_way = 0

    def begin(self, for_s: float, done: Callable[[dict[str, Any]], None]) -> None:
        """Begin a measurement.

        Args:
            for_s: how long it takes, in host time.
            done: called with its result, in the root's actor.

        Raises:
            ControlRefusedError: it takes no time, or too long; or the agent lives in virtual time.
        """
        if not (SHORTEST_S <= for_s <= LONGEST_S) or math.isnan(for_s):
            raise ControlRefusedError(
                f"a measurement takes from {SHORTEST_S:g} to {LONGEST_S:g} s, not {for_s:g} s", "invalid"
            )
        if self._kernel.virtual is not None:
            raise ControlRefusedError(
                f"{self._kernel.agent} lives in virtual time, in which no processor time is measured", "unsupported"
            )
        if self._kernel.meter is None:
            self._kernel.meter = TurnMeter()
        self._under_way += 1
        self._root.after_host(for_s, partial(self._end, self._kernel.meter, self._mark(self._kernel.meter), done))

    def _mark(self, meter: TurnMeter) -> _Mark:
        busy_s, whole_s = processor_times()
        missed = {(it.component.address, it.method): it.missed_total for it in self._kernel.task_timers.all()}
        quick_s = min(yardstick_s(), yardstick_s())
        now_s, battery = self._kernel.host.now(), self._battery()
        return _Mark(now_s, processor_time_s(), busy_s, whole_s, quick_s, battery, meter.read(), missed)

    def _end(self, meter: TurnMeter, before: _Mark, done: Callable[[dict[str, Any]], None]) -> None:
        after = self._mark(meter)
        self._under_way -= 1
        if not self._under_way:
            self._kernel.meter = None
        turns = {
            address: (count - was[0], used_s - was[1])
            for address, (count, used_s) in after.meter.turns.items()
            for was in (before.meter.turns.get(address, (0, 0.0)),)
        }
        whole_s = after.whole_s - before.whole_s
        done(
            {
                "agent": self._kernel.agent,
                "speed": self._kernel.mission.speed,
                "span_s": after.host_s - before.host_s,
                "processor_s": after.processor_s - before.processor_s,
                "turns": sum(count for count, _ in turns.values()),
                "turn_s": sum(used_s for _, used_s in turns.values()),
                "host": {
                    "id": host_id(),
                    "processors": processor_count(),
                    "busy_share": min(1.0, (after.busy_s - before.busy_s) / whole_s) if whole_s > 0.0 else 0.0,
                    "yardstick_s": min(before.yardstick_s, after.yardstick_s),
                },
                "battery": {"before": before.battery, "after": after.battery},
                "tasks": [self._task(entry, turns, before, after) for entry in self._kernel.tasks.all()],
            }
        )

    def _task(
        self, entry: TaskEntry, turns: dict[str, tuple[int, float]], before: _Mark, after: _Mark
    ) -> dict[str, Any]:
        count, used_s = turns.get(entry.address, (0, 0.0))
        timers = []
        for timer in self._kernel.task_timers.of(entry.address):
            key = (entry.address, timer.method)
            was, now = before.meter.ticks.get(key, NOTHING), after.meter.ticks.get(key, NOTHING)
            timers.append(
                {
                    "timer": timer.method,
                    "rate_hz": timer.rate_hz,
                    "ticks": now[0] - was[0],
                    # It counts from 0 again if the task was restarted meanwhile.
                    "missed": max(0, after.missed.get(key, 0) - before.missed.get(key, 0)),
                    "tick_s": now[1] - was[1],
                    "tick_s2": now[2] - was[2],
                }
            )
        return {
            "service": entry.service,
            "task": entry.name,
            "type": entry.type,
            "state": entry.life.word,
            "task_id": entry.task_id,
            "turns": count,
            "turn_s": used_s,
            "timers": timers,
        }


NETWORK = "network"
CLIENT_SERVICE = "client"


class Root(ActorCore):
    """Starts the services in order, stands by them, and takes all control packets.

    Args:
        kernel: the kernel.
        address: `agent/kernel`.
        specs: the services, in the order in which they start; they stop in reverse.
        identity: what `Describe` says of the agent besides its tasks.
        configuration: what its configuration comes to.
        migrations: what `Migrations` is answered with.
        services_in_doubt: the services that have something to decide about a task of this name.
        halts: what the agent knows of halts.
        catalogue: where task types are found.
        ready: called in this actor once every service has started all that it should.
        mission_start: has the mission begin before the services start; None: it has.
        shutdown: ends the agent, after this actor's turn; returns why it cannot. With True it only says that.
    """

    def __init__(
        self,
        kernel: Kernel,
        address: str,
        *,
        specs: Sequence[ServiceSpec],
        identity: Callable[[], dict[str, Any]] = dict,
        configuration: Callable[[], dict[str, Any]] = dict,
        migrations: Callable[[], list[dict[str, Any]]] = list,
        services_in_doubt: Callable[[str], Collection[str]] = lambda name: (),
        halts: Halts,
        catalogue: Installed,
        ready: Callable[[], None] = lambda: None,
        mission_start: MissionStart | None = None,
        shutdown: Callable[[bool], str] = lambda dry_run: "it was not started in a way that it could be ended by",
    ) -> None:
        super().__init__(kernel, address)
        self._services = ServiceKeeper(self, self, specs, self._become_ready)
        self._identity = identity
        self._configuration = configuration
        self._migrations = migrations
        self._services_in_doubt = services_in_doubt
        self._on_ready = ready
        self._mission_start = mission_start
        self._shutdown = shutdown
        self._answers = Answers(self)
        self._measuring = Measuring(self, lambda: self._identity().get("battery_level"))
        self._halting = HaltKeeping(self, halts, self.reply)
        self._catalogue = catalogue
        self._reloading_made: TypeReloading | None = None
        self._number = 0
        self.ready = False

    @property
    def places(self) -> dict[str, ServicePlace]:
        """The places of its services, by name."""
        return self._services.places

    def on_start(self) -> None:
        for body in CONTROLS:
            self.subscribe(SYSCTRL, body, self.on_control, queue=WAITING)
        self._halting.begin()
        if self._mission_start is None:
            self._services.start_next()
        else:
            self._mission_start.begin(self, self._services.start_next)

    def _become_ready(self) -> None:
        self.ready = True
        self.event("ready")
        self._halting.ready()
        if self._mission_start is not None:
            self._mission_start.tell(self)
        self._on_ready()

    def take_message(self, message: Any) -> Any:
        match message:
            case ServiceReady():
                self._services.service_ready(message)
            case ServiceEnded():
                self._services.service_ended(message)
                if self._reloading_made is not None:
                    self._reloading_made.service_ended(message.service.name)
            case TasksReloaded():
                self._reloading().heard(message)
            case ImportedAgain():
                self._reloading().imported(message)
            case NoRoom():
                # It has its place in the order like any other.
                self.reply(self._numbered(message.packet), message.refusal)
            case PeerMet():
                self._halting.met(message.peer)
            case GuardianAnswers():
                self.reply(message.request, message.refusal, message.result)
            case Close():
                self._services.close()
            case _:
                return super().take_message(message)
        return None

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
        """Do what was asked for, and answer with the reason if that fails."""
        try:
            do()
        except (PancakesError, ValueError) as error:
            self.reply(request, Refusal.of(error))
        except Exception as error:  # what a service's author wrote may raise anything, and must not end the root
            text = f"what {request.by} asked for failed: {describe(error)}"
            self.log("error", text, traceback_of(error))
            self.reply(request, Refusal("failed", text))

    def refuse_all(self, reason: str) -> None:
        """Answer, once this actor has ended, all control packets that it took or that still wait for it."""
        queue = self.actor_inbox.queues.get(SYSCTRL)
        for packet in queue.drain() if queue is not None else ():
            # The one that it failed on lies here again, and has its number.
            if not self._answers.owes((packet.source, packet.seq)):
                self.reply(self._numbered(packet), Refusal("failed", reason))
        self._answers.refuse_all(reason)

    def reply(self, request: Request, refusal: Refusal | None = None, result: Any = None) -> None:
        """Answer the sender of a request; without a refusal, it has been done."""
        self._answers.give(request, refusal, result)

    def put_off(self, request: Request, reason: str) -> None:
        """Tell the sender of a request what it waits for; what becomes of it in the end is said on `log`."""
        self._answers.put_off(request, reason)

    def _resolve(self, body: Any, request: Request) -> None:
        target = getattr(body, "target", "")
        if isinstance(body, Revive):  # of a task that need not be known here
            service, task = body.service, body.task_id.rpartition("/")[2]
        elif isinstance(body, Create):
            service, task = self._place_of_new(target)
        else:
            service, task = self.find(target) if target else ("", "")
        self._must_be_allowed(body, request, service, task)
        if isinstance(body, Revive):
            self._hand(service, "", body, request)
            return
        if isinstance(body, Begin):
            if not 0 <= body.in_s < math.inf:
                raise ControlRefusedError(f"a mission cannot begin in {body.in_s} s", "invalid")
            self.kernel.begin(body.in_s)
            self.reply(request)
            return
        if isinstance(body, (Allocate, Follow, Unfollow, ReloadKeys)):
            self._hand(NETWORK, "", body, request)
            return
        if isinstance(body, (History, Traces)):
            self._hand(LOG_SERVICE, "", body, request)
            return
        if isinstance(body, Channels):
            self.reply(request, result=self.describe_channels(body.channel))
            return
        if isinstance(body, Measure):
            self._measuring.begin(body.for_s, lambda result: self.reply(request, result=result))
            return
        if isinstance(body, Reload):
            self._reloading().asked(body, request)
            return
        if isinstance(body, Shutdown):
            self._end_agent(body, request)
            return
        if isinstance(body, (Halt, EndHalt)):
            self._halting.asked(body, request)
            return
        if isinstance(body, (Guarding, Checkpoints, Take)):
            self._hand_to_guardian(body, request)
            return
        if isinstance(body, Migrations):
            self.reply(request, result=self._migrations())
            return
        if isinstance(body, Describe) and not target:
            self._tell_description(body, request)
            return
        if not target:
            self.find(target)
        if isinstance(body, (Adopt, Create, Forget)) and task:
            # A task that was given away, or must still begin, has no place in its service: the service is asked.
            self._hand(service, "", replace(body, target=task), request)
        elif task:
            self._hand(service, task, body, request)
        else:
            self._control_service(self.places[service], body, request)

    def _reloading(self) -> TypeReloading:
        if self._reloading_made is None:
            from pancakes.services.reloading import TypeReloading  # few agents are ever asked

            self._reloading_made = TypeReloading(self, self, self.places, self._catalogue)
        return self._reloading_made

    def _hand_to_guardian(self, body: Guarding | Checkpoints | Take, request: Request) -> None:
        if not self.kernel.tell(GUARDIAN, AskedOfGuardian(body, request, self)):
            raise ControlRefusedError(f"the registrar of {self.agent} is restarting", "busy")

    def _must_be_allowed(self, body: Any, request: Request, service: str, task: str) -> None:
        """Look whether a peer may ask for this.

        Raises:
            ControlRefusedError: it lacks the right; the message names it, and the command that grants it.
        """
        peer, right = agent_of(request.by), right_of(body)
        if right == "look" or not service:
            on = (self.agent, f"{self.agent}/", *filter(None, (getattr(body, "channel", ""),)))
        else:
            on = (join(self.agent, service, task) if task else f"{join(self.agent, service)}/",)
        if fault := self.kernel.access.fault(peer, right, *on):
            raise ControlRefusedError(fault, "forbidden")

    def find(self, target: str) -> tuple[str, str]:
        """Return the service and the task that a target means; the task is empty where it means a service.

        Raises:
            ControlRefusedError: it means nothing here, or two things.
        """
        parts = target.split("/")
        if parts and parts[0] == self.agent and len(parts) > 1:
            parts = parts[1:]
        if len(parts) == 2 and parts[0]:
            if parts[0] not in self.places:
                raise ControlRefusedError(
                    f"{self.agent} has no service {parts[0]!r}, only {', '.join(self.places)}", "not_found"
                )
            return parts[0], parts[1]
        if len(parts) != 1 or not parts[0]:
            raise ControlRefusedError(f"{target!r} is no target: it must read task, service/task or service", "invalid")
        name = parts[0]
        tasks = self.kernel.tasks
        # What was given away and stands in doubt is in no table of tasks any more, nor is what came here and was lost.
        doubted = self._services_in_doubt(name)
        owners = [
            service
            for service, place in self.places.items()
            if place.service is not None and (tasks.get(service, name) is not None or service in doubted)
        ]
        if len(owners) > 1:
            raise ControlRefusedError(f"{self.agent} has {name!r} in {' and in '.join(owners)}: say which", "ambiguous")
        if owners:
            return owners[0], name
        if name in self.places:
            return name, ""
        for place in self.places.values():
            if name in [spec.name for spec in place.spec.tasks]:
                raise ControlRefusedError(f"{place.address} is {place.life.word}, and {name} with it")
        meant = suggestion(name, [*self.places, *(entry.name for entry in tasks.all())])
        raise ControlRefusedError(
            f"{self.agent} has no task or service {name!r}" + (f", did you mean {meant!r}?" if meant else ""),
            "not_found",
        )

    def _place_of_new(self, target: str) -> tuple[str, str]:
        """Return the service and the name that a target means of a task that must still begin.

        Raises:
            ControlRefusedError: it is no target of a task.
        """
        parts = target.removeprefix(f"{self.agent}/").split("/")
        if len(parts) > 2 or not all(parts):
            raise ControlRefusedError(f"{target!r} is no target: it must read task or service/task", "invalid")
        if fault := fault_of_name(parts[-1]):
            raise ControlRefusedError(fault, "forbidden")
        return (parts[0] if len(parts) == 2 else CLIENT_SERVICE), parts[-1]

    def _hand(self, service: str, task: str, body: Any, request: Request) -> None:
        place = self.places.get(service)
        if place is None or place.service is None or place.life.state is not State.RUNNING:
            raise ControlRefusedError(f"{join(self.agent, service)} is {place.life.word if place else 'not there'}")
        self.publish(SYSCTRL, Command(request.number, request.cause, task, body), to=place.address)
        self._answers.pass_on(request)

    def _control_service(self, place: ServicePlace, body: Any, request: Request) -> None:
        if isinstance(body, (Start, Stop, Restart)):
            self.after_host(ANSWERED_S, lambda: self._tell_what_waits(place, request))
            if place.busy or place.commands:
                # One after the other, so that the last of several that contradict each other is the one that holds.
                place.commands = (*place.commands, (body, request))
            else:
                self._change_service(place, body, request)
        elif type(body) in OF_TASKS_ONLY:
            raise ControlRefusedError(f"{place.address} is a service: name one of its tasks", "unsupported")
        elif place.service is not None:
            self._hand(place.spec.name, "", body, request)
        else:
            self.reply(request, result=[])

    def _tell_what_waits(self, place: ServicePlace, request: Request) -> None:
        """Tell the asker of a command that takes long why it does, before the asker stops waiting."""
        why = f"{place.address} is {place.life.word}: that waits for a task that is busy, or for the journal"
        self._answers.put_off(request, f"{why}. What was asked for is done after that")

    def _change_service(self, place: ServicePlace, body: Start | Stop | Restart, request: Request) -> None:
        name, life = place.spec.name, place.life
        if isinstance(body, Start):
            if life.state not in (State.STOPPED, State.FAILED, State.RESTARTING):
                raise ControlRefusedError(f"{place.address} is {life.word} already")
            if body.settings is not None:
                raise ControlRefusedError(
                    f"{place.address} is a service: only a task can be started with other settings", "unsupported"
                )
        elif isinstance(body, Stop):
            self._refuse_stop(place, body, request)
        if body.dry_run:
            self.reply(request)
            return
        self._tell_asked(type(body).__name__.lower(), name, request)
        if isinstance(body, Start):
            self._services.feed(place, StartAsked(request))
            return
        if isinstance(body, Restart):
            place.fresh = not body.keep_state
            place.for_s = 0.0  # a peer that hears goodbye dials again soon
        else:
            place.for_s = body.for_s
            place.wakes_s = self.now() + body.for_s if body.for_s is not None else None
        again = isinstance(body, Restart)
        how_long = f", for {body.for_s:g} s" if isinstance(body, Stop) and body.for_s is not None else ""
        reason = f"{'restart ' if again else ''}asked for by {request.by}{how_long}"
        event = StopAsked(request, reason, again)
        if name != NETWORK:
            self._services.feed(place, event)
            return
        # The answer has to leave before the way out is closed. It leaves at the end of this turn, and the service may
        # have its own turn before that, in another thread.
        self.reply(request)
        place.told = request.number
        defer(lambda: self._services.feed(place, event))

    def _refuse_stop(self, place: ServicePlace, body: Stop, request: Request) -> None:
        if body.then:
            raise ControlRefusedError(
                f"{place.address} is a service: only a task can be followed by one", "unsupported"
            )
        due = place.life.restarts.due_s is not None  # its next try, which a stop calls off
        if place.life.state not in (State.RUNNING, State.FAILED) and not due:
            raise ControlRefusedError(f"{place.address} is {place.life.word}, not running")
        if body.for_s is not None and not 0 < body.for_s < math.inf:
            raise ControlRefusedError(f"{place.address} cannot be stopped for {body.for_s} s", "invalid")
        elsewhere = agent_of(request.by) != self.agent
        if elsewhere and place.spec.name == NETWORK and body.for_s is None:
            raise ControlRefusedError(
                f"{place.address} can be stopped from elsewhere only for a time (for_s):"
                " no packet from elsewhere could start it again"
            )
        spec = place.spec
        if place.service is not None:
            reason = spec.cls.refuse_stop(self.kernel, spec.name, spec.arguments, body.for_s)
            if reason:
                raise ControlRefusedError(reason)

    def next_command(self, place: ServicePlace) -> None:
        """Carry out the commands for a service that waited behind another."""
        while place.commands and not place.busy:
            (body, request), *later = place.commands
            place.commands = tuple(later)
            self._attempt(request, partial(self._change_service, place, body, request))

    def _end_agent(self, body: Shutdown, request: Request) -> None:
        reason = self._shutdown(True)
        if reason:
            raise ControlRefusedError(f"{self.agent} cannot be ended: {reason}")
        if not body.dry_run:
            self.event("asked", what="shutdown", by=request.by, number=request.number)
        # The answer has to leave before the way out is closed.
        self.reply(request)
        if not body.dry_run:
            self._shutdown(False)

    def _tell_asked(self, what: str, service: str, request: Request) -> None:
        self.event("asked", what=what, service=service, by=request.by, number=request.number)

    # Describing ------------------------------------------------------------------------------------------------

    def _tell_description(self, body: Describe, request: Request) -> None:
        """Answer `Describe` in three turns: pages ask it each second, and in one it would put off ticks by 1 ms."""
        description: dict[str, Any] = {}

        def tell_parts() -> None:
            description.update(self._describe_parts())
            self.call(lambda: self._attempt(request, tell_identity))

        def tell_identity() -> None:
            description.update(self._identity())
            if body.config:
                description.update(self._configuration())
            self.call(lambda: self.reply(request, result=description))

        # What a packet's handler asks for is still done in its turn, what is asked for from there on in the next.
        self.call(lambda: self._attempt(request, tell_parts))

    def describe(self) -> dict[str, Any]:
        """Describe the agent, as plain values."""
        return {**self._describe_parts(), **self._identity()}

    def _describe_parts(self) -> dict[str, Any]:
        return {
            "agent": self.agent,
            "ready": self.ready,
            "mission_s": self.kernel.mission.now(),
            "utc_s": self.kernel.utc_s(),
            "held": self.kernel.mission.held,
            "channels": self.kernel.stream.channels(),
            "devices": self.kernel.registry.device_types(),
            "services": [self.describe_service(place) for place in self.places.values()],
            "tasks": [
                describe_task(self.kernel, entry) for name in self.places for entry in self.kernel.tasks.of(name)
            ],
            "dead_letters": self.kernel.dead_letters.count,
            "undelivered": self.kernel.stream.undelivered,
        }

    def describe_channels(self, channel: str) -> list[dict[str, Any]]:
        """Describe one channel, or all, as plain values.

        Raises:
            UnknownChannelError: there is no such channel.
        """
        stream = self.kernel.stream
        return [
            {
                "agent": self.agent,
                "channel": name,
                "core": name in CORE_CHANNELS,
                "subscribers": stream.describe(name),
                "followers": stream.followers(name),
            }
            for name in ([channel] if channel else stream.channels())
        ]

    def describe_service(self, place: ServicePlace) -> dict[str, Any]:
        """Describe a service, as plain values."""
        return {
            "agent": self.agent,
            "service": place.spec.name,
            "type": place.spec.cls.__name__,
            "state": place.life.word,
            "reason": place.life.reason,
            **place.life.restarts.describe(self.kernel.host.now()),
            "tasks": [entry.name for entry in self.kernel.tasks.of(place.spec.name)],
        }
