"""The encirclement in the Robotarium, whole, in virtual time: by both judges, and by what is computed here alone."""

from __future__ import annotations

import json
import math
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import pytest
from demo.flights import Flight, fly

from pancakes import Simulation

pytestmark = [pytest.mark.cpu_limit(60.0), pytest.mark.usefixtures("robotarium")]
ROBOTS = ("agent1", "agent2", "guest")
WIDE_M, BASE_M, WHEEL_MPS = 0.11, 0.105, 0.2


@pytest.mark.parametrize("seed", [1, 2])
def test_mission_passes_by_both_judges_with_faults(seed: int, tmp_path: Path) -> None:
    flight = fly("robotarium", seed, tmp_path, faults=True)
    assert flight.summary["reasons"] == [] and flight.summary["verdict"] == "PASS"
    check_laboratory(flight)
    check_hand_over(flight)


def check_laboratory(flight: Flight) -> None:
    """The counts of its simulator agree with where the robots were, and how fast they were."""
    theirs = json.loads((flight.out / "robotarium.json").read_text())
    counts = theirs["counts"]
    assert counts.pop("steps") == pytest.approx(300.0 / 0.033, abs=3)
    assert counts == {"collision": 0, "boundary": 0, "actuator": 0, "other": 0}
    assert theirs["said"][-1].startswith("No errors in your simulation!")
    assert flight.summary["robotarium"]["said"] == theirs["said"]
    for one, other in combinations(ROBOTS, 2):
        assert flight.clearance_m(one, other, WIDE_M) > 0.1
    for name in ROBOTS:
        for row, after in pairwise(flight.paths[name]):
            assert abs(row.x_m) <= 1.6 - WIDE_M / 2 and abs(row.y_m) <= 1.0 - WIDE_M / 2
            assert abs(row.v_mps) + 0.5 * BASE_M * abs(row.omega_radps) <= WHEEL_MPS
            assert math.dist(row.place, after.place) <= 0.2 * (after.t_s - row.t_s) + 1e-5
    assert flight.way_m("guest") > 20.0


def check_hand_over(flight: Flight) -> None:
    """Agent 1 circles, hands over with its state, and drives home; agent 2 goes on."""
    summary = flight.summary
    assert [holder["agent"] for holder in summary["holders"]] == ["agent1", "agent2"]
    assert 100.0 <= summary["holders"][0]["end_s"] <= 180.0
    assert 0.0 < flight.gap_s("agent1", "agent2") <= 0.5 and not flight.both_drove("agent1", "agent2")
    for robot in ("agent1", "agent2"):
        errors = flight.radius_errors(robot, (0.0, 0.0), 0.4)
        assert sum(errors) / len(errors) <= 0.02
    counted = [event["count"] for event in flight.told("revolution")]
    assert counted == list(range(1, len(counted) + 1)) and len(counted) >= 8
    home, end = flight.paths["agent1"][0], flight.paths["agent1"][-1]
    assert math.dist(home.place, end.place) <= 0.10 and end.v_mps == 0.0


def test_mission_repeats_to_the_byte(tmp_path: Path) -> None:
    one, two = (fly("robotarium", 3, tmp_path / name, faults=False, duration_s=40.0) for name in ("one", "two"))
    for name in ("events.jsonl", "trajectory.csv", "robotarium.json", "summary.json"):
        assert (one.out / name).read_bytes() == (two.out / name).read_bytes()


def test_two_missions_in_one_process_are_apart() -> None:
    """The simulator has counts and draws that all of its objects share; two laboratories have not."""
    crash = ("world:task.World.settings.robots.agent2={x_m=1.0,y_m=0.6,spread_m=0.0}",)
    alone: list[Any] = []
    with Simulation.of_demo("robotarium") as first, Simulation.of_demo("robotarium", crash) as second:
        first.reset(seed=1)
        first.step(12.0)
        alone = list(first.world().bodies)
        first.reset(seed=1)
        second.reset(seed=2)
        for _ in range(12):
            first.step(1.0)
            second.step(1.0)
        assert list(first.world().bodies) == alone
        assert second.agents["world"].events("collision")
        assert not first.agents["world"].events("collision")
        (own,) = (first.task("world", "World")._laboratory.counts(),)  # noqa: SLF001 - asked between two turns
        assert own.clean
