"""What a governor decides: which orders follow from which readings, and how the network sleeps."""

import math

import pytest

from pancakes.control import Configure, Describe, Reschedule, Restart, Start, Stop
from pancakes.energy.governor import GovernorDecider, GovernorSettings
from pancakes.energy.orders import Range, RateRange, Sleep
from pancakes.energy.policies import FeedbackSettings, Step

STEPS = [Step(0.6, 0.5), Step(0.3, 0.0)]


def settings(**changes):
    return GovernorSettings(**{"thresholds": STEPS, "rates": {"device/ir": RateRange(10.0, 2.0)}, **changes})


class Adjuster:
    """Stands in for the task: gives the orders, and answers them."""

    def __init__(self, wanted=None, **arguments):
        self.governing = GovernorDecider(wanted or settings(), 0.0, **arguments)
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
    adjuster = Adjuster()
    assert adjuster.governing.decide(1.0) == []
    adjuster.governing.battery(2.0, math.nan)
    assert adjuster.governing.decide(2.0) == []


def test_orders_follow_the_battery_down_and_up_again():
    adjuster = Adjuster()
    assert adjuster.at(0.9) == []
    assert adjuster.at(0.59) == [Reschedule("device/ir", 6.0)]
    assert adjuster.at(0.58) == []
    assert adjuster.at(0.29) == [Reschedule("device/ir", 2.0)]
    assert adjuster.at(0.95) == [Reschedule("device/ir", 10.0)], "everything is restored"
    assert adjuster.at(0.96) == []


def test_speeds_are_turned_by_settings():
    adjuster = Adjuster(settings(rates={}, values={"ScanTarget": {"speed_mps": Range(0.1, 0.04)}}))
    assert adjuster.at(0.2) == [Configure("ScanTarget", {"speed_mps": 0.04})]
    assert adjuster.at(1.0) == [Configure("ScanTarget", {"speed_mps": 0.1})]


def test_feedback_turns_the_same_knobs():
    wanted = settings(policy="feedback", feedback=FeedbackSettings(until_s=1000.0, period_s=10.0))
    adjuster = Adjuster(wanted)
    orders = [order for second in range(1, 60) for order in adjuster.at(1.0 - 0.005 * second)]
    rates = [order.rate_hz for order in orders]
    assert rates == sorted(rates, reverse=True) and rates[-1] == 2.0
    assert len(rates) == len(set(rates)), "no order is given twice"


def sleeper():
    return Adjuster(settings(rates={}, sleep=Sleep(every_s=20.0, for_s=10.0, from_effort=0.4)))


def sleeps(adjuster):
    adjuster.governing.on_event("service_stopped", {"service": "network"})


def wakes(adjuster):
    adjuster.governing.on_event("service_started", {"service": "network"})


def test_the_network_sleeps_and_wakes_in_turn():
    adjuster = sleeper()
    assert adjuster.at(0.59) == [], "from_effort is not reached"
    assert adjuster.at(0.29) == [Stop("network", for_s=10.0)]
    sleeps(adjuster)
    assert adjuster.at(0.28) == []
    wakes(adjuster)
    assert adjuster.at(0.27, wait_s=10.0) == [], "it woke a moment ago"
    assert adjuster.at(0.26, wait_s=10.0) == [Stop("network", for_s=10.0)]


def test_the_network_is_woken_when_the_battery_has_recovered():
    adjuster = sleeper()
    adjuster.at(0.2)
    sleeps(adjuster)
    assert adjuster.at(0.9) == [Start("network")]
    wakes(adjuster)
    assert adjuster.at(0.9) == []


def test_it_does_not_sleep_anew_while_it_sleeps():
    adjuster = sleeper()
    adjuster.at(0.2)
    sleeps(adjuster)
    assert adjuster.at(0.2, wait_s=60.0) == []


def test_why_the_network_does_not_sleep_is_said_once():
    adjuster = sleeper()
    adjuster.refuse[Stop] = "a1/network must not sleep while a1/client/Steer needs pose from elsewhere"
    for _ in range(5):
        adjuster.at(0.2, wait_s=20.0)
    assert adjuster.said == [f"the Network Service does not sleep: {adjuster.refuse[Stop]}"]
    adjuster.refuse[Stop] = "a hand-off is under way"
    adjuster.at(0.2, wait_s=20.0)
    assert len(adjuster.said) == 2
    del adjuster.refuse[Stop]
    assert adjuster.at(0.2, wait_s=20.0) == [Stop("network", for_s=10.0)], "it was tried all the same"


def test_beacons_wait_while_the_network_sleeps():
    adjuster = Adjuster(settings(rates={"network/Discovery": RateRange(1.0, 0.1)}))
    sleeps(adjuster)
    assert adjuster.at(0.2) == []
    wakes(adjuster)
    assert adjuster.at(0.2) == [Reschedule("network/Discovery", 0.1)]


def test_a_governor_that_stops_gives_everything_back():
    wanted = settings(sleep=Sleep(20.0, 10.0), values={"ScanTarget": {"speed_mps": Range(0.1, 0.04)}})
    adjuster = Adjuster(wanted)
    adjuster.at(0.2)
    sleeps(adjuster)
    back = adjuster.carry_out(adjuster.governing.restore(adjuster.now_s))
    assert back == [Reschedule("device/ir", 10.0), Configure("ScanTarget", {"speed_mps": 0.1}), Start("network")]


def test_a_network_that_sleeps_with_slow_beacons_is_woken_as_it_is_configured():
    adjuster = Adjuster(settings(rates={"network/Discovery": RateRange(1.0, 0.1)}, sleep=Sleep(20.0, 10.0)))
    assert adjuster.at(0.2) == [Reschedule("network/Discovery", 0.1), Stop("network", for_s=10.0)]
    sleeps(adjuster)
    back = adjuster.carry_out(adjuster.governing.restore(adjuster.now_s))
    assert back == [Restart("network", keep_state=False)]


def test_a_sleep_that_was_never_answered_is_asked_for_again():
    adjuster = sleeper()
    adjuster.governing.battery(1.0, 0.2)
    (order,) = adjuster.governing.decide(1.0)
    adjuster.governing.asked(1, order, 1.0)
    assert adjuster.governing.decide(10.0) == []
    assert [order.body for order in adjuster.governing.decide(30.0)] == [Stop("network", for_s=10.0)]


def test_a_governor_that_never_turned_anything_has_nothing_to_give_back():
    adjuster = Adjuster()
    adjuster.at(0.9)
    assert adjuster.governing.restore(2.0) == []


def test_the_successor_of_a_governor_goes_on_where_it_was():
    adjuster = Adjuster(effort=0.5, doubt=True)
    assert adjuster.at(0.61) == [Describe("device/ir")], "within the hysteresis, the effort is still 0.5"
    assert adjuster.governing.effort == 0.5


@pytest.mark.parametrize("policy", ["thresholds", "feedback"])
def test_a_load_is_heard_by_the_policy_that_has_a_use_for_it(policy):
    limits = FeedbackSettings(until_s=1e6, period_s=10.0, load_at_most=0.5)
    governing = GovernorDecider(settings(policy=policy, feedback=limits), 0.0)
    for second in range(1, 100):
        governing.load(1.0)
        governing.load(math.nan)
        governing.battery(float(second), 1.0)
        governing.decide(float(second))
    assert (governing.effort < 1.0) is (policy == "feedback")
