"""The feedback law, on batteries made up for it: it converges, lasts until the wanted end, and leaves little over."""

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from pancakes.energy.policies import Feedback, FeedbackSettings, slope


class Pack:
    """A battery that loses `idle + swing * effort` of its level each second, and what the law makes of it."""

    def __init__(self, idle, swing, noise=0.0, **wanted):
        self.law = Feedback(FeedbackSettings(**{"until_s": 1000.0, "period_s": 20.0, **wanted}), 0.0)
        self.idle, self.swing, self.noise = idle, swing, noise
        self.level, self.now_s = 1.0, 0
        self.efforts = [1.0]

    def run(self, until_s):
        while self.now_s < until_s:
            self.now_s += 1
            self.level = max(self.level - self.idle - self.swing * self.law.effort, 0.0)
            off = self.noise if self.now_s % 2 else -self.noise
            self.law.battery(float(self.now_s), self.level + off)
            self.efforts.append(self.law.decide(float(self.now_s)))
        return self


def test_it_lasts_until_the_wanted_end_and_leaves_only_the_reserve():
    pack = Pack(idle=0.0003, swing=0.0017, reserve=0.05).run(1000)
    assert pack.level == pytest.approx(0.05, abs=0.02), "without it, it would have been empty at 500 s"


def test_a_battery_that_lasts_anyway_is_left_alone():
    pack = Pack(idle=0.0002, swing=0.0005).run(1000)
    assert set(pack.efforts) == {1.0}


def test_one_that_cannot_last_gets_the_least():
    pack = Pack(idle=0.002, swing=0.001).run(400)
    assert pack.efforts[-1] == 0.0


def test_below_the_reserve_it_asks_for_the_least():
    pack = Pack(idle=0.0, swing=0.0017, reserve=0.9).run(200)
    assert pack.efforts[-1] == 0.0


def test_it_gives_everything_back_where_the_battery_is_charged():
    pack = Pack(idle=0.0003, swing=0.0017).run(400)
    assert pack.efforts[-1] < 0.6
    pack.idle, pack.swing, pack.level = -0.0005, 0.0, 0.7
    pack.run(600)
    assert pack.efforts[-1] == 1.0


def test_past_the_wanted_end_it_stays_as_it_is():
    pack = Pack(idle=0.0003, swing=0.0017, until_s=300.0, reserve=0.6).run(300)
    effort = pack.efforts[-1]
    assert 0.0 < effort < 1.0
    pack.run(500)
    assert pack.efforts[-1] == effort


def test_it_decides_once_in_a_period():
    pack = Pack(idle=0.0003, swing=0.0017, least_change=0.0).run(200)
    changes = [second for second, (before, after) in enumerate(pairwise(pack.efforts), 1) if before != after]
    assert changes and all(second % 20 == 0 for second in changes)


def test_a_tremor_is_no_order():
    pack = Pack(idle=0.0003, swing=0.0017, noise=0.0005, least_change=0.1).run(900)
    changes = [abs(after - before) for before, after in pairwise(pack.efforts) if before != after]
    assert changes and min(changes) >= 0.1


@settings(max_examples=60, deadline=None)
@given(
    idle=some.floats(0.0, 0.0007),
    swing=some.floats(0.001, 0.003),
    gain=some.floats(0.2, 0.4),
    noise=some.floats(0.0, 0.0005),
)
def test_it_converges_wherever_the_wanted_end_can_be_reached(idle, swing, gain, noise):
    """Consumption comes to its set-point, and stays: the end is reached with about the reserve."""
    pack = Pack(idle, swing, noise, gain=gain, reserve=0.05, least_change=0.02).run(600)
    settled = pack.run(800).efforts[-200:]
    pack.run(1000)
    if idle + swing <= 0.95 / 1000:
        assert pack.level >= 0.05 - 0.01, "there was no need to save"
        return
    assert pack.level == pytest.approx(0.05, abs=0.05)
    assert max(settled) - min(settled) <= 0.15, "it has settled long before the end"


def test_a_busy_processor_lowers_the_effort_too():
    law = Feedback(FeedbackSettings(until_s=1e6, period_s=10.0, load_at_most=0.5), 0.0)
    effort = 1.0
    for second in range(1, 400):
        law.battery(float(second), 1.0)
        law.load(0.1 + 0.8 * effort)
        effort = law.decide(float(second))
    assert 0.1 + 0.8 * effort == pytest.approx(0.5, abs=0.05)


def test_the_stricter_of_the_two_counts():
    busy = FeedbackSettings(until_s=1000.0, period_s=10.0, load_at_most=0.5)
    law = Feedback(busy, 0.0)
    for second in range(1, 200):
        law.battery(float(second), 1.0 - 0.0001 * second)
        law.load(0.9)
        law.decide(float(second))
    assert law.effort == 0.0, "the battery would last, the processor would not"


def test_two_readings_say_nothing():
    law = Feedback(FeedbackSettings(until_s=100.0, period_s=10.0), 0.0)
    law.battery(1.0, 1.0)
    law.battery(9.0, 0.2)
    assert law.decide(10.0) == 1.0


def test_the_slope_is_that_of_the_best_line():
    assert slope([(0.0, 1.0), (1.0, 3.0), (2.0, 5.0)]) == pytest.approx(2.0)
    assert slope([(0.0, 0.0), (1.0, 1.0), (2.0, 0.0)]) == pytest.approx(0.0)
    assert slope([(1.0, 1.0), (1.0, 3.0), (1.0, 5.0)]) == 0.0
