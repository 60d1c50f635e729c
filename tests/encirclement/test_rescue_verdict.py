"""The judge of the mission in which the robot that circles is killed, on made-up missions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pancakes_encirclement.rescue_verdict import judge_rescue

LOST_S, TAKEN_S, RETURNED_S = 100.0, 102.2, 160.0
STATE = {"centre_m": [0.001, -0.002], "revolutions": 2.9}


@pytest.fixture
def rescue(mission: Any) -> Any:
    """The made-up mission, made into one in which agent 1 is killed, and agent 2 goes on."""
    mission.events = []
    mission.handed_over_s, mission.gap_s = LOST_S, TAKEN_S + 0.1 - LOST_S
    mission.configs["agent1"]["tasks"]["ScanTarget"] |= {"guard": {"copies": 3, "lease_s": 2.0, "checkpoint_s": 0.5}}
    mission.configs["agent1"]["clock"] = {"speed": 1.0}
    mission.tell(0.0, "agent1", "roster", tasks=["ScanTarget"])
    mission.tell(0.0, "agent2", "roster", tasks=[])
    mission.tell(40.0, "agent1", "revolution", count=1)
    mission.tell(80.0, "agent1", "revolution", count=2)
    mission.tell(LOST_S, "agent1", "agent_lost")
    mission.tell(TAKEN_S, "agent2", "task_arrived", task="ScanTarget", source_agent="agent1", state=STATE)
    mission.tell(TAKEN_S, "agent2", "task_started", task="ScanTarget", service="client")
    mission.tell(130.0, "agent2", "revolution", count=3)
    mission.tell(RETURNED_S, "agent1", "agent_returned")
    circles = mission.path_of["agent1"]
    mission.path_of["agent1"] = lambda t_s: circles(min(t_s, LOST_S + 0.4))
    mission.drives = {
        "agent1": lambda t_s: "ScanTarget" if t_s < LOST_S + 0.4 else "",
        "agent2": lambda t_s: "ScanTarget" if t_s > TAKEN_S + 0.05 else "",
    }
    return mission


def reasons(rescue: Any) -> str:
    summary = judge_rescue(rescue.write())
    assert summary["verdict"] == "FAIL"
    return " ".join(summary["reasons"])


def test_a_rescue_as_it_should_go_passes(rescue: Any) -> None:
    summary = judge_rescue(rescue.write())
    assert summary["reasons"] == []
    assert summary["verdict"] == "PASS"
    assert (summary["lost"], summary["lost_s"], summary["taken_by"]) == ("agent1", LOST_S, "agent2")
    assert summary["without_s"] == pytest.approx(2.3)
    assert summary["without_most_s"] == 3.5
    assert 0.3 <= summary["rolled_on_s"] <= 0.5
    assert summary["state_taken"] == STATE
    assert summary["holders"] == [
        {"agent": "agent1", "start_s": 0.0, "end_s": LOST_S},
        {"agent": "agent2", "start_s": TAKEN_S, "end_s": 300.0},
    ]
    assert summary["ran_after_return"] == summary["drove_after_return"] == summary["runs_at_the_end"] == ["agent2"]
    assert summary["covered"] == 1.0
    json.dumps(summary, allow_nan=False)


def test_a_lease_lasts_longer_in_a_mission_that_goes_faster(rescue: Any) -> None:
    rescue.configs["agent1"]["clock"] = {"speed": 5.0}
    summary = judge_rescue(rescue.write())
    assert (summary["lease_s"], summary["without_most_s"]) == (10.0, 17.5)


def test_it_fails_where_no_agent_was_killed(rescue: Any) -> None:
    rescue.forget("agent_lost")
    assert "the mission ended after 300 s, before agent1 was killed" in reasons(rescue)


def test_it_fails_where_the_killed_agent_did_not_run_the_task(rescue: Any) -> None:
    rescue.forget("roster", "agent1")
    assert "agent1 did not run ScanTarget when it was killed" in reasons(rescue)


def test_it_fails_where_no_agent_goes_on(rescue: Any) -> None:
    rescue.forget("task_started")
    rescue.drives["agent2"] = lambda t_s: ""
    said = reasons(rescue)
    assert "no agent went on with ScanTarget after agent1 was killed" in said
    assert "no agent ran ScanTarget after agent1 came back" in said


def test_it_fails_where_the_copy_never_drives(rescue: Any) -> None:
    rescue.drives["agent2"] = lambda t_s: ""
    assert "agent2 ran ScanTarget, and its wheels never followed it" in reasons(rescue)


def test_it_fails_where_the_copy_comes_late(rescue: Any) -> None:
    rescue.drives["agent2"] = lambda t_s: "ScanTarget" if t_s > 104.0 else ""
    assert "came 4.10 s after agent1 was killed, more than 3.5 s" in reasons(rescue)


def test_it_fails_where_two_act(rescue: Any) -> None:
    rescue.drives["agent1"] = lambda t_s: "ScanTarget" if t_s < 104.0 else ""
    assert "two agents acted for ScanTarget at once" in reasons(rescue)


@pytest.mark.parametrize(
    ("state", "reason"),
    [
        ({"centre_m": None, "revolutions": 2.9}, "without the centre"),
        ({"centre_m": [0.5, 0.0], "revolutions": 2.9}, "not where the sensor node stands"),
        ({"centre_m": [0.0, 0.0], "revolutions": 0.0}, "began with 0.0 revolutions, agent1 had counted 2"),
        ({"centre_m": [0.0, 0.0], "revolutions": 3.1}, "counted revolution 3 after it had begun with 3.1"),
    ],
)
def test_it_fails_where_the_copy_begins_with_another_state(rescue: Any, state: dict[str, Any], reason: str) -> None:
    rescue.forget("task_arrived")
    rescue.tell(TAKEN_S, "agent2", "task_arrived", task="ScanTarget", source_agent="agent1", state=state)
    assert reason in reasons(rescue)


def test_what_was_counted_after_the_last_checkpoint_may_be_lost(rescue: Any) -> None:
    rescue.tell(LOST_S - 0.4, "agent1", "revolution", count=3)
    assert judge_rescue(rescue.write())["verdict"] == "PASS"
    rescue.tell(LOST_S - 1.5, "agent1", "revolution", count=3)
    assert "agent1 had counted 3" in reasons(rescue)


def test_it_fails_where_the_copy_says_nothing_of_a_state(rescue: Any) -> None:
    rescue.forget("task_arrived")
    assert "agent2 did not say what it began with" in reasons(rescue)


def test_it_fails_where_the_first_agent_stays_away(rescue: Any) -> None:
    rescue.forget("agent_returned")
    assert "the mission ended before agent1 came back" in reasons(rescue)


def test_it_fails_where_the_first_agent_runs_its_copy_again(rescue: Any) -> None:
    rescue.tell(161.0, "agent1", "task_started", task="ScanTarget", service="client")
    said = reasons(rescue)
    assert "agent1 and agent2 ran ScanTarget after agent1 came back" in said
    assert "two agents acted for ScanTarget at once" in said and "3 holders" in said


def test_it_fails_where_the_wheels_of_the_first_robot_obey_an_old_copy(rescue: Any) -> None:
    rescue.drives["agent1"] = lambda t_s: "ScanTarget" if t_s < LOST_S or 170.0 < t_s < 170.2 else ""
    assert "the wheels of agent1 followed ScanTarget after it came back" in reasons(rescue)


def test_it_fails_where_the_copy_ends_before_the_mission(rescue: Any) -> None:
    rescue.tell(250.0, "agent2", "task_stopped", task="ScanTarget", service="client", reason="asked")
    assert "agent2 did not run ScanTarget to the end" in reasons(rescue)


def test_it_fails_where_a_part_of_the_circle_is_left_out(rescue: Any) -> None:
    circles = rescue.path_of["agent2"]
    rescue.path_of["agent2"] = lambda t_s: (max(0.0, circles(t_s)[0]), circles(t_s)[1])
    assert "of the circle was covered after agent1 came back" in reasons(rescue)


def test_it_fails_where_something_was_run_into(rescue: Any) -> None:
    rescue.tell(120.0, "world", "collision", names=["agent1", "agent2"])
    assert "1 collisions: agent1 with agent2" in reasons(rescue)


@pytest.mark.parametrize("spoilt", ["agent_lost", "agent_returned", "task_started", ""])
def test_its_figure_is_drawn(rescue: Any, tmp_path: Path, spoilt: str) -> None:
    from pancakes_encirclement.figure import draw_rescue

    rescue.forget(spoilt)
    run = rescue.write()
    draw_rescue(run, judge_rescue(run))
    assert (tmp_path / "out" / "paths.png").read_bytes().startswith(b"\x89PNG")
