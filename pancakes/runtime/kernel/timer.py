"""The timer actor: one thread that ticks all periodic components of an agent (paper §3.2)."""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, Final, Protocol

from pancakes.runtime.clock import Clock, MissionClock, SkewedClock
from pancakes.runtime.kernel.guest import GUEST_S, Guest
from pancakes.runtime.kernel.inbox import Inbox
from pancakes.runtime.kernel.pool import PoolDispatcher
from pancakes.runtime.kernel.pykka_actor import PykkaActor, dismiss, is_envelope
from pancakes.runtime.kernel.schedule import Due, Schedule
from pancakes.runtime.kernel.slack import wake_on_time
from pancakes.runtime.kernel.virtual import VirtualCall, VirtualDispatcher

ONE_BY_ONE_S: Final = 0.005
"""So long each tick of many gets its turn before the next is given; a thousand quick ones take about that."""

_LOG: Final = logging.getLogger("pancakes.runtime.kernel")


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
        """Makes sure that the call does not happen."""
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
        self.actor_inbox.put(change)

    def launch(self) -> None:
        """Starts the timer's thread."""
        self.begin_loop()

    def begin_loop(self) -> None:
        self._thread = threading.Thread(target=self._run, name=f"{self._name}-timer", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        wake_on_time()
        guest = Guest(self._pool, self.begin_loop) if self._pool is not None else None
        inbox = self.actor_inbox
        serve = partial(self._serve, guest)
        while not self.actor_stopped.is_set() and (guest is None or guest.stays):
            if not self._due:
                inbox.wait(self._next_host_s() - self._host.now())
            message: Any = serve if inbox.empty() else inbox.get()
            try:
                if is_envelope(message):
                    self.handle_envelope(message)
                else:
                    message()
            except Exception:  # a fault in one call must not end the ticks of all
                _LOG.exception("a call of the timer failed")

    def end_loop(self) -> None:
        self.actor_stopped.set()
        while not self.actor_inbox.empty():
            dismiss(self.actor_inbox.get())
        self._ended.set()

    def _serve(self, guest: Guest | None) -> None:
        """Fires what is due, and gives the turns that come of it where no other thread does."""
        if guest is None or not guest.arrive():
            self._fire_due(None)
            return
        try:
            self._fire_due(guest)
            if guest.stays:
                guest.work(min(self._host.now() + GUEST_S, self._next_host_s()))
        finally:
            guest.leave()

    def halt(self) -> None:
        """Ends the timer and waits for its thread."""
        self.stop()
        if self._thread is not None and self._thread is not threading.current_thread():
            # Not yet for the thread: a turn may hold it, and another one then ends in its place.
            self._ended.wait()
            self._thread.join()

    def _next_host_s(self) -> float:
        """Returns the host time at which something is due next."""
        mission_s = self._mission_schedule.next_s
        mission_host_s = math.inf if mission_s == math.inf else self._mission.host_time(mission_s)
        host_s = self._host_schedule.next_s
        return host_s if host_s < mission_host_s else mission_host_s

    def _fire_due(self, guest: Guest | None) -> None:
        due = self._due
        # A tick whose host time has come is due, even where rounding puts the mission's clock a hair before it.
        due.extend(self._mission_schedule.due(self._mission.now() + 1e-9))
        due.extend(self._host_schedule.due(self._host.now()))
        until_s = 0.0 if guest is None else min(self._host.now() + ONE_BY_ONE_S, self._next_host_s())
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
                if guest is not None:
                    guest.work(until_s)
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
        skewed: the agent's host clock, where it is not the virtual one.
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
