"""The late timer delays ticks to the times at which the task published then."""

import pytest

from pancakes.kernel.actor import ActorCore
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.virtual_time import VirtualDispatcher
from pancakes.recording.task_statistics import TickRun
from pancakes.task import every
from pancakes.tools.replay.recorded_run import RanTicks
from pancakes.tools.replay.rerun import LateTimer
from pancakes.util.clock import MissionClock


class Target:
    """Remembers when it was ticked, and for which deadline."""

    def __init__(self, dispatcher):
        self._dispatcher = dispatcher
        self.ticks = []

    def fire(self, deadline_s, missed):
        self.ticks.append((pytest.approx(self._dispatcher.clock.now()), pytest.approx(deadline_s)))


def timer_of(spontaneous_s, speed=0.0):
    dispatcher = VirtualDispatcher()
    spoken = [spoken if isinstance(spoken, tuple) else (spoken, 0.0) for spoken in spontaneous_s]
    timer = LateTimer("a", MissionClock(dispatcher.clock), dispatcher, spoken, speed)
    return dispatcher, timer, Target(dispatcher)


def test_tick_is_delayed_until_the_task_published():
    dispatcher, timer, target = timer_of([1.2, 2.0, 3.7])
    timer.every(target, 1.0)
    dispatcher.run_until(4.5)
    # 3.7 s is too late for the tick of 3 s: no tick is delayed by more than half a second.
    assert target.ticks == [(1.2, 1.0), (2.0, 2.0), (3.0, 3.0), (4.0, 4.0)]


def test_delayed_tick_begins_before_the_publication():
    dispatcher, timer, target = timer_of([1.2], speed=50.0)
    timer.every(target, 1.0)
    dispatcher.run_until(1.5)
    assert target.ticks == [(1.19, 1.0)]


def test_delayed_tick_begins_after_the_packet_before():
    dispatcher, timer, target = timer_of([(1.2, 1.195)], speed=50.0)
    timer.every(target, 1.0)
    dispatcher.run_until(1.5)
    assert target.ticks == [(1.195, 1.0)]


def test_cancelled_timer_drops_its_delayed_tick():
    dispatcher, timer, target = timer_of([1.2, 2.1])
    timer.every(target, 1.0)
    dispatcher.run_until(1.1)
    timer.every(target, 2.0)
    dispatcher.run_until(2.05)
    assert target.ticks == []
    dispatcher.run_until(2.5)
    assert target.ticks == [(2.1, 2.0)]
    timer.cancel(target)
    timer.cancel(target)
    dispatcher.run_until(9.0)
    assert len(target.ticks) == 1


def test_only_recorded_ticks_run():
    """They are as late as recorded, and know how many ticks were missed."""
    dispatcher = VirtualDispatcher()
    ran = RanTicks(1.0, [TickRun(2.0, 1.0, 1, 1), TickRun(5.0, 1.0, 2, 2, 0.75)], complete=True)
    timer = LateTimer("a", MissionClock(dispatcher.clock), dispatcher, [(2.2, 0.0)], 0.0, {"tick": ran})
    kernel = Kernel("a", virtual=dispatcher)
    kernel.timer.halt()
    kernel.timer = timer
    ticks = []

    class Ticks(ActorCore):
        @every(hz=1)
        def tick(self, tick):
            ticks.append((tick.time_s, tick.missed, pytest.approx(tick.lateness_s)))

        @every(hz=0.25)
        def other(self, tick):
            ticks.append(tick.time_s)

    kernel.spawn(Ticks, "a/client/Ticks")
    dispatcher.run_until(9.5)
    assert ticks == [(2.0, 1, 0.2), 4.0, (5.0, 2, 0.75), (6.0, 0, 0.0), 8.0]
