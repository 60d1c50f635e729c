"""The judge of the mission in which motion starts the encirclement."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from pancakes_encirclement.intruder_verdict import judge_intruder


@pytest.fixture
def intrusion(mission: Any) -> Any:
    """The made-up mission, made into one with an intruder who walks slowly to the right from 10 s on."""
    mission.events = []
    mission.end_s = 120.0
    for agent, tasks in (("agent1", ["Sentinel"]), ("agent2", []), ("sensor", ["MotionDetection"])):
        mission.tell(0.0, agent, "roster", tasks=tasks)
    mission.tell(10.0, "sensor", "motion_detected", x_m=0.0, y_m=0.0)
    mission.tell(10.0, "agent1", "alarm", x_m=0.0, y_m=0.0)
    mission.tell(10.1, "agent1", "task_started", task="ScanTarget", service="client")
    for step in range(1, 5):
        mission.tell(10.0 + 20.0 * step, "agent1", "new_centre", x_m=0.2 * step, y_m=0.0)
    mission.tell(110.0, "agent1", "revolution", count=3)
    walk = lambda t_s: (0.01 * max(0.0, t_s - 10.0), 0.0)  # noqa: E731
    mission.path_of["mover"] = walk
    mission.path_of["agent1"] = lambda t_s: (
        (walk(t_s)[0] + 0.55 * math.cos(-0.18 * t_s), 0.55 * math.sin(-0.18 * t_s)) if t_s > 20.0 else (1.9, 1.4)
    )
    mission.drives = {"agent1": lambda t_s: "ScanTarget" if t_s > 10.1 else "", "agent2": lambda t_s: ""}
    return mission


def reasons(intrusion: Any) -> str:
    summary = judge_intruder(intrusion.write())
    assert summary["verdict"] == "FAIL"
    return " ".join(summary["reasons"])


def test_a_circle_that_follows_the_intruder_passes(intrusion: Any) -> None:
    summary = judge_intruder(intrusion.write())
    assert summary["reasons"] == []
    assert summary["verdict"] == "PASS"
    assert summary["start_delay_s"] == pytest.approx(0.1)
    assert summary["centre_moves"] == 4
    assert summary["radius_error_m"]["mean"] == pytest.approx(0.0, abs=1e-4)
    assert 0.0 < summary["centre_error_m"]["mean"] < 0.2


def test_it_fails_where_nothing_moved(intrusion: Any) -> None:
    intrusion.forget("motion_detected")
    assert "never sensed any motion" in reasons(intrusion)


def test_it_fails_where_no_person_came(intrusion: Any) -> None:
    intrusion.forget("task_started")
    assert "no agent started ScanTarget" in reasons(intrusion)


def test_it_fails_where_the_robot_came_late(intrusion: Any) -> None:
    intrusion.forget("task_started")
    intrusion.tell(14.0, "agent1", "task_started", task="ScanTarget")
    intrusion.drives["agent1"] = lambda t_s: "ScanTarget" if t_s > 14.0 else ""
    assert "started 4.00 s after the first report" in reasons(intrusion)


def test_it_fails_where_the_robot_did_not_stand_idle_first(intrusion: Any) -> None:
    intrusion.drives["agent1"] = lambda t_s: "ScanTarget"
    assert "drove before any motion was sensed" in reasons(intrusion)


def test_it_fails_where_the_circle_stays_behind(intrusion: Any) -> None:
    intrusion.forget("new_centre")
    said = reasons(intrusion)
    assert "the circle moved 0 times" in said
    assert "the circle's centre was" in said


def test_it_fails_where_the_robot_is_elsewhere(intrusion: Any) -> None:
    intrusion.path_of["agent1"] = lambda t_s: (1.9, 1.4)
    assert "off the circle round the intruder" in reasons(intrusion)


def test_it_fails_where_the_robot_hardly_went_round(intrusion: Any) -> None:
    intrusion.forget("revolution")
    assert "went round 0 times" in reasons(intrusion)


def test_it_fails_where_the_intruder_was_run_over(intrusion: Any) -> None:
    intrusion.tell(60.0, "world", "collision", names=["agent1", "intruder"])
    assert "agent1 with intruder" in reasons(intrusion)


def test_its_figure_is_drawn(intrusion: Any, tmp_path: Path) -> None:
    from pancakes_encirclement.figure import draw_intruder

    run = intrusion.write()
    draw_intruder(run, judge_intruder(run))
    assert (tmp_path / "out" / "paths.png").read_bytes().startswith(b"\x89PNG")
