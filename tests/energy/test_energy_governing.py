"""What a governor decides: which orders follow from which readings, and how the network sleeps."""

import math

import pytest

from pancakes.control import Configure, Describe, Reschedule, Restart, Start, Stop
from pancakes.energy.governor import Governing, GovernorSettings
from pancakes.energy.orders import Range, RateRange, Sleep
from pancakes.energy.policies import FeedbackSettings, Step

STEPS = [Step(0.6, 0.5), Step(0.3, 0.0)]


def settings(**changes):
    return GovernorSettings(**{"thresholds": STEPS, "rates": {"device/ir": RateRange(10.0, 2.0)}, **changes})


class Rim:
    """Stands in for the task: gives the orders, and answers them."""

    def __init__(self, wanted=None, **arguments):
        self.governing = Governing(wanted or settings(), 0.0, **arguments)
        self.now_s = 0.0
        self.seq = 0
        self.refuse = {}
        self.said = []

    def at(self, level, wait_s=1.0):
        """A reading of the battery, a decision, and the answers; returns what was asked for."""
        self.now_s += wait_s
        self.governing.battery(self.now_s, level)
        return self.carry_out(self.governing.decide(self.now_s))

    def carry_out(self, orders):
        for order in orders:
            self.seq += 1
            self.governing.asked(self.seq, order, self.now_s)
            reason = self.refuse.get(type(order.body), "")
            self.said += self.governing.answered(self.seq, not reason, reason)
        return [order.body for order in orders]


def test_nothing_is_decided_before_the_battery_has_spoken():
    rim = Rim()
    assert rim.governing.decide(1.0) == []
    rim.governing.battery(2.0, math.nan)
    assert rim.governing.decide(2.0) == []


def test_orders_follow_the_battery_down_and_up_again():
    rim = Rim()
    assert rim.at(0.9) == []
    assert rim.at(0.59) == [Reschedule("device/ir", 6.0)]
    assert rim.at(0.58) == []
    assert rim.at(0.29) == [Reschedule("device/ir", 2.0)]
    assert rim.at(0.95) == [Reschedule("device/ir", 10.0)], "everything is restored"
    assert rim.at(0.96) == []


def test_speeds_are_turned_by_settings():
    rim = Rim(settings(rates={}, values={"ScanTarget": {"speed_mps": Range(0.1, 0.04)}}))
    assert rim.at(0.2) == [Configure("ScanTarget", {"speed_mps": 0.04})]
    assert rim.at(1.0) == [Configure("ScanTarget", {"speed_mps": 0.1})]


def test_feedback_turns_the_same_knobs():
    wanted = settings(policy="feedback", feedback=FeedbackSettings(until_s=1000.0, period_s=10.0))
    rim = Rim(wanted)
    orders = [order for second in range(1, 60) for order in rim.at(1.0 - 0.005 * second)]
    rates = [order.rate_hz for order in orders]
    assert rates == sorted(rates, reverse=True) and rates[-1] == 2.0
    assert len(rates) == len(set(rates)), "no order is given twice"


def sleeper():
    return Rim(settings(rates={}, sleep=Sleep(every_s=20.0, for_s=10.0, from_effort=0.4)))


def sleeps(rim):
    rim.governing.happened("service_stopped", {"service": "network"})


def wakes(rim):
    rim.governing.happened("service_started", {"service": "network"})


def test_the_network_sleeps_and_wakes_in_turn():
    rim = sleeper()
    assert rim.at(0.59) == [], "from_effort is not reached"
    assert rim.at(0.29) == [Stop("network", for_s=10.0)]
    sleeps(rim)
    assert rim.at(0.28) == []
    wakes(rim)
    assert rim.at(0.27, wait_s=10.0) == [], "it woke a moment ago"
    assert rim.at(0.26, wait_s=10.0) == [Stop("network", for_s=10.0)]


def test_the_network_is_woken_when_the_battery_has_recovered():
    rim = sleeper()
    rim.at(0.2)
    sleeps(rim)
    assert rim.at(0.9) == [Start("network")]
    wakes(rim)
    assert rim.at(0.9) == []


def test_it_does_not_sleep_anew_while_it_sleeps():
    rim = sleeper()
    rim.at(0.2)
    sleeps(rim)
    assert rim.at(0.2, wait_s=60.0) == []


def test_why_the_network_does_not_sleep_is_said_once():
    rim = sleeper()
    rim.refuse[Stop] = "a1/network must not sleep while a1/client/Steer needs pose from elsewhere"
    for _ in range(5):
        rim.at(0.2, wait_s=20.0)
    assert rim.said == [f"the Network Service does not sleep: {rim.refuse[Stop]}"]
    rim.refuse[Stop] = "a hand-off is under way"
    rim.at(0.2, wait_s=20.0)
    assert len(rim.said) == 2
    del rim.refuse[Stop]
    assert rim.at(0.2, wait_s=20.0) == [Stop("network", for_s=10.0)], "it was tried all the same"


def test_beacons_wait_while_the_network_sleeps():
    rim = Rim(settings(rates={"network/Discovery": RateRange(1.0, 0.1)}))
    sleeps(rim)
    assert rim.at(0.2) == []
    wakes(rim)
    assert rim.at(0.2) == [Reschedule("network/Discovery", 0.1)]


def test_a_governor_that_stops_gives_everything_back():
    wanted = settings(sleep=Sleep(20.0, 10.0), values={"ScanTarget": {"speed_mps": Range(0.1, 0.04)}})
    rim = Rim(wanted)
    rim.at(0.2)
    sleeps(rim)
    back = rim.carry_out(rim.governing.give_back(rim.now_s))
    assert back == [Reschedule("device/ir", 10.0), Configure("ScanTarget", {"speed_mps": 0.1}), Start("network")]


def test_a_network_that_sleeps_with_slow_beacons_is_woken_as_it_is_configured():
    rim = Rim(settings(rates={"network/Discovery": RateRange(1.0, 0.1)}, sleep=Sleep(20.0, 10.0)))
    assert rim.at(0.2) == [Reschedule("network/Discovery", 0.1), Stop("network", for_s=10.0)]
    sleeps(rim)
    back = rim.carry_out(rim.governing.give_back(rim.now_s))
    assert back == [Restart("network", keep_state=False)]


def test_a_sleep_that_was_never_answered_is_asked_for_again():
    rim = sleeper()
    rim.governing.battery(1.0, 0.2)
    (order,) = rim.governing.decide(1.0)
    rim.governing.asked(1, order, 1.0)
    assert rim.governing.decide(10.0) == []
    assert [order.body for order in rim.governing.decide(30.0)] == [Stop("network", for_s=10.0)]


def test_a_governor_that_never_turned_anything_has_nothing_to_give_back():
    rim = Rim()
    rim.at(0.9)
    assert rim.governing.give_back(2.0) == []


def test_the_successor_of_a_governor_goes_on_where_it_was():
    rim = Rim(effort=0.5, doubt=True)
    assert rim.at(0.61) == [Describe("device/ir")], "within the hysteresis, the effort is still 0.5"
    assert rim.governing.effort == 0.5


@pytest.mark.parametrize("policy", ["thresholds", "feedback"])
def test_a_load_is_heard_by_the_policy_that_has_a_use_for_it(policy):
    limits = FeedbackSettings(until_s=1e6, period_s=10.0, load_at_most=0.5)
    governing = Governing(settings(policy=policy, feedback=limits), 0.0)
    for second in range(1, 100):
        governing.load(1.0)
        governing.load(math.nan)
        governing.battery(float(second), 1.0)
        governing.decide(float(second))
    assert (governing.effort < 1.0) is (policy == "feedback")
