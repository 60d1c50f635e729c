"""Ticks come when the task did something then."""

import pytest

from pancakes.runtime.clock import MissionClock
from pancakes.runtime.kernel.virtual import VirtualDispatcher
from pancakes.tools.replay.late_timer import LateTimer


class Target:
    """Remembers when it was ticked, and for which deadline."""

    def __init__(self, dispatcher):
        self._dispatcher = dispatcher
        self.ticks = []

    def fire(self, deadline_s, missed):
        self.ticks.append((pytest.approx(self._dispatcher.clock.now()), pytest.approx(deadline_s)))


def timer_of(spoken_s, speed=0.0):
    dispatcher = VirtualDispatcher()
    spoken = [spoken if isinstance(spoken, tuple) else (spoken, 0.0) for spoken in spoken_s]
    timer = LateTimer("a", MissionClock(dispatcher.clock), dispatcher, spoken, speed)
    return dispatcher, timer, Target(dispatcher)


def test_a_tick_is_held_back_until_the_task_spoke_and_others_are_on_time():
    dispatcher, timer, target = timer_of([1.2, 2.0, 3.7])
    timer.every(target, 1.0)
    dispatcher.run_until(4.5)
    # At 3.7 s it was too late for the tick of 3 s: none is held back for longer than half a second.
    assert target.ticks == [(1.2, 1.0), (2.0, 2.0), (3.0, 3.0), (4.0, 4.0)]


def test_it_began_a_moment_before_it_spoke():
    dispatcher, timer, target = timer_of([1.2], speed=50.0)
    timer.every(target, 1.0)
    dispatcher.run_until(1.5)
    assert target.ticks == [(1.19, 1.0)]


def test_it_began_after_whatever_it_had_said_before():
    dispatcher, timer, target = timer_of([(1.2, 1.195)], speed=50.0)
    timer.every(target, 1.0)
    dispatcher.run_until(1.5)
    assert target.ticks == [(1.195, 1.0)]


def test_a_timer_that_rests_or_changes_its_rate_does_not_tick_for_what_was_held_back():
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
