"""The kernel of an agent: registry, information stream, timer and dispatchers (paper §2, §3).

There is one kernel for each agent and there may be many agents in a process: nothing here is global. The agent sets
what other parts provide (transport, access, links, clocks of peers).
"""

from __future__ import annotations

import os
import random
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import count
from typing import TYPE_CHECKING, Any, TypeVar

from msgspec.structs import replace

from pancakes.errors import PancakesError, RefusalCode, package_of
from pancakes.events import LogLine
from pancakes.kernel.actor import ActorCore, Component, core_of
from pancakes.kernel.dead_letters import DeadLetters, Unheard
from pancakes.kernel.dispatchers import Dispatcher, Guest, PinnedDispatcher, PoolDispatcher
from pancakes.kernel.mailbox import Reference, Runnable, tell
from pancakes.kernel.permits import PermitEnd, Permits, moment_of_host
from pancakes.kernel.providers import GuardNotes, HaltNote, NoPeers, PeerClock, PeerRights
from pancakes.kernel.registry import Registry, TaskTable
from pancakes.kernel.stream import InformationStream
from pancakes.kernel.timer import HeardTick, Timer, TimerTable, TurnMeter, VirtualTimer
from pancakes.kernel.virtual_time import VirtualDispatcher
from pancakes.packet import LOG, LocalTime, Packet, agent_of, join, type_name
from pancakes.settings import dotted, paths_in, plain_settings
from pancakes.util.class_checks import check_instance, check_loaded
from pancakes.util.clock import Clock, MissionClock, MonotonicClock, SkewedClock, day_s
from pancakes.util.files import NoPathError, at_home
from pancakes.util.timebase import Timebase

if TYPE_CHECKING:
    from pancakes.kernel.awaiting import ActorLoop as Loop


class Counter:
    """Counts up, atomically under the interpreter lock.

    Args:
        start: the first number handed out.

    Attributes:
        numbers: the numbers to come; `next` takes one. Any thread.
    """

    __slots__ = ("numbers",)

    def __init__(self, start: int = 0) -> None:
        self.numbers = count(start)

    def take(self) -> int:
        """Return the next number. Any thread."""
        return next(self.numbers)

    @property
    def value(self) -> int:
        """The number that will be handed out next."""
        # A count cannot be read without moving it, but it says where it stands: "count(7)".
        return int(repr(self.numbers)[6:-1])


class Folders:
    """The folders that an agent's configuration names in `[agent] folders`, and the files that its settings name.

    A path that its class has as its default may be set, too: the code that is installed here says so.

    Args:
        agent: the agent's name, for which `{agent}` stands in a path.
        folders: the folders.
        files: the paths of the files.
    """

    def __init__(self, agent: str, folders: Iterable[str] = (), files: Iterable[str] = ()) -> None:
        self._agent = agent
        self._folders = tuple(self._real(folder) for folder in folders)
        self._files = frozenset(self._real(path) for path in files)

    def refusal_of(self, cls: type, settings: Mapping[str, Any]) -> str:
        """Return why settings of a class may not be set from elsewhere; empty: they may."""
        for key, path in paths_in(cls, settings):
            if path and not self._holds(path) and path != _usual(cls).get(key):
                names = ", ".join(self._folders) or "none"
                return (
                    f"{dotted(key)}: {path!r} lies outside of the folders that the configuration of {self._agent} names"
                    f" ({names}): add its folder to folders in [agent] there"
                )
        return ""

    def _holds(self, path: str) -> bool:
        try:
            real = self._real(path)
        except (ValueError, NoPathError):
            return False
        below = (folder for folder in self._folders if real != folder)  # a name may get an end yet: FOLDER.mcap
        return real in self._files or any(os.path.commonpath((real, folder)) == folder for folder in below)

    def _real(self, path: str) -> str:
        return os.path.realpath(at_home(path).replace("{agent}", self._agent))


def _usual(cls: type) -> dict[tuple[str | int, ...], str]:
    """Return the paths that settings of a class have if nothing is set."""
    try:
        return dict(paths_in(cls, plain_settings(cls())))
    except (Exception, SystemExit):  # something must be set, or the class refuses itself as it is
        return {}


_Made = TypeVar("_Made", bound=Component)


class Kernel:
    """What an agent stands on.

    Args:
        agent: the agent's name.
        seed: draws all random numbers of its components.
        speed: mission seconds for each second of host time.
        hold: whether the mission waits at 0 for a `Begin` packet.
        virtual: run on this dispatcher, in virtual time; None: on threads, in real time.
        skewed: the host clock in virtual time, if it is not the virtual one itself.

    Attributes:
        host: the host clock.
        mission: the mission clock.
        now: returns the mission time in seconds; one object, which is asked with each tick and packet.
        stream: the information stream.
        registry: the actors that run here.
        permits: which guarded tasks may act.
        guard_notes: what is known of the guardians of those that are owned here.
        halt: whether the actuators have to stand.
        tasks: the tasks of all services, at rest or not.
        task_timers: what ticks here.
        dead_letters: packets whose handlers failed.
        unheard: tells of packets that were for somebody, and that nobody got.
        timer: the timer actor.
        transport: how this agent reaches other processes (a `pancakes.mesh.transport.Transport`).
        access: what peers may do here; the agent sets it.
        folders: where files may be written at the word of another; the agent sets it.
        stopping: whether the agent is about to end for good.
        mission_packets_sent: says how many mission packets have been sent to others; the agent sets it.
        life: names this life of the agent: its journal, and how often that was opened; the agent sets it.
        first_number: the number of the first packet of each source, see `foundation.numbering`; the agent sets it.
        disk_use: says how often this agent has waited for its disk, and what it has written; the agent sets it.
        links: says what is known about each link to another agent, as plain values; the agent sets it.
        peer_clock: says what is known of the clocks of another agent; the agent sets it.
        mission_changed: called once the mission has begun, or is known to begin; the agent sets it.
        meter: times all turns; None: nothing measures, and none is timed.
        ticks_heard: told of each tick of a task, in the task's turn; see `hear_ticks`.
        unraised: called with an exception that is for the program (`dispatch.is_for_program`), but was raised on a
            thread of the kernel's own, which counts as the failure of an actor. In that thread; tests set it.
    """

    def __init__(
        self,
        agent: str,
        *,
        seed: int = 0,
        speed: float = 1.0,
        hold: bool = False,
        virtual: VirtualDispatcher | None = None,
        skewed: SkewedClock | None = None,
    ) -> None:
        self.agent = agent
        self.seed = seed
        self.virtual = virtual
        self.host: Clock = skewed or (virtual.clock if virtual is not None else MonotonicClock())
        self.mission = MissionClock(self.host, speed, hold)
        self.now = self.mission.now
        self.stream = InformationStream(agent)
        self.registry = Registry()
        self.permits = Permits(moment_of_host if virtual is None else self._virtual_moment, self.log)
        self.guard_notes = GuardNotes()
        self.halt = HaltNote()
        self.tasks = TaskTable()
        self.task_timers = TimerTable()
        self.dead_letters = DeadLetters(self.log)
        self.unheard = Unheard(
            agent,
            self.log,
            lambda: [it.address for it in self.registry.components()],
            lambda: [it.address for it in self.tasks.all()],
            self._refuse_request,
            self.registry.device_types,
            self.host.now,
        )
        self.stream.unheard = self.unheard.here
        self.transport: Any = None
        self.folders = Folders(agent)
        self.access: PeerRights = NoPeers()
        self.stopping = False
        self.mission_packets_sent: Callable[[], int] = lambda: 0
        self.life = agent
        self.first_number = 1
        self.disk_use: Callable[[], tuple[int, int]] = lambda: (0, 0)
        self.links: Callable[[], Sequence[dict[str, Any]]] = tuple
        self.peer_clock: Callable[[str], PeerClock | None] = lambda agent: None
        self.mission_changed: Callable[[], None] = lambda: None
        self.meter: TurnMeter | None = None
        self.ticks_heard: tuple[Callable[[HeardTick], None], ...] = ()
        self.unraised: Callable[[BaseException], None] = lambda error: None
        self._seqs: dict[str, Counter] = {}
        self._lock = threading.Lock()
        self.timer: Timer
        self._shared: Dispatcher
        if virtual is not None:
            self.timer = VirtualTimer(agent, self.mission, virtual, skewed)
            self._shared = virtual
            self._pinned: Dispatcher = virtual
        else:
            self._shared = pool = PoolDispatcher(agent, self.host, self._hogged)
            self.timer = Timer(agent, self.mission, self.host, pool)
            self._pinned = PinnedDispatcher(agent)
        self.timer.launch()

    def spawn(
        self,
        cls: Callable[..., _Made],
        address: str,
        *,
        exited: Callable[[_Made, BaseException | None], None] | None = None,
        keeps_subscriptions: bool = False,
        **arguments: Any,
    ) -> _Made:
        """Make a component and let it run.

        Args:
            cls: its class.
            address: its address; no other component may run there.
            exited: called in the component's thread when it has ended, with the error if it failed; None: nothing is.
            keeps_subscriptions: whether its subscriptions stay when it ends; else they end with it, unless `exited`
                is there to do that.
            arguments: what else its class wants.

        Raises:
            ValueError: a component runs at this address already.
        """
        check_loaded(cls)
        component = cls(self, address, **arguments)
        check_instance(cls, component)
        core = core_of(component)
        if exited is not None or not keeps_subscriptions:
            core.exited = exited or self._release
        self.registry.add(core)
        self.attach(core)
        return component

    def guest(self, relieve: Callable[[], None]) -> Guest:
        """Make the calling thread a guest of the pool, see `Guest`. Not in virtual time, which has no threads."""
        assert isinstance(self._shared, PoolDispatcher)
        return Guest(self._shared, relieve)

    def attach(self, core: ActorCore) -> None:
        """Put a component on the dispatcher that suits it."""
        (self._pinned if core.facade.blocking or core.awaits else self._shared).attach(core)

    def loop_for(self, core: ActorCore) -> Loop:
        """Make the event loop of an actor that awaits. In the actor, on its own thread."""
        from pancakes.kernel.awaiting import ActorLoop, VirtualActorLoop  # asyncio takes long to import

        if self.virtual is None:
            return ActorLoop(core)
        return VirtualActorLoop(core, self.host.now, core.settle_in)

    def actor(self, path: str) -> Reference | None:
        """Return the actor at a path of this agent, such as `network/TaskMigrator`; None: none runs there."""
        return self.registry.get(join(self.agent, path))

    def tell(self, path: str, message: object) -> bool:
        """Give the actor at a path of this agent a message, see `pancakes.kernel.mailbox`. Any thread.

        Returns:
            False if none runs there, and the message is forgotten.
        """
        actor = self.actor(path)
        return actor is not None and tell(actor, message)

    def seq_of(self, address: str) -> Counter:
        """Return the counter of the packets of a source; it outlives the actor, so that numbers never repeat."""
        with self._lock:
            counter = self._seqs.get(address)
            if counter is None:
                counter = self._seqs[address] = Counter(self.first_number)
            return counter

    def continue_seq(self, address: str, next_seq: int) -> None:
        """Let the packets of a source go on from a number, if a recording had it; never back."""
        with self._lock:
            counter = self._seqs.get(address)
            if counter is None or counter.value < next_seq:
                self._seqs[address] = Counter(next_seq)

    def hear_ticks(self, heard: Callable[[HeardTick], None]) -> None:
        """Call `heard` with each tick of a task that runs, in the task's turn; not with those that are missed.

        It must not block; the `append` of a deque takes the least. Any thread.
        """
        with self._lock:
            self.ticks_heard = (*self.ticks_heard, heard)

    def unhear_ticks(self, heard: Callable[[HeardTick], None]) -> None:
        """Undo `hear_ticks`."""
        with self._lock:
            self.ticks_heard = tuple(other for other in self.ticks_heard if other != heard)

    def random_for(self, name: str) -> random.Random:
        """Return a source of random numbers of its own for each name, drawn from the agent's seed."""
        return random.Random(f"{self.seed}/{name}")

    def begin(self, in_s: float) -> None:
        """Let a mission that is held at 0 begin in `in_s` seconds of host time."""
        self.mission.begin(in_s)
        self.timer.wake()
        self.mission_changed()

    def join(self, zero_s: float) -> None:
        """Let a mission that is held go on as it has in other agents: there it was 0 at this host time."""
        self.mission.join(zero_s)
        self.timer.wake()
        self.mission_changed()

    def timebase(self) -> Timebase:
        """Return what the mission time and the time of day are, as the host clock counts. Any thread."""
        base = self._mission_base()
        # In virtual time there is none: a run must not depend on the day.
        return base if self.virtual is not None else replace(base, day_s=day_s(self.host))

    def utc_s(self, stamp_s: float | None = None) -> float | None:
        """Return the time of day, in seconds since 1970 (UTC). Any thread.

        Args:
            stamp_s: that at this mission time; None: the present one.

        Returns:
            None if the machine's clock was never set, in virtual time, and while the mission is held and 0.
        """
        base = self.timebase()
        if base.day_s is None or stamp_s is None:
            return None if base.day_s is None else base.day_s + self.host.now()
        zero_s = base.zero_s()
        return base.day_s + zero_s + stamp_s / base.speed if zero_s is not None else None

    def local_time(self, packet: Packet) -> LocalTime | None:
        """See `Component.local_time`. Any thread."""
        agent = agent_of(packet.source)
        if agent == self.agent:
            return LocalTime(packet.stamp_s, 0.0)
        clock = self.peer_clock(agent)
        return clock.local_time(packet.stamp_s, self._mission_base()) if clock is not None else None

    def restamped(self, agent: str, stamp_s: float) -> float:
        """Return a stamp of an agent on this one's mission clock; 0, which says nothing, where that is not known."""
        if agent == self.agent:
            return stamp_s
        clock = self.peer_clock(agent)
        found = clock.local_time(stamp_s, self._mission_base()) if clock is not None else None
        return max(0.0, found.time_s) if found is not None else 0.0

    def _mission_base(self) -> Timebase:
        mission = self.mission
        began_s = None if mission.held else mission.host_time(mission.start_s)
        return Timebase(began_s, mission.start_s, mission.speed)

    def _refuse_request(self, packet: Packet, code: RefusalCode, reason: str) -> None:
        """Answer a request that no task can take. Any thread."""
        from pancakes.kernel.request_packets import REQUESTS, not_there  # few agents ever have to do with requests

        found = not_there(packet, code, reason)
        if found is None:
            return
        to, answered = found
        address = f"{self.agent}/kernel"
        number = self.seq_of(address).take()
        packet = Packet(REQUESTS, type_name(answered), address, to, self.mission.now(), number, answered)
        try:
            self.stream.publish(packet)
        except PancakesError:  # who asked finds out when the time is up
            self.stream.undelivered += 1

    def log(self, level: str, text: str, traceback: str = "") -> None:
        """Publish a line on `log` in the kernel's own name; see `Component.log`. Any thread."""
        self.say(LogLine(level, text, traceback))

    def say(self, body: Any) -> None:
        """Publish on `log` in the kernel's own name. Any thread."""
        address = f"{self.agent}/kernel"
        packet = Packet(LOG, type_name(body), address, "", self.mission.now(), self.seq_of(address).take(), body)
        try:
            self.stream.publish(packet)
        except PancakesError:
            # As in `Component.log`: a thread that logs must not fail because of a reader.
            self.stream.undelivered += 1

    def stop(self) -> None:
        """End the timer and all threads. The components have been stopped before; not from one of them."""
        self.timer.halt()
        if self.virtual is None:
            self._shared.stop()
            self._pinned.stop()

    def crash(self) -> None:
        """Let nothing run any more, and tell no component. In virtual time only, between two turns."""
        self.stream.silence()
        self.timer.halt()
        for component in self.registry.components():
            component.actor_stopped.set()
            component.actor_inbox.component = None
            if component.loop is not None:
                component.loop.close()

    def _virtual_moment(self) -> PermitEnd:
        now_s = self.host.now()
        return PermitEnd(now_s, now_s)

    def _release(self, component: Component, error: BaseException | None) -> None:
        self.stream.unsubscribe(component.address)

    def _hogged(self, component: Runnable, held_s: float) -> None:
        if component.address == f"{self.agent}/kernel":  # the root: no user can write it otherwise
            return
        if package_of(component.author_class.__module__) == "pancakes":
            level, why = "info", "a task's class, state, cost or rule takes long there, or this computer is busy"
        else:
            level, why = "warning", "a task that waits or computes for long should say `blocking = True`"
        self.log(level, f"{component.address} has held a thread of the pool for {held_s * 1000:.0f} ms: {why}")
