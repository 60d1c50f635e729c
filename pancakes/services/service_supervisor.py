"""Start an agent's services in order, supervise them, and stop them in reverse (paper §3.4).

All runs in the root's actor. Before the first service starts, `MissionStart` takes the mission time from the fleet,
so no task ever sees the time jump. If the root itself fails, a `Closer` stops the services in its place.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Protocol, assert_never

import msgspec

from pancakes.control import Command, Refusal
from pancakes.errors import ClassError, MissingExtraError, PancakesError, describe, traceback_of
from pancakes.kernel.actor import ActorCore, core_of
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import Reference, tell
from pancakes.kernel.timer import OneShot
from pancakes.mesh.clock_sync import PeerMission, mission_of_fleet
from pancakes.mesh.mesh import Mesh
from pancakes.packet import SYSCTRL, join
from pancakes.service import Service
from pancakes.settings import SettingsError
from pancakes.supervision.lifecycle import (
    Admitted,
    Answer,
    Began,
    Event,
    Finished,
    LeaveRefused,
    Life,
    News,
    Request,
    StartAsked,
    State,
    StopAsked,
    Tell,
    Written,
)
from pancakes.supervision.messages import Carried, Close, ServiceEnded, ServiceReady
from pancakes.supervision.restart import Restarts, RestartSpec
from pancakes.supervision.slots import STUCK_S
from pancakes.supervision.supervisor import Keeper
from pancakes.task import TaskSpec
from pancakes.util.text import printable_line


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
    settings: Mapping[str, Any]
    tasks: tuple[TaskSpec, ...]
    restart: RestartSpec
    arguments: Mapping[str, Any]


MISSION_LOOK_S: Final = 0.02
"""How often it is looked whether the fleet is known by now, in host time."""
MISSION: Final = "mission"
"""A peer is believed the time of the mission that has the right `publish` on this."""


class MissionStart:
    """Has an agent that has just begun take the mission's time from its fleet, before any of its services starts.

    So no task ever sees the time jump: timers, commands and what a task remembers are in the fleet's time from the
    first tick on. A mission that runs is not changed. Leases rest on the host clock, which nothing here touches. In the
    actor of the root.

    Args:
        kernel: the agent's kernel, whose mission is held.
        mesh: its links.
        hold: whether the mission waits for `Begin` where it runs nowhere yet.
        join_s: how long the agent waits for its fleet at most, in host time.
        comes_back: whether it has been in a fleet before: where it dials no other agent, it waits to be dialled.
    """

    def __init__(self, kernel: Kernel, mesh: Mesh, hold: bool, join_s: float, comes_back: bool) -> None:
        self._kernel = kernel
        self._mesh = mesh
        self._hold = hold
        self._until_s = kernel.host.now() + join_s
        self._comes_back = comes_back
        self._tell: Callable[[ActorCore], None] = lambda root: None

    def begin(self, root: ActorCore, then: Callable[[], None]) -> None:
        """Look at the fleet until its mission is known, or need not be waited for any more; then it goes on.

        Args:
            root: the root of the agent.
            then: goes on.
        """
        kernel = self._kernel
        if kernel.stopping:
            return
        if kernel.mission.held:
            missions, awaited = self._mesh.clocks.missions(self._may_say)
            left_s = self._until_s - kernel.host.now()
            if left_s > 0 and (awaited or self._awaits_peers()):
                root.after_host(min(MISSION_LOOK_S, left_s), lambda: self.begin(root, then))
                return
            self._decide(missions)
        then()

    def tell(self, root: ActorCore) -> None:
        """Tell on `log` how it came out, once there is a Log Service to hear it."""
        self._tell(root)

    def _may_say(self, peer: str) -> bool:
        return not self._kernel.access.fault(peer, "publish", MISSION)

    def _awaits_peers(self) -> bool:
        return self._mesh.awaits_peers() or (self._comes_back and not self._mesh.neighbours())

    def _decide(self, missions: tuple[PeerMission, ...]) -> None:
        kernel, speed = self._kernel, self._kernel.mission.speed
        found = mission_of_fleet(missions, speed)
        if found is not None:
            kernel.join(found.zero_s)
            bound_s = round(found.bound_s * speed, 6)
            self._tell = lambda root: root.event("mission_joined", peer=found.peer, bound_s=bound_s)
            return
        if missions:
            other = missions[0]
            text = (
                f"the mission of {other.peer} runs at speed {other.speed:g} and here at {speed:g}: its time is not"
                " taken. Set [clock] speed alike in both files, if it should be one mission"
            )
            self._tell = lambda root: root.log("warning", text)
        if not self._hold:
            kernel.begin(0.0)


WATCH_S: Final = 0.02
"""How often, in host time, a service that must start is looked at until the last of its old tasks has ended."""
LOG_SERVICE: Final = "log"


class ServicePlace(msgspec.Struct):
    """The place of one service; it outlives the actors that fill it.

    Attributes:
        life: how far the service is.
        service: its actor; None: none runs.
        kept: what its tasks carried when it was stopped, by their names.
        fresh: whether they begin as the configuration says, whatever they carried.
        traceback: of its last failure.
        told: the number of the request that is being carried out, where its sender has had the answer before; 0: none.
        commands: the control packets that wait until the one that is being carried out is done, and their requests.
        for_s: while it stops: after how many seconds of mission time it starts again; None: it does not by itself.
        wakes_s: the mission time at which it does.
        alarm: what starts it then.
    """

    spec: ServiceSpec
    address: str
    life: Life
    service: Reference | None = None
    kept: Mapping[str, Carried] = msgspec.field(default_factory=dict)
    fresh: bool = False
    traceback: str = ""
    told: int = 0
    commands: tuple[tuple[Any, Request], ...] = ()
    for_s: float | None = None
    wakes_s: float | None = None
    alarm: OneShot | None = None

    @property
    def busy(self) -> bool:
        """Whether a command that starts or stops the service is being carried out."""
        return self.life.asker is not None or bool(self.told)


class Answering(Protocol):
    """What the keeper needs of the root besides what every component has."""

    def reply(self, request: Request, refusal: Refusal | None = None, result: Any = None) -> None: ...

    def put_off(self, request: Request, reason: str) -> None: ...

    def next_command(self, place: ServicePlace) -> None: ...


class ServiceKeeper:
    """Keeps the services of one agent, each at its place. All in the root's actor.

    Args:
        root: the root, in whose name services are started.
        answering: the same root.
        specs: the services, in the order in which they start; they stop in reverse.
        ready: called once every service has started all that it should.
    """

    def __init__(
        self, root: ActorCore, answering: Answering, specs: Sequence[ServiceSpec], ready: Callable[[], None]
    ) -> None:
        self._root = root
        self._answering = answering
        self._ready = ready
        self.places = {spec.name: _place(root.agent, spec) for spec in specs}
        self.closing = False
        self._keeper: Keeper[ServicePlace] = Keeper(root, self)
        self._to_start = list(self.places.values())
        self._starts: ServicePlace | None = None
        self._to_close: list[ServicePlace] = []
        self._closes: ServicePlace | None = None

    def feed(self, place: ServicePlace, event: Event) -> None:
        """Feed an event to the life of a service, and carry out what follows."""
        self._keeper.feed(place, event)

    def start_next(self) -> None:
        """Start the services one after the other: tasks need the devices that come before them."""
        if self.closing:
            return
        if not self._to_start:
            self._starts = None
            self._ready()
            return
        self._starts = self._to_start.pop(0)
        self.feed(self._starts, StartAsked())

    def close(self) -> None:
        """Stop all services, last first, and then the root."""
        if self.closing:
            return
        self.closing = True
        self._to_close = list(self.places.values())
        self._close_next()

    def _close_next(self) -> None:
        while self._to_close:
            place = self._to_close.pop()
            if not place.life.at_rest:
                self._closes = place
                self.feed(place, StopAsked(reason="its agent stops"))
                return
        self._closes = None
        self._root.stop()

    # What a service's actor tells ------------------------------------------------------------------------------

    def service_ready(self, message: ServiceReady) -> None:
        """All tasks that start with a service run, or do not."""
        place = self.places[message.service.name]
        if place.service is message.service:
            self.feed(place, Began())

    def service_ended(self, message: ServiceEnded) -> None:
        """A service has ended."""
        place = self.places[message.service.name]
        if place.service is not message.service:
            return
        for request in message.unheard:
            self._answering.reply(request, Refusal("failed", f"{place.address} ended before it came to that"))
        place.service = None
        if message.error is None:
            place.kept = message.kept
            self.feed(place, Finished("it stopped itself", closing=self.closing))
        else:
            self._fail(place, message.error)

    def _fail(self, place: ServicePlace, error: BaseException, hopeless: bool = False) -> None:
        place.traceback = traceback_of(error)
        hopeless = hopeless or isinstance(error, (ClassError, MissingExtraError))
        self.feed(place, Finished(describe(error, place.spec.cls), True, hopeless, self.closing))

    # What the lives of the services ask for --------------------------------------------------------------------

    def show(self, place: ServicePlace) -> None:
        """Ignored: only the root needs to know how far a service is."""

    def ask_leave(self, place: ServicePlace) -> None:
        """Let a service start once the last of its old tasks has ended: no task may run twice."""
        if place.alarm is not None:
            place.alarm.cancel()
        self._look_for_old_tasks(place, self._root.kernel.host.now())

    def _look_for_old_tasks(self, place: ServicePlace, since_s: float) -> None:
        prefix = place.address + "/"
        old = [it.address for it in self._root.kernel.registry.components() if it.address.startswith(prefix)]
        if place.life.state is State.CALLED_OFF:
            self.feed(place, LeaveRefused("it was called off"))
        elif not old:
            self.feed(place, Admitted())
        else:
            asker = place.life.asker
            if asker is not None and self._root.kernel.host.now() > since_s + STUCK_S:
                self._answering.put_off(asker, f"{place.address} waits for the end of {old[0]}, which is stuck")
            self._root.after_host(WATCH_S, lambda: self._look_for_old_tasks(place, since_s))

    def spawn(self, place: ServicePlace) -> None:
        spec = place.spec
        try:
            made = self._root.kernel.spawn(
                spec.cls,
                place.address,
                settings=spec.settings,
                tasks=spec.tasks,
                kept=None if place.fresh else place.kept,
                owner=self._root,
                **spec.arguments,
            )
        except (Exception, SystemExit) as error:  # what a service's author wrote in __init__ may raise anything
            self._fail(place, error, hopeless=isinstance(error, SettingsError))
            return
        # Not before: the next try begins with the same where its constructor fails.
        place.kept, place.fresh = {}, False
        place.service = core_of(made)

    def halt(self, place: ServicePlace) -> None:
        service, asker = place.service, place.life.asker
        assert service is not None
        if asker is not None:
            try:
                # What was asked of the service before is begun before it ends.
                end = Command(asker.number, asker.cause, "", for_s=place.for_s)
                self._root.publish(SYSCTRL, end, to=place.address)
                return
            except PancakesError as error:
                self._root.log("warning", f"{place.address} ends before it did all that it was asked: {error}")
        tell(service, Close(place.for_s))

    def revoke_rights(self, place: ServicePlace) -> None:
        """A service that does not end keeps its rights: its tasks hold the actuators."""

    def let_go(self, place: ServicePlace) -> None:
        """The kernel ends the subscriptions of a service with its actor."""

    def settle(self, place: ServicePlace) -> None:
        if place is self._starts:
            self.start_next()

    def write_rest(self, place: ServicePlace) -> None:
        self.feed(place, Written())
        if place.wakes_s is not None:
            # Not before: to stop may take longer than the sleep that was asked for.
            left_s = place.wakes_s - self._root.now()
            place.alarm, place.wakes_s = self._root.after(left_s, lambda: self._wake(place)), None
        place.for_s = None
        if place is self._closes:
            self._close_next()

    def _wake(self, place: ServicePlace) -> None:
        if place.life.state is State.STOPPED and not self.closing:
            self._root.event("asked", what="wake", service=place.spec.name, by=self._root.address)
            self.feed(place, StartAsked())

    def answer(self, place: ServicePlace, effect: Answer) -> None:
        if place.told == effect.asker.number:
            place.told = 0
        else:
            self._answering.reply(effect.asker, Refusal.if_any(effect.reason))
        self._root.call(lambda: self._answering.next_command(place))

    def tell_news(self, place: ServicePlace, effect: Tell) -> None:
        root, name, text = self._root, place.spec.name, effect.text
        restarts = place.life.restarts
        now_s = root.kernel.host.now()
        match effect.news:
            case News.STARTED:
                root.event("service_started", service=name)
            case News.STOPPED:
                root.event("service_stopped", service=name)
            case News.FAILED:
                following = effect.following.value if effect.following is not None else ""
                root.event("service_failed", service=name, error=text, then=following)
            case News.RESTARTS:
                root.log("warning", f"{place.address} is started again {restarts.when(now_s)}: {text}", place.traceback)
            case News.GIVEN_UP:
                then_again = "" if restarts.due_s is None else f", and tried again {restarts.when(now_s)}"
                root.log("error", f"{place.address} is given up{then_again}: {text}", place.traceback)
                if name == LOG_SERVICE:
                    # The console is a task of this service, so it is said here.
                    line = f"{place.address} is given up, so nothing is shown of what is logged: {text}"
                    print(printable_line(line), file=sys.stderr)
            case News.FAILED_WHILE_STOPPING | News.FAILED_AT_THE_END:
                root.log("warning", f"{place.address} failed while it stopped: {text}", place.traceback)
            case News.REFUSED | News.STUCK:
                root.log("error", text)
            case _:
                assert_never(effect.news)


def _place(agent: str, spec: ServiceSpec) -> ServicePlace:
    address = join(agent, spec.name)
    return ServicePlace(spec, address, Life(address, Restarts(spec.restart)))


CLOSER_LOOK_S: Final = 0.01
"""How often, in host time, it looks whether the service that it stops has ended."""


class Closer(ActorCore):
    """Stops services, the last first, each once the one before has ended, and then ends itself.

    Args:
        services: the addresses of the services, in the order in which they started.
    """

    def __init__(self, *args: Any, services: Sequence[str], **others: Any) -> None:
        super().__init__(*args, **others)
        self._left = list(services)

    def on_start(self) -> None:
        self._close_next()

    def _close_next(self) -> None:
        while self._left:
            service = self.kernel.registry.get(self._left.pop())
            if service is not None and tell(service, Close()):
                self._wait_for(service.address)
                return
        self.stop()

    def _wait_for(self, address: str) -> None:
        if self.kernel.registry.get(address) is None:
            self._close_next()
        else:
            self.after_host(CLOSER_LOOK_S, lambda: self._wait_for(address))
