"""A piece of the mission without an end, in virtual time: a robot with a task dies, and comes back."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from demo.flights import Flight, fly

from pancakes.control import Describe
from pancakes.simulation import Simulation
from pancakes.tools.demo import Loss
from pancakes.util.plugins import Plugins

pytestmark = [pytest.mark.cpu_limit(60.0), pytest.mark.usefixtures("robotarium")]
SOON = tuple(
    f"robot{number}:task.Reserve.settings.{change}"
    for number in range(1, 9)
    for change in ("window_s=20", "idle_below_s=1")
)
"""Each robot knows its reserve after ten seconds, before which it takes no task; idle ones need no dock."""
TASKS = {"Circle1", "Circle2", "Circle3", "Patrol"}


def check_endless(flight: Flight) -> None:
    """Nothing that must never be has been; how much was served depends on the length."""
    summary = flight.summary
    assert summary["empty"] == [] and set(summary["tasks"]) == TASKS
    assert set(summary["two_owners_s"].values()) == {0.0}
    assert summary["collisions"] == summary["out_of_bounds"] == 0
    assert summary["missing"] == []
    counts = json.loads((flight.out / "robotarium.json").read_text())["counts"]
    assert counts.pop("steps") > 0 and set(counts.values()) == {0}


def test_circle_of_a_robot_that_dies_is_taken_over_and_the_robot_goes_home_when_it_is_back(tmp_path: Path) -> None:
    loss = Loss(("robot6",), earliest_s=30.0, latest_s=30.0, away_s=20.0)
    flight = fly("endless", 1, tmp_path, faults=False, sets=SOON, duration_s=80.0, loss=loss)
    check_endless(flight)
    assert flight.summary["deaths"] == [{"agent": "robot6", "at_s": 30.0, "had": ["Circle3"]}]
    (taken,) = flight.told("taken_over")
    assert taken["task"] == "Circle3" and taken["by"] != "robot6"
    gaps = [gap for gap in flight.summary["gaps"]["Circle3"] if gap[0] > 20.0]
    assert len(gaps) == 1 and 29.0 < gaps[0][0] < gaps[0][1] < 55.0, "its lease, and the way of another robot"
    charges = [event for event in flight.told("task_started") if event["agent"] == "robot6" and event["t_s"] > 50.0]
    assert [event["task"] for event in charges if event["task"] in {*TASKS, "Charge"}] == ["Charge"]
    for name in TASKS - {"Circle3"}:
        others = [gap for gap in flight.summary["gaps"][name] if gap[0] > 20.0]
        assert all(end_s - start_s < 3.0 for start_s, end_s in others), "they only wait for who is silent"


def test_mission_repeats_to_the_byte(tmp_path: Path) -> None:
    one, two = (fly("endless", 3, tmp_path / name, faults=True, duration_s=45.0) for name in ("one", "two"))
    assert len(list(one.told("agent_lost"))) == 1
    for name in ("events.jsonl", "trajectory.csv", "robotarium.json", "summary.json"):
        assert (one.out / name).read_bytes() == (two.out / name).read_bytes()


def test_all_robots_of_the_demo_are_told_apart_only_by_name_home_and_first_task() -> None:
    with Simulation.of_demo("endless") as simulation:
        simulation.reset(seed=1)
        running = {
            name: set(handle.running()) for name, handle in simulation.agents.items() if name.startswith("robot")
        }
        described = simulation.agents["robot2"].ask(Describe("Reserve")).result
    assert set.union(*running.values()) == {"Reserve", *TASKS}
    assert len(running) == 8 and all("Reserve" in tasks for tasks in running.values())
    assert described["settings"]["idle_home_m"] == (-1.0, 0.84)
    demo = Plugins().get("pancakes.demos", "endless")
    assert set(demo.loss.agents) == set(running), "every robot may die, and no dock"
