"""The verdict on the energy demo, on measures made up for it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from pancakes.tools.demo import Run
from pancakes_encirclement.endurance import Drain, Endurance, endurance, share_of
from pancakes_encirclement.energy_verdict import judge_energy
from pancakes_encirclement.record import Record, Row
from pancakes_encirclement.scenario import Scenario

POWER = {"motion": 1.0, "sensing": 0.5, "listening": 0.5, "sending": 0.2, "idle": 0.4}


def summary(**changes: Any) -> dict[str, Any]:
    off = {"mean": 0.1, "p95": 0.2, "max": 0.3}
    made = {"reasons": [], "duration_s": 540.0, "policy": "", "lasted_s": 300.0, "empty": True, "until_s": None}
    made |= {"reserve": None, "left": None, "off_circle_m": off, "laps": 8.0, "lap_s": 37.5, "mean_power_w": POWER}
    return {**made, "orders": 0, **changes}


FEEDBACK = {"policy": "feedback", "lasted_s": 490.0, "until_s": 480.0, "reserve": 0.02, "left": 0.03, "orders": 40}


def judged(plain: dict[str, Any] | None = None, **changes: Any) -> dict[str, Any]:
    run = Run(Path(), 1, 540.0, 540.0, "", {})
    summaries = {"plain": summary(**(plain or {})), "feedback": summary(**{**FEEDBACK, **changes})}
    return judge_energy(Path(), {"plain": run, "feedback": run}, summaries)


def test_a_mission_that_lasts_longer_and_keeps_to_its_circle_passes():
    verdict = judged()
    assert (verdict["verdict"], verdict["reasons"]) == ("PASS", [])
    assert verdict["variants"]["feedback"]["longer"] == pytest.approx(490 / 300, abs=1e-5)
    assert any(line.startswith("feedback") and "+63%" in line and "490 s" in line for line in verdict["said"])


@pytest.mark.parametrize(
    ("plain", "changes", "said"),
    [
        ({"empty": False, "lasted_s": 540.0}, {}, "the battery outlasts the mission"),
        ({"reasons": ["there were 1 collisions"]}, {}, "plain: there were 1 collisions"),
        ({}, {"lasted_s": 310.0, "until_s": None}, "feedback: it lasts 1.03 times as long, less than 1.25 times"),
        ({}, {"lasted_s": 310.0, "until_s": None, "empty": False}, "too early to see how long it lasts"),
        ({}, {"off_circle_m": {"mean": 0.3, "p95": 0.5, "max": 0.6}}, "0.300 m off the circle on average"),
        ({}, {"lasted_s": 470.0}, "the battery was empty at 470 s, before the wanted end at 480 s"),
        ({}, {"left": 0.4, "empty": False, "lasted_s": 540.0}, "40% of the battery were left at the wanted end"),
    ],
)
def test_what_is_wrong_is_said(plain: dict[str, Any], changes: dict[str, Any], said: str):
    verdict = judged(plain, **changes)
    assert verdict["verdict"] == "FAIL"
    assert any(said in reason for reason in verdict["reasons"]), verdict["reasons"]


SCENARIO = Scenario("r", ("r",), "sensor", ("walker",), "ScanTarget", "", 0.5, 2.0, 2.0, {"r": (8.4, 6.6)})


def flown(empty_s: float = 100.0, off_m: float = 0.1, end_s: float = 200.0) -> Endurance:
    """A robot that goes round, clockwise and once in 40 s, someone who stands at (1, 0)."""
    robot, walker, drains = [], [], []
    for step in range(round(end_s * 10) + 1):
        t_s = step / 10
        angle = -math.tau * t_s / 40.0
        radius_m = 0.5 + (off_m if t_s > 20.0 else 0.0)
        volts = max(8.4 - 1.8 * t_s / empty_s, 6.6)
        robot.append(Row(t_s, 1.0 + radius_m * math.cos(angle), radius_m * math.sin(angle), 0.0, 0.1, 0.0, volts, ""))
        walker.append(Row(t_s, 1.0, 0.0, 0.0, 0.0, 0.0, None, ""))
        if step % 10 == 0:
            drains.append(Drain(t_s, {kind: power * min(t_s, empty_s) for kind, power in POWER.items()}))
    return endurance(Record(paths={"r": robot, "walker": walker}, events=[]), SCENARIO, "r", drains, end_s)


def test_a_mission_lasts_until_the_battery_is_empty():
    run = flown(empty_s=100.0)
    assert run.empty and run.lasted_s == pytest.approx(100.0, abs=0.11)
    assert run.laps == pytest.approx(2.5, abs=0.02), "what came later does not count"
    whole = flown(empty_s=300.0)
    assert not whole.empty and whole.lasted_s == 200.0


def test_the_distance_counts_once_the_robot_has_settled():
    run = flown(off_m=0.1)
    assert min(t_s for t_s, _ in run.off_m) == pytest.approx(30.0)
    assert [off for _, off in run.off_m] == pytest.approx([0.1] * len(run.off_m))


def test_power_is_what_was_spent_over_time():
    run = flown()
    assert run.mean_power_w() == pytest.approx(POWER, rel=0.02)
    assert [power for _, power in run.powers_w(10.0)] == pytest.approx([2.6] * len(run.powers_w(10.0)))
    assert run.powers_w(10.0)[-1][0] <= run.lasted_s


def test_a_share_of_values():
    values = [float(value) for value in range(1, 101)]
    assert (share_of(values, 0.95), share_of(values, 1.0), share_of([3.0], 0.5)) == (95.0, 100.0, 3.0)
