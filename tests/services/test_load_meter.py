"""How busy an agent says it is."""

from typing import Any

import pytest

from pancakes.control import Describe
from pancakes.durable.host_state import LoadMeter, MeasuredLoad, host_share, processor_time_s
from pancakes.task import Task, every
from pancakes.testing import threaded_agent


class Ticking(Task):
    @every(hz=50)
    def tick(self, tick):
        pass


class Timer:
    def __init__(self, period_s):
        self.period_s, self.ticks, self.missed_total, self.lateness_sum_s = period_s, 0, 0, 0.0


def look(meter: LoadMeter, now_s: float, *timers: Any) -> MeasuredLoad:
    """Returns the load since the look before, of which there was one."""
    load = meter.look(now_s, timers)
    assert load is not None
    return load


def test_the_first_look_has_nothing_to_compare_with():
    used = iter([5.0, 6.0, 6.0])
    meter = LoadMeter(lambda: next(used), lambda: 0.75)
    assert meter.look(100.0, []) is None
    assert look(meter, 104.0).agent_share == 0.25
    load = look(meter, 106.0)
    assert (load.agent_share, load.host_share) == (0.0, 0.75)


def test_lateness_counts_in_periods_and_a_missed_tick_as_one():
    fast, slow = Timer(0.01), Timer(1.0)
    meter = LoadMeter(lambda: 0.0, lambda: 0.0)
    fast.ticks, fast.lateness_sum_s = 1000, 500.0  # before the first look: of no interest
    timers: Any = [fast, slow]
    meter.look(0.0, timers)
    fast.ticks, fast.lateness_sum_s = 1008, 500.02
    assert look(meter, 1.0, *timers).lateness_share == pytest.approx(2 / 8)
    fast.ticks, fast.missed_total = 1009, 1
    slow.ticks = 2
    assert look(meter, 2.0, *timers).lateness_share == pytest.approx(1 / 4)
    assert look(meter, 3.0, *timers).lateness_share == 0.0


def test_of_a_timer_that_is_new_all_ticks_count():
    new = Timer(0.5)
    meter = LoadMeter(lambda: 0.0, lambda: 0.0)
    meter.look(0.0, [])
    new.ticks, new.missed_total, new.lateness_sum_s = 3, 1, 0.5
    assert look(meter, 1.0, new).lateness_share == pytest.approx((0.5 / 0.5 + 1) / 4)


def test_a_timer_that_rests_is_never_late():
    resting = Timer(float("inf"))
    meter = LoadMeter(lambda: 0.0, lambda: 0.0)
    timers: Any = [resting]
    meter.look(0.0, timers)
    assert look(meter, 1.0, *timers).lateness_share == 0.0


def test_the_operating_system_tells_both_figures():
    assert processor_time_s() > 0.0
    assert host_share() >= 0.0


def test_an_agent_on_threads_measures_itself():
    with threaded_agent(tasks={"Ticking": Ticking}) as agent:
        agent.wait_until(lambda: agent.ask(Describe()).result["load"] is not None)
        load = agent.ask(Describe()).result["load"]
        assert load.keys() == {"agent_share", "host_share", "lateness_share"}
        assert 0.0 <= load["agent_share"] < 10.0
