"""A timer whose ticks are those that ran in the recording, and as late as they were then."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from typing import Final

from pancakes.runtime.clock import MissionClock
from pancakes.runtime.kernel.handlers import Tick
from pancakes.runtime.kernel.task_timer import TaskTimer
from pancakes.runtime.kernel.timer import Ticking, VirtualTimer
from pancakes.runtime.kernel.virtual import VirtualDispatcher
from pancakes.tools.replay.ran_ticks import RanTicks

LATEST_S: Final = 0.5
"""No tick is held back longer, in mission time."""
TURN_S: Final = 0.0002
"""The time from the begin of a tick to the first packet of the task, about, in host time."""
ROUNDING_S: Final = 1e-9


class LateTimer(VirtualTimer):
    """Ticks in virtual time; a tick is held back until the task said something then, if it did so before the next one.

    Live, a tick comes later than it is due, and it matters what was handled between the two.

    Args:
        name: the agent's name.
        mission: the mission clock; one with the dispatcher's time.
        dispatcher: runs everything.
        spoken_s: when the task published what no packet had led to, and when it had published something before that;
            in order, in mission time.
        speed: mission seconds for each second of host time then.
        ran: which ticks ran, by the method that they call; None: all.
    """

    def __init__(
        self,
        name: str,
        mission: MissionClock,
        dispatcher: VirtualDispatcher,
        spoken_s: Sequence[tuple[float, float]],
        speed: float,
        ran: Mapping[str, RanTicks] | None = None,
    ) -> None:
        super().__init__(name, mission, dispatcher)
        self._turn_s = TURN_S * speed
        self._spoken_s = spoken_s
        self._ran = ran or {}
        self._held: dict[int, _Held] = {}

    def every(self, target: Ticking, period_s: float) -> None:
        self.cancel(target)
        ran = self._ran.get(target.method) if isinstance(target, TaskTimer) else None
        held = self._held[id(target)] = _Held(self, target, period_s, ran)
        super().every(held, period_s)

    def cancel(self, target: Ticking) -> None:
        held = self._held.pop(id(target), None)
        if held is not None:
            held.ended = True
            super().cancel(held)

    def hold_back(self, held: _Held, tick: Tick) -> None:
        """A deadline has come: ticks now, or when it was done then; `tick` has its lateness if that is known."""
        deadline_s = tick.time_s
        if tick.lateness_s:
            self._dispatcher.call_at(deadline_s + tick.lateness_s, lambda: held.tick(tick))
            return
        place = bisect_left(self._spoken_s, (deadline_s - ROUNDING_S, 0.0))
        spoken_s, before_s = self._spoken_s[place] if place < len(self._spoken_s) else (deadline_s, 0.0)
        if not ROUNDING_S < spoken_s - deadline_s < held.most_s:
            held.tick(tick)
            return
        # What it said before that it had said before the tick.
        begun_s = max(spoken_s - self._turn_s, before_s + 10 * ROUNDING_S)
        self._dispatcher.call_at(begun_s, lambda: held.tick(tick))


class _Held:
    """Takes the ticks of the timer in place of a task's timer, and passes them on later."""

    def __init__(self, timer: LateTimer, target: Ticking, period_s: float, ran: RanTicks | None) -> None:
        self._timer = timer
        self._target = target
        self._period_s = period_s
        self._ran = ran
        self.most_s = min(0.9 * period_s, LATEST_S)
        self.ended = False

    def fire(self, deadline_s: float, missed: int) -> None:
        if self._ran is None:
            self._timer.hold_back(self, Tick(deadline_s, missed))
        elif (tick := self._ran.tick_at(deadline_s, self._period_s)) is not None:
            self._timer.hold_back(self, tick)

    def tick(self, tick: Tick) -> None:
        if not self.ended:
            self._target.fire(tick.time_s, tick.missed)
