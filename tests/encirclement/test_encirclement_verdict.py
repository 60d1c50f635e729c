"""The judge of the paper's experiment, on made-up missions: one as it should go, and one for each way to fail."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from pancakes.errors import PancakesError
from pancakes_encirclement.demos import ENCIRCLEMENT, PIONEER
from pancakes_encirclement.verdict import judge_encirclement


def test_a_mission_as_it_should_go_passes(mission: Any) -> None:
    summary = judge_encirclement(mission.write())
    assert summary["reasons"] == []
    assert summary["verdict"] == "PASS"


def test_the_summary_says_all_that_happened(mission: Any) -> None:
    summary = judge_encirclement(mission.write())
    assert summary["seed"] == 7
    assert summary["duration_s"] == 300.0
    assert summary["circle"] == {"x_m": 0.0, "y_m": 0.0, "radius_m": 0.55}
    assert summary["homes"] == {"agent1": {"x_m": 1.4, "y_m": 1.0}, "agent2": {"x_m": 1.4, "y_m": -1.0}}
    assert summary["holders"] == [
        {"agent": "agent1", "start_s": 0.0, "end_s": 150.0},
        {"agent": "agent2", "start_s": 150.01, "end_s": 300.0},
    ]
    assert summary["gap_s"] == pytest.approx(0.2)
    assert summary["overlap_s"] == 0.0
    assert summary["bids"] == [{"agent": "agent2", "cost": 0.0}]
    assert summary["refusals"] == [{"agent": "sensor", "reason": "lacks motors"}]
    assert summary["state_moved"] == {"centre_m": [0.001, -0.002], "revolutions": 3.4}
    assert summary["radius_error_m"]["agent1"] == {
        "mean": pytest.approx(0.0, abs=1e-5),
        "max": pytest.approx(0, abs=1e-5),
    }
    assert summary["home_error_m"] == pytest.approx(math.hypot(0.02, 0.01), abs=1e-5)
    assert (summary["collisions"], summary["out_of_bounds"]) == (0, 0)
    json.dumps(summary, allow_nan=False)


def reasons(mission: Any) -> str:
    summary = judge_encirclement(mission.write())
    assert summary["verdict"] == "FAIL"
    return " ".join(summary["reasons"])


def test_it_fails_where_the_task_never_moved(mission: Any) -> None:
    mission.handed_over_s = 400.0
    for kind in ("task_frozen", "task_stopped", "task_arrived", "task_started"):
        mission.forget(kind)
    assert "never moved" in reasons(mission)


def test_it_fails_where_no_agent_ran_the_task(mission: Any) -> None:
    mission.events = []
    assert "no agent ever ran ScanTarget" in reasons(mission)


def test_it_fails_off_the_circle(mission: Any) -> None:
    mission.off_m = 0.03
    said = reasons(mission)
    assert "agent1 was 0.030 m off the circle" in said
    assert "agent2 was 0.030 m off the circle" in said


def test_it_fails_where_a_robot_never_came_to_the_circle(mission: Any) -> None:
    mission.path_of["agent2"] = lambda t_s: (1.4, -1.0)
    assert "agent2 did not settle" in reasons(mission)


def test_the_first_30_s_on_the_circle_do_not_count(mission: Any) -> None:
    proper = mission.path_of["agent2"]
    mission.path_of["agent2"] = lambda t_s: (0.5, 0.0) if 162.0 < t_s < 190.0 else proper(t_s)
    assert judge_encirclement(mission.write())["verdict"] == "PASS"


def test_it_fails_where_no_robot_drove_for_too_long(mission: Any) -> None:
    mission.gap_s = 0.7
    assert "no robot drove for 0.80 s" in reasons(mission)


def test_it_fails_where_two_agents_drove_at_once(mission: Any) -> None:
    mission.gap_s = -1.0
    assert "two agents ran ScanTarget at once" in reasons(mission)


def test_it_fails_where_two_agents_said_that_they_ran_it(mission: Any) -> None:
    mission.forget("task_frozen")
    mission.forget("task_stopped")
    assert "two agents ran ScanTarget at once" in reasons(mission)


def test_it_fails_away_from_home(mission: Any) -> None:
    mission.parked_at = (1.4, 0.8)
    assert "agent1 ended 0.20 m from its home" in reasons(mission)


def test_it_fails_where_something_was_run_into(mission: Any) -> None:
    mission.tell(160.0, "world", "collision", names=["agent1", "sensor"])
    assert "1 collisions: agent1 with sensor" in reasons(mission)


def test_it_fails_where_a_robot_left_the_arena(mission: Any) -> None:
    proper = mission.path_of["agent2"]
    mission.path_of["agent2"] = lambda t_s: (2.1, 0.0) if 155.0 < t_s < 156.0 else proper(t_s)
    assert "1 robots left the arena" in reasons(mission)


def test_it_fails_where_the_sensor_did_not_refuse(mission: Any) -> None:
    mission.forget("migration")
    assert "sensor did not refuse" in reasons(mission)


@pytest.mark.parametrize(
    ("state", "reason"),
    [
        ({"centre_m": None, "revolutions": 3.4}, "without the centre"),
        ({"centre_m": [0.5, 0.0], "revolutions": 3.4}, "not where sensor stands"),
        ({"centre_m": [0.0, 0.0], "revolutions": 0.0}, "agent1 had counted 3"),
    ],
)
def test_it_fails_where_the_state_did_not_arrive(mission: Any, state: dict[str, Any], reason: str) -> None:
    mission.forget("task_arrived")
    mission.tell(150.01, "agent2", "task_arrived", task="ScanTarget", source_agent="agent1", state=state)
    assert reason in reasons(mission)


def test_it_fails_where_the_new_holder_said_nothing_of_a_state(mission: Any) -> None:
    mission.forget("task_arrived")
    assert "did not say what it began with" in reasons(mission)


def test_it_fails_where_the_mission_broke_off(mission: Any) -> None:
    mission.ended_because = "the agent world is gone"
    assert "the mission broke off: the agent world is gone" in reasons(mission)


def test_a_task_that_was_restarted_is_still_held_by_one_holder(mission: Any) -> None:
    mission.tell(60.0, "agent1", "task_failed", task="ScanTarget", error="ValueError", then="restart")
    mission.tell(60.1, "agent1", "task_started", task="ScanTarget", service="client")
    summary = judge_encirclement(mission.write())
    assert [holder["agent"] for holder in summary["holders"]] == ["agent1", "agent2"]


def test_a_missing_or_broken_file_is_named(mission: Any, tmp_path: Path) -> None:
    run = mission.write()
    (tmp_path / "out" / "events.jsonl").write_text('{"t_s": 1.0}\n', encoding="utf-8")
    with pytest.raises(PancakesError, match=r"events\.jsonl: line 1 is not an event"):
        judge_encirclement(run)
    (tmp_path / "out" / "trajectory.csv").unlink()
    with pytest.raises(PancakesError, match=r"trajectory\.csv cannot be read"):
        judge_encirclement(run)


def test_the_demos_are_judged_by_their_own_limits(mission: Any) -> None:
    mission.off_m = 0.025
    run = mission.write()
    assert ENCIRCLEMENT.judge(run)["verdict"] == "FAIL"
    assert PIONEER.judge(run)["verdict"] == "PASS", "larger robots, a larger circle"
