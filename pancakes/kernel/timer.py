"""Timers: one thread that ticks all periodic components of an agent, and the ticks themselves (paper §3.2).

`Schedule` is pure: times go in, what is due comes out. Deadlines are absolute multiples of the period, so nothing
drifts and equal rates tick together. `Timer` waits for the next deadline on the mission clock or the host's.
`TaskTimer` puts each tick into its component's mailbox, and counts missed ticks and lateness; a tick that still waits
is replaced. `TurnMeter` counts the processor time of turns and ticks while something measures it.

Functions that the timer calls run in its thread and must not block.
"""

from __future__ import annotations

import heapq
import logging
import math
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import count
from time import thread_time
from typing import Any, Final, Protocol, TypeAlias

import msgspec

from pancakes.kernel.dispatchers import GUEST_S, Guest, PoolDispatcher
from pancakes.kernel.handlers import Tick
from pancakes.kernel.mailbox import Inbox, Runnable
from pancakes.kernel.pykka_actor import PykkaActor, dismiss, handle_envelope, is_envelope
from pancakes.kernel.virtual_time import VirtualCall, VirtualDispatcher
from pancakes.util.clock import Clock, MissionClock, SkewedClock


class Due(msgspec.Struct, frozen=True, gc=False):
    """A tick.

    Attributes:
        targets: what ticks; the timer takes each out as it ticks it.
        deadline_s: when it was due.
        missed: how many ticks before it never happened because the timer itself was late.
    """

    targets: Iterator[Any]
    deadline_s: float
    missed: int


class _Group(msgspec.Struct):
    """All targets that tick together: one entry in the heap however many there are."""

    period_s: float
    number: int
    targets: dict[int, Any] = msgspec.field(default_factory=dict)

    @property
    def deadline_s(self) -> float:
        return self.number * self.period_s


class Schedule:
    """Periodic ticks and single calls on one clock.

    Deadlines are absolute, k times the period since the clock's zero, so that nothing drifts and
    equal rates tick together.

    Attributes:
        next_s: when something is due next; infinity if nothing ever is.
    """

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, _Group | Callable[[], None]]] = []
        self._order = count()
        self._groups: dict[float, _Group] = {}
        self._group_of: dict[int, _Group] = {}
        self.next_s = math.inf  # not a method: in virtual time it is asked for three times for each tick

    def every(self, target: Any, period_s: float, now_s: float) -> None:
        """Tick `target` each `period_s` from now on; a target that ticks already changes its rate.

        The first tick is the next multiple of the period, and never one at which the target has ticked.
        """
        if not (period_s > 0 and math.isfinite(period_s)):
            raise ValueError(f"a period must be positive and finite, not {period_s}")
        self.cancel(target)
        group = self._groups.get(period_s)
        if group is None:
            # A little tolerance: 0.3 / 0.1 is 2.9999999999999996, and must not tick at 0.3 again.
            group = _Group(period_s, math.floor(now_s / period_s + 1e-9) + 1)
            self._groups[period_s] = group
            self._push(group.deadline_s, group)
        group.targets[id(target)] = target
        self._group_of[id(target)] = group

    def cancel(self, target: Any) -> None:
        """End the ticks of `target`, if it has any."""
        group = self._group_of.pop(id(target), None)
        if group is not None:
            del group.targets[id(target)]

    def at(self, time_s: float, call: Callable[[], None]) -> None:
        """Hand out `call` once, when `time_s` is reached."""
        self._push(time_s, call)

    def _push(self, time_s: float, entry: _Group | Callable[[], None]) -> None:
        heapq.heappush(self._heap, (time_s, next(self._order), entry))
        self.next_s = self._heap[0][0]

    def due(self, now_s: float) -> list[Due | Callable[[], None]]:
        """Take out what is due at `now_s`, oldest first."""
        out: list[Due | Callable[[], None]] = []
        heap = self._heap
        while heap and heap[0][0] <= now_s:
            entry = heap[0][2]
            if not isinstance(entry, _Group):
                heapq.heappop(heap)
                out.append(entry)
                continue
            period_s, number = entry.period_s, entry.number
            if not entry.targets:
                heapq.heappop(heap)
                del self._groups[period_s]
                continue
            missed = math.floor(now_s / period_s + 1e-9) - number
            if missed < 0:
                missed = 0
            number += missed
            out.append(Due(iter(tuple(entry.targets.values())), number * period_s, missed))
            entry.number = number = number + 1
            heapq.heapreplace(heap, (number * period_s, next(self._order), entry))
        self.next_s = heap[0][0] if heap else math.inf
        return out


def wake_on_time() -> None:
    """Ask the system to put off no wake-up of the calling thread.

    Linux may let each timed wait take 50 µs longer, to save power. Measured with one task at 1 kHz: without it, the
    median lateness of a bare thread is 75 µs, with it 25 µs. Where there is no such thing, nothing happens.
    """
    try:
        # A thread may write its own; any value below the smallest step of the clock means "none".
        with open(f"/proc/{threading.get_native_id()}/timerslack_ns", "w") as slack:
            slack.write("1")
    except OSError:
        pass


NOTHING: Final = (0, 0.0, 0.0)


class MeterReading(msgspec.Struct, frozen=True):
    """What was counted up to some moment.

    Attributes:
        turns: by actor: how many turns, and their processor time in seconds.
        ticks: by actor and time-driven method: how many ticks, their processor time, and the sum of its squares.
    """

    turns: Mapping[str, tuple[int, float]]
    ticks: Mapping[tuple[str, str], tuple[int, float, float]]


class TurnMeter:
    """Counts the processor time of turns and ticks.

    Each is entered by the thread that gives the turn. An actor has one turn at a time, so of each entry there is one
    writer; entries are replaced whole, so a reader in another thread sees none that is half done.
    """

    def __init__(self) -> None:
        self._turns: dict[str, tuple[int, float]] = {}
        self._ticks: dict[tuple[str, str], tuple[int, float, float]] = {}

    def turn(self, address: str, used_s: float) -> None:
        """A turn of an actor has ended, which took `used_s` of processor time."""
        count, sum_s = self._turns.get(address, (0, 0.0))
        self._turns[address] = (count + 1, sum_s + used_s)

    def tick(self, address: str, method: str, used_s: float) -> None:
        """A tick of an actor has ended, within its turn."""
        count, sum_s, squares = self._ticks.get((address, method), NOTHING)
        self._ticks[(address, method)] = (count + 1, sum_s + used_s, squares + used_s * used_s)

    def read(self) -> MeterReading:
        """Return what was counted so far. Any thread."""
        return MeterReading(self._turns.copy(), self._ticks.copy())


HeardTick: TypeAlias = "tuple[TaskTimer, Tick, float]"
"""A timer, a tick of it that runs now, and the timer's period in seconds. A plain tuple: it is made in each tick."""


class Ticker(Protocol):
    """What a timer needs of the kernel."""

    ticks_heard: tuple[Callable[[HeardTick], None], ...]
    meter: TurnMeter | None

    def now(self) -> float:
        """Return the mission time in seconds."""


class TaskTimer:
    """One time-driven method of one component: what stands between the timer's thread and the actor.

    Args:
        component: the component.
        method: the method's name.
        handler: the method.
        period_s: from tick to tick, in mission time; infinity lets it rest.
        ticker: the clock, and what is told of each tick.

    Attributes:
        deadline_s: the deadline of the tick that is pending, in mission time.
        missed: how many ticks before it never came.
        pending: whether a tick waits to be run.
    """

    __slots__ = (
        "_handler",
        "_ticker",
        "component",
        "deadline_s",
        "lateness_max_s",
        "lateness_sum_s",
        "method",
        "missed",
        "missed_total",
        "pending",
        "period_s",
        "ticks",
    )

    def __init__(
        self, component: Runnable, method: str, handler: Callable[[Any, Tick], None], period_s: float, ticker: Ticker
    ) -> None:
        self.component = component
        self.method = method
        self.period_s = period_s
        self._handler = handler
        self._ticker = ticker
        self.deadline_s = 0.0
        self.pending = False
        self.missed = 0
        self.missed_total = 0
        self.ticks = 0
        self.lateness_sum_s = 0.0
        self.lateness_max_s = 0.0

    @property
    def rate_hz(self) -> float:
        """Ticks for each second of mission time."""
        return 1.0 / self.period_s

    def describe(self) -> dict[str, Any]:
        """Return what is known about it, as plain values. Any thread."""
        return {
            "timer": self.method,
            "rate_hz": self.rate_hz,
            "ticks": self.ticks,
            "missed": self.missed_total,
            "lateness_mean_s": self.lateness_sum_s / self.ticks if self.ticks else 0.0,
            "lateness_max_s": self.lateness_max_s,
        }

    def fire(self, deadline_s: float, missed: int) -> None:
        """A deadline has come (the timer's thread). A tick that still waits is replaced, never joined by another."""
        # In this order: a turn may run the waiting tick meanwhile, and must not be given this one twice.
        if self.pending:
            self.missed += 1 + missed
            self.deadline_s = deadline_s
            return
        self.missed += missed
        self.deadline_s = deadline_s
        self.pending = True
        self.component.actor_inbox.put(self)

    def run(self) -> None:
        """Call the method (the component's turn)."""
        deadline_s = self.deadline_s
        missed, self.missed = self.missed, 0
        self.pending = False
        component = self.component
        if component.actor_inbox.paused or not component.acts():
            return
        lateness_s = self._ticker.now() - deadline_s
        if lateness_s < 0.0:
            lateness_s = 0.0
        self.ticks += 1
        self.missed_total += missed
        self.lateness_sum_s += lateness_s
        if lateness_s > self.lateness_max_s:
            self.lateness_max_s = lateness_s
        tick = Tick(deadline_s, missed, lateness_s)
        for heard in self._ticker.ticks_heard:
            heard((self, tick, self.period_s))
        meter = self._ticker.meter
        begun_s = thread_time() if meter is not None else 0.0
        self._handler(component.facade, tick)
        if meter is not None:
            meter.tick(component.address, self.method, thread_time() - begun_s)


class TimerTable:
    """Which timers tick here. Each actor enters its own; metrics, recordings and descriptions read them. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._timers: dict[str, tuple[TaskTimer, ...]] = {}

    def add(self, timer: TaskTimer) -> None:
        """Add a timer of an actor that runs."""
        address = timer.component.address
        with self._lock:
            self._timers[address] = (*self._timers.get(address, ()), timer)

    def remove(self, component: Runnable) -> None:
        """Remove the timers of an actor that has ended."""
        with self._lock:
            timers = self._timers.get(component.address, ())
            if timers and timers[0].component is component:
                del self._timers[component.address]

    def of(self, address: str) -> tuple[TaskTimer, ...]:
        """Return the timers of the actor that runs at an address, in the order of its class."""
        return self._timers.get(address, ())

    def all(self) -> list[TaskTimer]:
        """Return all timers, in the order in which their actors started."""
        with self._lock:
            return [timer for timers in self._timers.values() for timer in timers]


ONE_BY_ONE_S: Final = 0.005
"""For this long each tick of many gets its turn before the next is given; a thousand quick ones take about that."""

_LOG: Final = logging.getLogger("pancakes.kernel")


class Ticking(Protocol):
    """What the timer ticks."""

    def fire(self, deadline_s: float, missed: int) -> None:
        """A deadline has come. In the timer's thread: must do no more than put it into a mailbox."""
        ...


class OneShot:
    """A call that was put off, and can be called off."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[[], None]) -> None:
        self._function: Callable[[], None] | None = function

    def cancel(self) -> None:
        """Make sure that the call does not happen."""
        self._function = None

    def __call__(self) -> None:
        if self._function is not None:
            self._function()


class Timer(PykkaActor):
    """Drives the periodic components of one agent, on the mission clock and on the host's.

    Its methods may be called from any thread: they put a message into its inbox. What it calls (`fire`, and the
    functions of `after`) runs in its own thread and must not block.

    Args:
        name: for the name of its thread.
        mission: the mission clock.
        host: the host clock.
        pool: what gives the turns of most of the components that it ticks: its thread does that itself while no other
            thread does, which saves a tick the way to another thread. None: it never does.
    """

    actor_inbox: Inbox

    def __init__(self, name: str, mission: MissionClock, host: Clock, pool: PoolDispatcher | None = None) -> None:
        super().__init__()
        self.actor_urn = f"{name}/kernel/timer"
        self._name = name
        self._mission = mission
        self._host = host
        self._pool = pool
        self._mission_schedule = Schedule()
        self._host_schedule = Schedule()
        self._due: deque[Due | Callable[[], None]] = deque()
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()

    @staticmethod
    def _create_actor_inbox() -> Inbox:
        return Inbox()

    def every(self, target: Ticking, period_s: float) -> None:
        """Tick `target` each `period_s` of mission time; one that ticks already changes its rate."""
        self._tell(lambda: self._mission_schedule.every(target, period_s, self._mission.now()))

    def cancel(self, target: Ticking) -> None:
        """End the ticks of `target`."""
        self._tell(lambda: self._mission_schedule.cancel(target))

    def after(self, delay_s: float, function: Callable[[], None]) -> OneShot:
        """Call `function` in `delay_s` seconds of mission time, counted from now.

        Raises:
            ValueError: the delay is no number.
        """
        time_s = self._mission.now() + _checked(delay_s)
        shot = OneShot(function)
        self._tell(lambda: self._mission_schedule.at(time_s, shot))
        return shot

    def after_host(self, delay_s: float, function: Callable[[], None]) -> OneShot:
        """Call `function` in `delay_s` seconds of host time."""
        time_s = self._host.now() + _checked(delay_s)
        shot = OneShot(function)
        self._tell(lambda: self._host_schedule.at(time_s, shot))
        return shot

    def wake(self) -> None:
        """Let the timer look at its clocks again: the mission has begun."""
        self._tell(lambda: None)

    def _tell(self, change: Callable[[], None]) -> None:
        self.actor_inbox.put(change)

    def launch(self) -> None:
        """Start the timer's thread."""
        self._thread = threading.Thread(target=self._run, name=f"{self._name}-timer", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        wake_on_time()
        guest = Guest(self._pool, self.launch) if self._pool is not None else None
        inbox = self.actor_inbox
        serve = partial(self._serve, guest)
        while not self.actor_stopped.is_set() and (guest is None or guest.stays):
            if not self._due:
                inbox.wait(self._next_host_s() - self._host.now())
            message: Any = serve if inbox.empty() else inbox.get()
            try:
                if is_envelope(message):
                    handle_envelope(self, message)
                else:
                    message()
            except Exception:  # a fault in one call must not end the ticks of all
                _LOG.exception("a call of the timer failed")

    def _start_actor_loop(self) -> None:
        self.launch()

    def _stop(self) -> None:
        self.actor_stopped.set()
        while not self.actor_inbox.empty():
            dismiss(self.actor_inbox.get())
        self._ended.set()

    def _serve(self, guest: Guest | None) -> None:
        """Fire what is due, and give the turns that come of it if no other thread does."""
        if guest is None or not guest.arrive():
            self._fire_due(None)
            return
        try:
            self._fire_due(guest)
            if guest.stays:  # else its successor has the schedules now
                now_s = self._host.now()
                until_s = min(now_s + GUEST_S, self._next_host_s())
                if now_s < until_s:
                    guest.work(until_s)
        finally:
            guest.leave()

    def halt(self) -> None:
        """End the timer and wait for its thread."""
        self.stop()
        if self._thread is not None and self._thread is not threading.current_thread():
            # Not yet for the thread: a turn may hold it, and another one then ends in its place.
            self._ended.wait()
            self._thread.join()

    def _next_host_s(self) -> float:
        """Return the host time at which something is due next."""
        mission_s = self._mission_schedule.next_s
        mission_host_s = math.inf if mission_s == math.inf else self._mission.host_time(mission_s)
        host_s = self._host_schedule.next_s
        return host_s if host_s < mission_host_s else mission_host_s

    def _fire_due(self, guest: Guest | None) -> None:
        due = self._due
        mission, host, host_s = self._mission_schedule, self._host_schedule, self._host.now()
        # A tick whose host time has come is due, even if rounding puts the mission's clock a hair before it.
        mission_s = self._mission.now() + 1e-9
        if mission.next_s <= mission_s:
            due.extend(mission.due(mission_s))
        if host.next_s <= host_s:
            due.extend(host.due(host_s))
        until_s = min(host_s + ONE_BY_ONE_S, self._next_host_s()) if guest is not None else 0.0
        in_time = host_s < until_s
        while due:
            item = due[0]
            if not isinstance(item, Due):
                due.popleft()
                item()
                continue
            for target in item.targets:
                target.fire(item.deadline_s, item.missed)
                # A turn right after its tick: of a thousand tasks the first does not wait for the last to be ticked.
                # Where turns take long, though, they wait: those that run elsewhere, and calls that were put off, shall
                # be on time all the same.
                if in_time and guest is not None:
                    in_time = guest.work(until_s)
                    if not guest.stays:
                        return  # the thread that has taken over goes on with what is left
            due.popleft()


def _checked(delay_s: float) -> float:
    if math.isnan(delay_s):
        # It would be neither before nor after anything else in the book, and bring that into disorder.
        raise ValueError("a delay must be a number, not nan")
    return delay_s


class VirtualTimer(Timer):
    """The timer in virtual time: no thread; the dispatcher calls it when the next deadline comes.

    Args:
        name: for its address.
        mission: the mission clock.
        dispatcher: calls it.
        skewed: the agent's host clock, if it is not the virtual one.
    """

    def __init__(
        self, name: str, mission: MissionClock, dispatcher: VirtualDispatcher, skewed: SkewedClock | None = None
    ) -> None:
        super().__init__(name, mission, skewed or dispatcher.clock)
        self._dispatcher = dispatcher
        self._skewed = skewed
        self._call: VirtualCall | None = None
        self._call_s = math.inf
        self._halted = False

    def launch(self) -> None:
        """Nothing to start."""

    def halt(self) -> None:
        self._halted = True
        if self._call is not None:
            self._call.cancel()

    def _tell(self, change: Callable[[], None]) -> None:
        if not self._halted:
            change()
            self._arrange()

    def _arrange(self) -> None:
        next_s = self._next_host_s()
        if next_s == self._call_s:
            return
        if self._call is not None:
            self._call.cancel()
            self._call = None
        self._call_s = next_s
        if next_s != math.inf:
            true_s = next_s if self._skewed is None else self._skewed.true_s(next_s)
            self._call = self._dispatcher.call_at(true_s, self._come)

    def _come(self) -> None:
        self._call = None
        self._call_s = math.inf
        self._fire_due(None)
        if not self._halted:
            self._arrange()
