"""What is worked out from figures: loads with bounds, missed ticks, batteries, other computers, what is unknown."""

from __future__ import annotations

import math

import pytest
from msgspec.structs import replace

from pancakes.tools.forecast import (
    Expected,
    MeasuredAgent,
    MeasuredBattery,
    MeasuredHost,
    MeasuredTask,
    MeasuredTimer,
    UnknownForecastError,
    forecast_move,
    forecast_rate,
    forecast_without,
)

HERE = MeasuredHost("here", 4, 0.5, 0.0005)
THERE = MeasuredHost("there", 2, 0.25, 0.001)


def task(name: str, tick_s: float, hz: float = 10.0, span_s: float = 10.0, **others) -> MeasuredTask:
    """A task all of whose ticks took the same."""
    ticks = round(hz * span_s)
    timer = MeasuredTimer("burn", hz, ticks, 0, ticks * tick_s, ticks * tick_s * tick_s)
    made = MeasuredTask("client", name, "Burn", "running", f"a/{name}", ticks, ticks * tick_s, (timer,))
    return replace(made, **others)


def agent(
    name: str, *tasks: MeasuredTask, host: MeasuredHost = HERE, besides_s: float = 0.0, **others
) -> MeasuredAgent:
    """An agent that was measured for 10 s, and takes `besides_s` of each turn besides it."""
    turn_s, turns = sum(it.turn_s for it in tasks), sum(it.turns for it in tasks)
    made = MeasuredAgent(name, 1.0, 10.0, turn_s + besides_s * turns, turns, turn_s, host, tuple(tasks))
    return replace(made, **others)


def near(expected: Expected, value: float) -> bool:
    return expected.value == pytest.approx(value) and expected.low <= expected.value <= expected.high


def test_a_move_takes_a_task_s_load_along_and_leaves_the_computer_as_busy_as_it_was():
    fleet = [agent("a", task("T", 0.02), task("U", 0.01)), agent("b")]
    forecast = forecast_move(fleet, "a", "T", "b")
    assert near(forecast.of("a").load_after, 0.1) and near(forecast.of("b").load_after, 0.2)
    assert forecast.of("a").load == pytest.approx(0.3)
    assert forecast.of("a").host_load_after == Expected(0.5, 0.5, 0.5)
    assert "measured for 10 s on a, b" in forecast.known_from[0]


def test_what_a_turn_takes_besides_may_go_along_or_not():
    said = forecast_move([agent("a", task("T", 0.02), besides_s=0.01), agent("b")], "a", "T", "b").of("b").load_after
    assert (said.low, said.value, said.high) == pytest.approx((0.2, 0.25, 0.3))
    assert said.sure_share == pytest.approx(0.2)


def test_ticks_that_take_now_this_now_that_are_less_sure():
    timer = MeasuredTimer("burn", 10.0, 100, 0, 2.0, 2 * 2.0 * 2.0 / 100)
    uneven = replace(task("T", 0.02), timers=(timer,))
    said = forecast_move([agent("a", uneven), agent("b")], "a", "T", "b").of("b").load_after
    assert said.value == pytest.approx(0.2) and said.sure_share == pytest.approx(2 * math.sqrt(100 / 99) / 10)


def test_another_computer_takes_as_much_longer_as_its_yardstick_and_both_computers_change():
    fleet = [agent("a", task("T", 0.02)), agent("b", host=THERE), agent("c", host=THERE)]  # which it does not concern
    forecast = forecast_move(fleet, "a", "T", "b")
    said = forecast.of("b").load_after
    assert near(said, 0.4) and said.sure_share == pytest.approx(0.05)
    assert near(forecast.of("a").host_load_after, 0.5 - 0.2 / 4)
    assert near(forecast.of("b").host_load_after, 0.25 + 0.4 / 2)
    assert [it.agent for it in forecast.agents] == ["a", "b"]
    assert "takes 2.00 times as long as on the computer of a" in forecast.notes[0]


def test_another_rate_changes_the_ticks_of_one_timer_alone():
    other = MeasuredTimer("look", 1.0, 10, 0, 0.1, 0.001)
    timers = (*task("T", 0.02).timers, other)
    both = replace(task("T", 0.02), timers=timers, turns=110, turn_s=2.1 + 0.4)  # 0.4 s for packets
    fleet = [agent("a", both)]
    assert near(forecast_rate(fleet, "a", "T", 20.0).of("a").load_after, 0.45)
    assert near(forecast_rate(fleet, "a", "T", 0.0).of("a").load_after, 0.05)
    assert near(forecast_rate(fleet, "a", "T", 11.0, "look").of("a").load_after, 0.35)
    fast = [replace(fleet[0], speed=2.0)]
    assert near(forecast_rate(fast, "a", "T", 5.0).of("a").load_after, 0.25), "its ticks are of mission time"


def test_beyond_one_processor_ticks_are_missed_and_below_it_few():
    fleet = [agent("a", task("T", 0.02)), agent("b", task("V", 0.05, 16.0))]
    forecast = forecast_move(fleet, "a", "T", "b")
    assert near(forecast.of("b").load_after, 1.0)
    fast = forecast_rate(fleet, "b", "V", 40.0)
    assert near(fast.of("b").load_after, 1.0) and near(fast.of("b").missed_hz_after, 40.0 * 0.5)
    assert any("would need 2.00 processors" in note for note in fast.notes)
    assert any("at most 20 fit into a second" in note for note in fast.notes)
    assert forecast_rate(fleet, "b", "V", 1.0).of("b").missed_hz_after.value == 0.0, "it waits for no others"
    crowded = [agent("b", task("V", 0.04, 20.0), task("W", 0.0001, 5.0))]
    assert 0.0 < forecast_rate(crowded, "b", "W", 20.0).of("b").missed_hz_after.value < 20.0
    busy = replace(task("V", 0.05, 16.0).timers[0], missed=30)
    missing = [agent("b", replace(task("V", 0.05, 16.0), timers=(busy,)))]
    assert forecast_rate(missing, "b", "V", 16.0).of("b").missed_hz_after.value == pytest.approx(3.0)
    forecast = forecast_move([*missing, agent("a")], "b", "V", "a")
    assert forecast.of("b").missed_hz == pytest.approx(3.0), "and they go with their task"
    assert forecast.of("b").missed_hz_after.value == forecast.of("a").missed_hz_after.value == 0.0


def test_native_code_that_takes_more_than_one_processor_may_go_on_so():
    fleet = [agent("a", task("T", 0.15)), agent("b", task("U", 0.01))]
    assert near(forecast_move(fleet, "b", "U", "a").of("a").load_after, 1.5)


def test_a_computer_that_is_full_may_give_no_more():
    full = MeasuredHost("here", 2, 0.97, 0.0005)
    said = forecast_rate([agent("a", task("T", 0.02), host=full)], "a", "T", 20.0)
    assert said.of("a").load_after.value == pytest.approx(0.4) and said.of("a").load_after.low == pytest.approx(0.2)
    assert "may get too little of it" in said.notes[0]


def test_a_battery_is_drained_as_before_or_as_much_faster_as_the_load_is_higher():
    battery = MeasuredBattery(0.501, 0.5)
    said = forecast_rate([agent("a", task("T", 0.02), battery=battery)], "a", "T", 20.0).of("a")
    assert said.battery_s == pytest.approx(5000.0)
    assert said.battery_after_s is not None
    assert (said.battery_after_s.low, said.battery_after_s.high) == pytest.approx((2500.0, 5000.0))
    for still in (MeasuredBattery(0.5, 0.5), MeasuredBattery(0.4, 0.5), MeasuredBattery(None, 0.5)):
        unknown = forecast_rate([agent("a", task("T", 0.02), battery=still)], "a", "T", 20.0).of("a")
        assert unknown.battery_s is None and unknown.battery_after_s is None


def test_an_agent_that_goes_leaves_its_tasks_to_others_and_some_end():
    stays = task("U", 0.01, state="stopped")
    fleet = [agent("a", task("T", 0.02), task("V", 0.03), stays, besides_s=0.001), agent("b"), agent("c", host=THERE)]
    forecast = forecast_without(fleet, "a", {"client/T": "b"})
    assert forecast.of("a").load_after == Expected(0.0, 0.0, 0.0)
    assert forecast.of("b").load_after.value == pytest.approx(0.205)
    gone = forecast.of("a").load - forecast.of("b").load_after.value
    assert forecast.of("b").host_load_after.value == pytest.approx(0.5 - gone / 4)
    assert [it.agent for it in forecast.agents] == ["a", "b"]
    assert forecast.notes == ("V would end with a: no other agent takes them",)


@pytest.mark.parametrize(
    ("ask", "sentence"),
    [
        (lambda fleet: forecast_move(fleet, "a", "T", "a"), "a/T is on a already"),
        (lambda fleet: forecast_move(fleet, "a", "X", "b"), "a has no task 'X', only T, S"),
        (lambda fleet: forecast_move(fleet, "x", "T", "b"), "the agent 'x' was not measured, only a, b"),
        (lambda fleet: forecast_move(fleet, "a", "S", "b"), "a/S is stopped"),
        (lambda fleet: forecast_rate(fleet, "a", "T", 5.0, "x"), "has no timer 'x', only burn"),
        (lambda fleet: forecast_rate(fleet, "a", "S", 5.0), "measure longer"),
        (lambda fleet: forecast_rate(fleet, "a", "T", math.inf), "inf is not a rate"),
        (lambda fleet: forecast_without(fleet, "x", {}), "the agent 'x' was not measured"),
    ],
)
def test_what_is_not_known_is_said(ask, sentence: str):
    fleet = [agent("a", task("T", 0.02), task("S", 0.02, hz=0.1, state="stopped")), agent("b")]
    with pytest.raises(UnknownForecastError, match=sentence):
        ask(fleet)


def test_two_of_one_name_are_asked_for_by_their_service():
    fleet = [agent("a", task("T", 0.02), task("T", 0.01, service="other")), agent("b")]
    with pytest.raises(UnknownForecastError, match="in client and in other: name the service"):
        forecast_move(fleet, "a", "T", "b")
    assert near(forecast_move(fleet, "a", "T", "b", "other").of("b").load_after, 0.1)
