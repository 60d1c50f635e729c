"""The verdict on the mission without an end finds each thing that may go wrong. Needs no simulator."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from pancakes_robotarium.endless_verdict import Duty, EndlessLimits, judge, read_duties, reasons_to_fail

from pancakes.errors import PancakesError
from pancakes.tools.demo import Run
from pancakes.tools.demo.mission_record import MissionEvent
from pancakes_encirclement.record import Record, Row

LENGTH = 1000
EMPTY_V, FULL_V = 3.3, 4.2
RING = Duty("Ring", (0.0, 0.0), 0.25)
ROAD = Duty("Road", route_m=[(-1.0, -0.5), (1.0, -0.5)])
RUN = Run(Path(), 1, float(LENGTH), float(LENGTH), "", {})
Where = Callable[[int], tuple[float, float]]


def rounds(time_s: int) -> tuple[float, float]:
    return 0.25 * math.cos(0.3 * time_s), -0.25 * math.sin(0.3 * time_s)


def to_and_fro(time_s: int) -> tuple[float, float]:
    return abs(time_s % 40 - 20) / 10.0 - 1.0, -0.5


def path(where: Where, task: Callable[[int], str], volts: Callable[[int], float | None] = lambda t: 3.9) -> list[Row]:
    return [Row(float(t), *where(t), 0.0, 0.1, 0.0, volts(t), task(t)) for t in range(LENGTH)]


def event(t_s: float, agent: str, kind: str, **fields: Any) -> MissionEvent:
    return MissionEvent(t_s, agent, kind, fields)


def good_paths() -> dict[str, list[Row]]:
    return {
        "a": path(rounds, lambda t: "Ring"),
        "b": path(to_and_fro, lambda t: "Road"),
        "c": path(lambda t: (0.0, 0.9), lambda t: ""),
    }


def good_events() -> list[MissionEvent]:
    return [event(0.0, "a", "roster", tasks=["Ring"]), event(0.0, "b", "roster", tasks=["Road"])]


def judged(
    paths: dict[str, list[Row]] | None = None, events: Sequence[MissionEvent] | None = None, run: Run = RUN
) -> tuple[dict[str, Any], list[str]]:
    found = sorted(good_events() if events is None else events, key=lambda it: it.t_s)
    record = Record(paths=good_paths() if paths is None else paths, events=found)
    summary = judge(record, [RING, ROAD], dict.fromkeys("abc", (EMPTY_V, FULL_V)), run)
    return summary, reasons_to_fail(summary, run, EndlessLimits())


def test_mission_without_a_fault_passes() -> None:
    summary, reasons = judged()
    assert reasons == []
    assert summary["served"] == 1.0 and summary["gaps"] == {"Ring": [], "Road": []}
    assert summary["lowest_level"] == pytest.approx((3.9 - EMPTY_V) / (FULL_V - EMPTY_V))


def test_task_that_nobody_drives_for_a_while_is_not_served() -> None:
    paths = {**good_paths(), "a": path(rounds, lambda t: "" if 100 <= t < 120 else "Ring")}
    summary, reasons = judged(paths)
    assert summary["tasks"]["Ring"]["served"] == pytest.approx(0.98, abs=1e-3) and summary["gaps"]["Ring"] == [
        (100.0, 120.0)
    ]
    assert len(reasons) == 1 and "served for 98.97% of the time, less than 99.5%: Ring 97.94%" in reasons[0]


def test_first_half_minute_does_not_count() -> None:
    paths = {**good_paths(), "a": path(rounds, lambda t: "" if t < 30 else "Ring")}
    assert judged(paths)[0]["served"] == 1.0


def test_robot_that_is_far_from_its_circle_does_not_serve_it() -> None:
    paths = {**good_paths(), "a": path(lambda t: (1.2, 0.5 + 0.4 * math.sin(0.3 * t)), lambda t: "Ring")}
    summary, reasons = judged(paths)
    assert summary["tasks"]["Ring"] | {"rounds": 0.0} == {
        "served": 0.0,
        "driven": 1.0,
        "rounds": 0.0,
        "due_rounds": 0.0,
        "owners": 1,
        "longest_gap_s": 969.0,
    }
    assert reasons


def test_robot_that_goes_round_a_dead_one_serves_its_circle() -> None:
    paths = {**good_paths(), "a": path(lambda t: tuple(1.9 * it for it in rounds(t)), lambda t: "Ring")}  # type: ignore[arg-type,return-value]
    assert judged(paths)[1] == []


def test_robot_that_stands_on_its_circle_does_not_serve_it() -> None:
    paths = {**good_paths(), "a": path(lambda t: rounds(t if t < 500 else 500), lambda t: "Ring")}
    summary, reasons = judged(paths)
    assert summary["gaps"]["Ring"] == [(510.0, 999.0)] and reasons


def test_robot_far_from_its_route_does_not_serve_it() -> None:
    paths = {**good_paths(), "b": path(lambda t: (to_and_fro(t)[0], 0.0), lambda t: "Road")}
    assert judged(paths)[0]["tasks"]["Road"]["served"] == 0.0


def test_two_robots_that_drive_for_one_task_are_found_by_their_wheels() -> None:
    paths = {**good_paths(), "c": path(lambda t: (0.0, 0.9), lambda t: "Ring" if 100 <= t < 103 else "")}
    summary, reasons = judged(paths)
    assert summary["two_owners_s"]["Ring"] == pytest.approx(3.0)
    assert reasons == ["two robots had Ring at once, for 3.00 s"]


def test_two_owners_are_found_by_their_events() -> None:
    both = [event(100.0, "c", "task_started", task="Ring"), event(100.5, "a", "task_stopped", task="Ring")]
    summary, reasons = judged(events=[*good_events(), *both])
    assert summary["two_owners_s"]["Ring"] == pytest.approx(0.5) and "two robots had Ring" in reasons[0]


def test_task_that_moves_has_one_owner_at_a_time() -> None:
    moved = [event(100.0, "a", "task_stopped", task="Ring"), event(100.001, "c", "task_started", task="Ring")]
    summary, _ = judged(events=[*good_events(), *moved])
    assert summary["two_owners_s"]["Ring"] == 0.0 and summary["tasks"]["Ring"]["owners"] == 2


def test_empty_battery_fails_the_mission() -> None:
    paths = {**good_paths(), "c": path(lambda t: (0.0, 0.9), lambda t: "", lambda t: EMPTY_V if t == 700 else 3.5)}
    summary, reasons = judged(paths)
    assert summary["empty"] == ["c"] and reasons == ["the battery of c was empty"]


def test_robot_of_which_nothing_is_known_fails_the_mission() -> None:
    paths = {name: rows for name, rows in good_paths().items() if name != "c"}
    assert judged(paths)[1] == ["nothing is known of the battery of c"]


def test_collisions_and_robots_that_leave_the_floor_fail_the_mission() -> None:
    mishaps = [event(5.0, "world", "collision", names=["a", "b"]), event(6.0, "world", "out_of_bounds", names=["a"])]
    assert judged(events=[*good_events(), *mishaps])[1] == [
        "there were 1 collisions: a with b",
        "robots left the floor 1 times",
    ]


def test_robot_that_does_not_come_back_fails_the_mission() -> None:
    lost = [event(500.0, "c", "agent_lost")]
    summary, reasons = judged(events=[*good_events(), *lost])
    assert summary["deaths"] == [{"agent": "c", "at_s": 500.0, "had": []}]
    assert reasons == ["c died and did not come back"]


def test_robot_that_was_started_again_is_back_only_once_it_is_ready() -> None:
    lost = [event(500.0, "c", "agent_lost"), event(600.0, "c", "agent_returned")]
    others = [event(500.0, "b", "agent_returned"), event(601.0, "b", "ready")]
    assert judged(events=[*good_events(), *lost, *others])[1] == ["c died and did not come back"]
    assert judged(events=[*good_events(), *lost, event(601.0, "c", "ready")])[1] == []


def test_mission_of_which_a_part_was_not_recorded_fails() -> None:
    """Else a task would be served for all of the few seconds that are known."""
    short = {name: rows[:100] for name, rows in good_paths().items()}
    assert judged(short)[1][0] == "nothing was recorded of a robot for 901 s: nobody can judge that time"
    one = {**good_paths(), "c": good_paths()["c"][:100]}
    assert "nothing was recorded of a robot for 901 s" in judged(one)[1][0]
    hole = {name: rows[:400] + rows[500:] for name, rows in good_paths().items()}
    assert "nothing was recorded of a robot for 101 s" in judged(hole)[1][0]


def test_robot_that_turns_about_on_a_part_of_its_circle_makes_no_rounds() -> None:
    paths = {**good_paths(), "a": path(lambda t: (0.25 + 0.1 * math.cos(t), 0.1 * math.sin(t)), lambda t: "Ring")}
    summary, reasons = judged(paths)
    assert summary["tasks"]["Ring"]["served"] == 1.0 and abs(summary["tasks"]["Ring"]["rounds"]) < 0.5
    assert reasons == ["Ring was driven for 0.0 rounds, and at its speed 61.8 were due"]


def test_robot_that_goes_round_the_wrong_way_makes_no_rounds() -> None:
    paths = {**good_paths(), "a": path(lambda t: (rounds(t)[0], -rounds(t)[1]), lambda t: "Ring")}
    assert judged(paths)[0]["tasks"]["Ring"]["rounds"] < 0.0


def test_robot_that_patrols_half_of_its_route_makes_no_rounds() -> None:
    paths = {**good_paths(), "b": path(lambda t: (0.5 * to_and_fro(t)[0], -0.5), lambda t: "Road")}
    summary, reasons = judged(paths)
    assert summary["tasks"]["Road"]["rounds"] == 0.0 and len(reasons) == 1 and "Road was driven" in reasons[0]
    assert judged()[0]["tasks"]["Road"]["rounds"] == pytest.approx(25.0)


def test_two_owners_are_found_also_before_service_counts() -> None:
    paths = {**good_paths(), "c": path(lambda t: (0.0, 0.9), lambda t: "Ring" if t < 3 else "")}
    assert judged(paths)[1] == ["two robots had Ring at once, for 3.00 s"]


def test_death_of_a_robot_with_a_task_names_the_task() -> None:
    told = [event(500.0, "a", "agent_lost"), event(506.0, "c", "task_started", task="Ring")]
    summary, _ = judged(events=[*good_events(), *told, event(900.0, "a", "agent_returned")])
    assert summary["deaths"][0]["had"] == ["Ring"] and summary["two_owners_s"]["Ring"] == 0.0


def test_mission_that_broke_off_says_why() -> None:
    run = Run(Path(), 1, float(LENGTH), 500.0, "the agent world is gone", {})
    assert judged(run=run)[1] == ["the mission broke off: the agent world is gone"]


def test_mission_without_any_record_is_not_served() -> None:
    summary, reasons = judged({}, [])
    assert summary["served"] == 0.0 and summary["lowest_level"] is None
    assert "no robot ever had Ring" in reasons and "no robot ever had Road" in reasons


def test_duties_are_read_from_the_configurations() -> None:
    ring = {"type": "robotarium.Circle", "settings": {"centre_m": [1, 0], "radius_m": 0.3}}
    road = {"type": "robotarium.Patrol", "settings": {"waypoints_m": [[0, 0], [1, 0]]}}
    one, two = read_duties(
        {"a": {"tasks": {"B": ring, "Reserve": {"type": "energy.reserve"}}}, "b": {"tasks": {"A": road}}}
    )
    assert (one.name, two.name) == ("A", "B") and two.radius_m == 0.3
    assert one.off_m((0.5, 0.2)) == pytest.approx(0.2) and two.off_m((1.0, 0.5)) == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("tasks", "what"),
    [
        ({}, "has a task of the types"),
        ({"B": {"type": "robotarium.Circle", "settings": {"subject": "x"}}}, "B has no centre_m"),
    ],
)
def test_configurations_that_cannot_be_judged_are_refused(tasks: dict[str, Any], what: str) -> None:
    with pytest.raises(PancakesError, match=what):
        read_duties({"a": {"tasks": tasks}})
