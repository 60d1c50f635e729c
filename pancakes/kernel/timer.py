"""The timer actor: one thread that ticks all periodic components of an agent (paper §3.2)."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Protocol

import pykka

from pancakes.clock import Clock, MissionClock
from pancakes.kernel.schedule import Due, Schedule
from pancakes.kernel.slack import wake_on_time
from pancakes.kernel.virtual import VirtualCall, VirtualDispatcher

if TYPE_CHECKING:
    from pykka._actor import ActorInbox


class Ticking(Protocol):
    """Whom the timer ticks."""

    def fire(self, deadline_s: float, missed: int) -> None:
        """A deadline has come. In the timer's thread: must do no more than put it into a mailbox."""
        ...


class OneShot:
    """A call that was put off, and can be called off."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[[], None]) -> None:
        self._function: Callable[[], None] | None = function

    def cancel(self) -> None:
        """Makes sure that the call does not happen."""
        self._function = None

    def __call__(self) -> None:
        if self._function is not None:
            self._function()


class Timer(pykka.Actor):
    """Drives the periodic components of one agent, on the mission clock and on the host's.

    Its methods may be called from any thread: they put a message into its inbox. What it calls (`fire`, and the
    functions of `after`) runs in its own thread and must not block.

    Args:
        name: for the name of its thread.
        mission: the mission clock.
        host: the host clock.
    """

    def __init__(self, name: str, mission: MissionClock, host: Clock) -> None:
        super().__init__()
        self.actor_urn = f"{name}/kernel/timer"
        self._name = name
        self._mission = mission
        self._host = host
        self._mission_schedule = Schedule()
        self._host_schedule = Schedule()
        self._thread: threading.Thread | None = None

    @staticmethod
    def _create_actor_inbox() -> ActorInbox:
        return SimpleQueue()

    @staticmethod
    def _create_future() -> pykka.Future[Any]:
        return pykka.ThreadingFuture()

    def every(self, target: Ticking, period_s: float) -> None:
        """Ticks `target` each `period_s` of mission time; one that ticks already changes its rate."""
        self._tell(lambda: self._mission_schedule.every(target, period_s, self._mission.now()))

    def cancel(self, target: Ticking) -> None:
        """Ends the ticks of `target`."""
        self._tell(lambda: self._mission_schedule.cancel(target))

    def after(self, delay_s: float, function: Callable[[], None]) -> OneShot:
        """Calls `function` in `delay_s` seconds of mission time, counted from now.

        Raises:
            ValueError: the delay is no number.
        """
        time_s = self._mission.now() + _checked(delay_s)
        shot = OneShot(function)
        self._tell(lambda: self._mission_schedule.at(time_s, shot))
        return shot

    def after_host(self, delay_s: float, function: Callable[[], None]) -> OneShot:
        """Calls `function` in `delay_s` seconds of host time."""
        time_s = self._host.now() + _checked(delay_s)
        shot = OneShot(function)
        self._tell(lambda: self._host_schedule.at(time_s, shot))
        return shot

    def wake(self) -> None:
        """Lets the timer look at its clocks again: the mission has begun."""
        self._tell(lambda: None)

    def _tell(self, change: Callable[[], None]) -> None:
        self.actor_inbox.put(change)  # type: ignore[arg-type]

    def launch(self) -> None:
        """Starts the timer's thread."""
        self._start_actor_loop()

    def _start_actor_loop(self) -> None:
        self._thread = threading.Thread(target=self._actor_loop_running, name=f"{self._name}-timer", daemon=True)
        self._thread.start()

    def _actor_loop_running(self) -> None:
        wake_on_time()
        inbox: SimpleQueue[Callable[[], None] | None] = self.actor_inbox  # type: ignore[assignment]
        while True:
            wait_s = self._next_host_s() - self._host.now()
            try:
                if wait_s <= 0:
                    change = inbox.get_nowait()
                else:
                    change = inbox.get(timeout=None if wait_s == math.inf else min(wait_s, 3600.0))
            except Empty:
                self._fire_due()
                continue
            if change is None:
                return
            change()

    def halt(self) -> None:
        """Ends the timer and waits for its thread."""
        self.actor_inbox.put(None)  # type: ignore[arg-type]
        self.actor_stopped.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def _next_host_s(self) -> float:
        """Returns the host time at which something is due next."""
        mission_s = self._mission_schedule.next()
        mission_host_s = math.inf if mission_s == math.inf else self._mission.host_time(mission_s)
        return min(self._host_schedule.next(), mission_host_s)

    def _fire_due(self) -> None:
        mission_s = self._mission.now()
        # A tick whose host time has come is due, even where rounding puts the mission's clock a hair before it.
        due = self._mission_schedule.due(mission_s + 1e-9)
        due += self._host_schedule.due(self._host.now())
        for item in due:
            if isinstance(item, Due):
                item.target.fire(item.deadline_s, item.missed)
            else:
                item()


def _checked(delay_s: float) -> float:
    if math.isnan(delay_s):
        # It would be neither before nor after anything else in the book, and bring that into disorder.
        raise ValueError("a delay must be a number, not nan")
    return delay_s


class VirtualTimer(Timer):
    """The timer in virtual time: no thread; the dispatcher calls it when the next deadline comes."""

    def __init__(self, name: str, mission: MissionClock, dispatcher: VirtualDispatcher) -> None:
        super().__init__(name, mission, dispatcher.clock)
        self._dispatcher = dispatcher
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
            self._call = self._dispatcher.call_at(next_s, self._come)

    def _come(self) -> None:
        self._call = None
        self._call_s = math.inf
        self._fire_due()
        if not self._halted:
            self._arrange()
