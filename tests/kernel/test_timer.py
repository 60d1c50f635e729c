"""The timer actor: on a thread, and in virtual time with the same behaviour."""

import math
import threading
from typing import Any

import pytest

from pancakes.kernel.timer import Due, Timer, VirtualTimer
from pancakes.kernel.virtual_time import VirtualDispatcher
from pancakes.testing import no_thread_left
from pancakes.util.clock import MissionClock, MonotonicClock, VirtualClock


class Ticker:
    """Notes its ticks."""

    def __init__(self):
        self.deadlines = []
        self.missed = 0
        self.missed_before = 0
        self.news = threading.Condition()

    def fire(self, deadline_s, missed):
        with self.news:
            if not self.deadlines:
                self.missed_before = missed
            self.deadlines.append(deadline_s)
            self.missed += missed
            self.news.notify_all()

    def wait(self, count):
        with self.news:
            assert self.news.wait_for(lambda: len(self.deadlines) >= count, 10.0)


class VirtualRig:
    """A timer in virtual time."""

    def __init__(self, speed=1.0, held=False):
        self.dispatcher = VirtualDispatcher(1)
        self.mission = MissionClock(self.dispatcher.clock, speed, held)
        self.timer = VirtualTimer("a", self.mission, self.dispatcher)

    def run_until(self, host_s):
        self.dispatcher.run_until(host_s)


def test_ten_a_second_is_ten_a_second():
    rig, ticker = VirtualRig(), Ticker()
    rig.timer.every(ticker, 0.1)
    rig.run_until(60.0)
    assert len(ticker.deadlines) == 600
    assert ticker.missed == 0


def test_a_mission_that_is_held_ticks_no_target_until_it_begins():
    rig, ticker = VirtualRig(held=True), Ticker()
    rig.timer.every(ticker, 0.5)
    rig.run_until(100.0)
    assert ticker.deadlines == []
    rig.mission.begin(2.0)
    rig.timer.wake()
    rig.run_until(102.9)
    assert ticker.deadlines == [0.5]
    assert rig.mission.now() == pytest.approx(0.9)


def test_a_faster_mission_ticks_more_often_on_the_wall_and_as_often_in_the_mission():
    rig, ticker = VirtualRig(speed=5.0), Ticker()
    rig.timer.every(ticker, 0.1)
    rig.run_until(2.0)
    assert ticker.deadlines == [pytest.approx(0.1 * k) for k in range(1, 101)]


def test_calls_are_put_off_on_either_clock():
    rig, calls = VirtualRig(speed=4.0), []
    rig.timer.after(2.0, lambda: calls.append(("mission", rig.dispatcher.clock.now())))
    rig.timer.after_host(2.0, lambda: calls.append(("host", rig.dispatcher.clock.now())))
    rig.run_until(10.0)
    assert calls == [("mission", 0.5), ("host", 2.0)]


def test_a_call_that_is_called_off_does_not_come():
    rig, calls = VirtualRig(), []
    shot = rig.timer.after(1.0, lambda: calls.append(1))
    shot.cancel()
    rig.run_until(5.0)
    assert calls == []


def test_a_call_that_puts_itself_off_again_goes_on_for_ever():
    rig, times = VirtualRig(), []

    def again():
        times.append(rig.dispatcher.clock.now())
        rig.timer.after(1.0, again)

    rig.timer.after(1.0, again)
    rig.run_until(5.5)
    assert times == [1.0, 2.0, 3.0, 4.0, 5.0]


def test_a_delay_must_be_a_number():
    rig = VirtualRig()
    for put_off in (rig.timer.after, rig.timer.after_host):
        with pytest.raises(ValueError, match="a delay must be a number"):
            put_off(math.nan, lambda: None)


def test_a_halted_timer_does_nothing_more():
    rig, ticker = VirtualRig(), Ticker()
    rig.timer.every(ticker, 1.0)
    rig.run_until(2.0)
    rig.timer.halt()
    rig.timer.every(Ticker(), 1.0)
    rig.run_until(9.0)
    assert ticker.deadlines == [1.0, 2.0]


def test_on_a_thread_it_ticks_in_order_changes_rates_and_ends():
    with no_thread_left():
        host = MonotonicClock()
        timer = Timer("a", MissionClock(host), host)
        timer.launch()
        fast, slow = Ticker(), Ticker()
        timer.every(fast, 0.01)
        timer.every(slow, 0.05)
        fast.wait(10)
        slow.wait(2)
        timer.every(fast, 0.005)
        fast.wait(30)
        done = threading.Event()
        timer.after(0.01, done.set)
        assert done.wait(10.0)
        timer.halt()
    for ticker in (fast, slow):
        assert ticker.deadlines == sorted(dict.fromkeys(ticker.deadlines))
    # However late the machine made it, each deadline came or was counted as missed.
    steps = [round(deadline / 0.05) for deadline in slow.deadlines]
    assert steps[-1] - steps[0] + 1 == len(steps) + slow.missed - slow.missed_before


def test_on_a_thread_a_held_mission_begins_when_it_is_woken():
    with no_thread_left():
        host = MonotonicClock()
        mission = MissionClock(host, held=True)
        timer = Timer("a", mission, host)
        timer.launch()
        ticker = Ticker()
        timer.every(ticker, 0.01)
        mission.begin()
        timer.wake()
        ticker.wait(3)
        timer.halt()


def test_what_one_thread_of_the_timer_has_left_the_next_does_at_once():
    """Though nothing else is due for a long time."""
    with no_thread_left():
        host = MonotonicClock()
        ticker = Ticker()

        class Successor(Timer):
            def __init__(self):
                super().__init__("a", MissionClock(host), host)
                self._due.append(Due(iter([ticker]), 1.0, 0))

        timer = Successor()
        timer.launch()
        ticker.wait(1)
        timer.halt()


def test_a_call_that_fails_ends_no_other(caplog):
    with no_thread_left():
        host = MonotonicClock()
        timer = Timer("a", MissionClock(host), host)
        timer.launch()
        done = threading.Event()

        def fail():
            raise ZeroDivisionError

        timer.after_host(0.0, fail)
        timer.after_host(0.001, done.set)
        assert done.wait(10.0), "the timer's thread has ended"
        timer.halt()
    assert [record.message for record in caplog.records] == ["a call of the timer failed"], "once, not again and again"


def test_a_message_just_before_something_is_due_delays_nothing():
    """With a `queue.SimpleQueue` as its inbox the timer stood still then, until it was told something else."""
    with no_thread_left():
        host = VirtualClock()
        told, served = threading.Semaphore(0), threading.Semaphore(0)

        class Served(Timer):
            def _serve(self, guest):
                served.release()

        timer = Served("a", MissionClock(host), host)
        timer.after_host(1e-9, lambda: None)
        timer.launch()
        for _ in range(3000):
            timer.actor_inbox.put(told.release)
            assert told.acquire(timeout=10.0)
            while served.acquire(blocking=False):
                pass
            assert served.acquire(timeout=10.0), "it waits for ever"
        timer.halt()


class HaltedInACall(Timer):
    """Is told to end while it is in a call, which then goes on."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.told = threading.Event()

    def stop(self) -> None:
        super().stop()
        self.told.set()


def test_a_timer_that_is_halted_in_a_call_has_ended_once_that_returns() -> None:
    host = MonotonicClock()
    timer = HaltedInACall("halted", MissionClock(host), host)
    timer.launch()
    (thread,) = [thread for thread in threading.enumerate() if thread.name == "halted-timer"]
    begun = threading.Event()

    def call() -> None:
        begun.set()
        assert timer.told.wait(10.0)

    timer.after_host(0.0, call)
    assert begun.wait(10.0)
    timer.halt()
    assert not thread.is_alive()
    assert thread.daemon, "a call that does not come back must not keep the process"
