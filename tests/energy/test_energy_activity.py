"""What a supervisor decides: fast while something happens, slow when it is quiet."""

import math

import pytest

from pancakes.control import Reschedule
from pancakes.devices import Infrared, Motion, Pose
from pancakes.energy.rate_supervisor import Activity, RatePair, Rule, SupervisorDecider, SupervisorSettings, number_of
from pancakes.settings import SettingsError, make_settings

RATES = {"device/ir": RatePair(10.0, 2.0)}
NEAR = Rule("ir", "ranges_m", RATES, below=0.1, quiet_after_s=5.0)
MOVES = Rule("motion", "detected", RATES, above=0.5, quiet_after_s=5.0)


def supervision(**rules):
    return SupervisorDecider(SupervisorSettings(rules), 0.0, doubt=False)


def decide(made, now_s):
    """Decides, and lets all that follows from it be done."""
    orders = made.decide(now_s)
    for seq, order in enumerate(orders, start=round(1000 * now_s)):
        made.asked(seq, order, now_s)
        assert made.answered(seq, True, "") == []
    return [order.body for order in orders]


@pytest.mark.parametrize(
    ("value", "number"),
    [
        (True, 1.0),
        (False, 0.0),
        (3, 3.0),
        (0.5, 0.5),
        ((0.3, 0.1, 0.2), 0.1),
        ((), None),
        (None, None),
        (math.nan, None),
    ],
)
def test_a_field_is_read_as_one_number(value, number):
    assert number_of(value) == number


def test_a_text_is_no_number():
    with pytest.raises(ValueError, match="'left' is not a number"):
        number_of("left")


def test_it_is_fast_at_first_and_slow_when_nothing_happens():
    made = supervision(moves=MOVES)
    assert decide(made, 4.9) == []
    assert decide(made, 5.0) == [Reschedule("device/ir", 2.0)]
    assert decide(made, 60.0) == []


def test_it_is_fast_again_with_the_packet_that_says_so():
    made = supervision(moves=MOVES)
    decide(made, 5.0)
    made.read("moves", Motion(False), 9.0)
    assert decide(made, 9.0) == []
    made.read("moves", Motion(True), 10.0)
    assert decide(made, 10.0) == [Reschedule("device/ir", 10.0)]
    assert decide(made, 14.9) == []
    assert decide(made, 15.0) == [Reschedule("device/ir", 2.0)]


def test_of_a_ring_of_sensors_the_nearest_counts():
    made = supervision(near=NEAR)
    decide(made, 5.0)
    made.read("near", Infrared((0.0, 1.0), (0.2, 0.09), 0.2), 6.0)
    assert decide(made, 6.0) == [Reschedule("device/ir", 10.0)]


def test_what_changes_slowly_is_noticed_in_the_end():
    activity = Activity(Rule("pose", "x_m", RATES, changes_by=0.1, quiet_after_s=1.0), 0.0)
    activity.read(0.0, 0.0)
    for step in range(1, 10):
        activity.read(0.01 * step, float(step))
    assert not activity.busy(9.0)
    activity.read(0.11, 10.0)
    assert activity.busy(10.0)


def test_a_task_of_two_rules_is_fast_while_either_says_so():
    made = supervision(moves=MOVES, near=NEAR)
    made.read("near", Infrared((0.0,), (0.05,), 0.2), 4.0)
    assert decide(made, 6.0) == []
    assert made.busy == {"moves": False, "near": True}
    assert decide(made, 9.0) == [Reschedule("device/ir", 2.0)]


def test_a_supervisor_that_stops_lets_all_be_fast():
    made = supervision(moves=MOVES)
    assert made.restore(1.0) == []
    decide(made, 5.0)
    assert [order.body for order in made.restore(6.0)] == [Reschedule("device/ir", 10.0)]


def test_a_field_that_is_not_there_is_an_error():
    made = supervision(wrong=Rule("pose", "z_m", RATES, above=0.0))
    with pytest.raises(AttributeError):
        made.read("wrong", Pose(0.0, 0.0, 0.0), 1.0)


RULE = {"when": "motion", "field": "detected", "rates": {"device/ir": {"fast": 10, "slow": 2}}}


@pytest.mark.parametrize(
    ("rules", "said"),
    [
        ({}, "at least one rule"),
        ({"a": RULE}, "one of above, below and changes_by"),
        ({"a": {**RULE, "above": 0.5, "below": 0.5}}, "one of above, below and changes_by"),
        ({"a": {**RULE, "above": 0.5, "rates": {}}}, "rates must name a task"),
        (
            {"a": {**RULE, "above": 0.5}, "b": {**RULE, "above": 0.5, "rates": {"device/ir": {"fast": 9, "slow": 2}}}},
            "the rule b and one before it disagree on the rates of device/ir",
        ),
    ],
)
def test_rules_that_make_no_sense_are_refused_with_a_reason(rules, said):
    with pytest.raises(SettingsError, match=said):
        make_settings(SupervisorSettings, {"rules": rules})
