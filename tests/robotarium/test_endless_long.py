"""The mission without an end, longer: twenty minutes with a death and charges, and what may happen on the way."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from demo.flights import fly
from robotarium.test_endless_mission import SOON, check_endless

from pancakes.tools.demo import Loss

pytestmark = [pytest.mark.cpu_limit(200.0), pytest.mark.usefixtures("robotarium")]


def test_twenty_minutes_pass_by_both_judges(tmp_path: Path) -> None:
    flight = fly("endless", 1, tmp_path, faults=False, duration_s=1200.0)
    assert flight.summary["reasons"] == [] and flight.summary["verdict"] == "PASS"
    check_endless(flight)
    assert len(flight.summary["deaths"]) == 1 and flight.summary["charges"] >= 1


def test_robot_that_stands_dead_on_the_way_is_driven_round(tmp_path: Path) -> None:
    """It rolls on after its last word, so only the tracker knows where it is."""
    loss = Loss(("robot8",), earliest_s=30.0, latest_s=30.0, away_s=45.0)
    flight = fly("endless", 1, tmp_path, faults=False, sets=SOON, duration_s=80.0, loss=loss)
    check_endless(flight)
    (taken,) = flight.told("taken_over")
    dead = next(row for row in flight.paths["robot8"] if row.t_s > 40.0)
    passed = [row for row in flight.paths[taken["by"]] if row.t_s > 40.0 and math.dist(row.place, dead.place) < 0.3]
    assert passed and min(row.x_m for row in passed) < dead.x_m < max(row.x_m for row in passed)


def test_robot_that_runs_low_gives_its_task_away_and_is_charged(tmp_path: Path) -> None:
    low = (*SOON, "world:task.World.settings.robots.robot1.battery.level=0.155")
    alive = Loss(("robot5",), 500.0, 500.0, 0.0)
    flight = fly("endless", 1, tmp_path, faults=False, sets=low, duration_s=90.0, loss=alive)
    check_endless(flight)
    assert [event["task"] for event in flight.told("migration") if event["outcome"] == "moved"] == ["Circle1"]
    assert "robot1" in [event["agent"] for event in flight.told("docked")]
