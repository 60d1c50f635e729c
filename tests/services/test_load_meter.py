"""How busy an agent says it is."""

import threading

import pytest

from pancakes.migration.cost import MeasuredLoad
from pancakes.services.load import LoadMeter, host_share, processor_time_s
from pancakes.task import Task, every
from pancakes.testing import threaded_agent


class Timer:
    def __init__(self, period_s):
        self.period_s, self.ticks, self.missed_total, self.lateness_sum_s = period_s, 0, 0, 0.0


class Actor:
    def __init__(self, *timers):
        self.timers = dict(enumerate(timers))


def test_the_first_look_has_nothing_to_compare_with():
    used = iter([5.0, 6.0, 6.0])
    meter = LoadMeter(lambda: next(used), lambda: 0.75)
    assert meter.look(100.0, []) is None
    assert meter.look(104.0, []).agent_share == 0.25
    load = meter.look(106.0, [])
    assert (load.agent_share, load.host_share) == (0.0, 0.75)


def test_lateness_counts_in_periods_and_a_missed_tick_as_one():
    fast, slow = Timer(0.01), Timer(1.0)
    meter = LoadMeter(lambda: 0.0, lambda: 0.0)
    fast.ticks, fast.lateness_sum_s = 1000, 500.0  # before the first look: of no interest
    meter.look(0.0, [Actor(fast, slow)])
    fast.ticks, fast.lateness_sum_s = 1008, 500.02
    assert meter.look(1.0, [Actor(fast, slow)]).lateness_share == pytest.approx(2 / 8)
    fast.ticks, fast.missed_total = 1009, 1
    slow.ticks = 2
    assert meter.look(2.0, [Actor(fast, slow)]).lateness_share == pytest.approx(1 / 4)
    assert meter.look(3.0, [Actor(fast, slow)]).lateness_share == 0.0


def test_a_timer_that_rests_is_never_late():
    resting = Timer(float("inf"))
    meter = LoadMeter(lambda: 0.0, lambda: 0.0)
    meter.look(0.0, [Actor(resting)])
    assert meter.look(1.0, [Actor(resting)]).lateness_share == 0.0


def test_the_operating_system_tells_both_figures():
    assert processor_time_s() > 0.0
    assert host_share() >= 0.0


def test_an_agent_on_threads_measures_itself():
    class Ticking(Task):
        @every(hz=50)
        def tick(self, tick):
            pass

    with threaded_agent(tasks={"Ticking": Ticking}) as agent:
        migrator = agent.task("TaskMigrator", "network")
        measured = threading.Event()
        measure = migrator._measure

        def and_tell():
            measure()
            measured.set()

        migrator.call(and_tell)
        assert measured.wait(10.0)
        terms = MeasuredLoad().terms(migrator._load("nobody"))
        assert terms.keys() == {"agent", "host", "lateness"}
        assert 0.0 <= terms["agent"] < 1000.0
