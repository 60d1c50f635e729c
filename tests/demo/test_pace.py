"""What a verdict says of a machine that did not keep up."""

from __future__ import annotations

import pytest

from pancakes.tools.demo.conductor import Mission, Ticks, hint_of, how_slow, late_ones, ticks_of, verdict_line

KEPT_UP = {"behind_max_s": 0.1, "late_tasks": []}


def test_a_machine_that_kept_up_is_not_mentioned():
    assert how_slow(KEPT_UP) == ""
    assert how_slow({"mode": "virtual", "times_real_time": 300.0}) == ""
    assert verdict_line("PASS", "") == "PASS"


def test_world_that_tells_once_a_second_is_not_behind():
    mission = Mission(("world",), 60.0)
    for tenth in range(100):
        mission.now_s = 0.1 * tenth
        if tenth % 10 == 9:
            mission.world_told(mission.now_s)
        mission.look_at_world(1.0)
    assert mission.behind_max_s == pytest.approx(0.0, abs=0.1)
    mission.now_s += 3.0
    mission.look_at_world(1.0)
    assert mission.behind_s == pytest.approx(2.1, abs=0.2)


def test_where_the_world_fell_behind_the_verdict_says_by_how_much():
    slow = how_slow({**KEPT_UP, "behind_max_s": 3.714})
    assert slow == "the world fell behind the clock by up to 3.71 s of mission time"
    assert verdict_line("FAIL", slow) == f"FAIL, and this machine was too slow: {slow}"
    assert verdict_line("PASS", slow) == f"PASS, though this machine was too slow: {slow}"


def test_a_live_mission_that_fails_says_what_the_machine_has_to_do_with_it():
    live = {"mode": "live", "speed": 5.0, **KEPT_UP}
    hint = hint_of("FAIL", [{**live, "busy": 0.97, "processors": 2}])
    assert hint.startswith("a live mission depends on the machine: its 2 processors were busy for 97 % of the mission.")
    assert "--speed 2.5" in hint and "--virtual" in hint
    assert "its 8 processors were busy for 10 %" in hint_of("FAIL", [{**live, "busy": 0.1, "processors": 8}])
    assert hint_of("FAIL", [{**live, "speed": 1.0, "busy": 0.9, "processors": 2}]).count("--speed 0.5") == 1
    assert hint_of("PASS", [{**live, "busy": 0.97, "processors": 2}]) == ""
    assert hint_of("FAIL", [{"mode": "virtual", "times_real_time": 300.0}]) == ""


def test_the_tasks_that_missed_most_are_named_and_the_others_are_counted():
    ticks = [Ticks(f"a/client/T{number}", 90, number, 0.0) for number in range(1, 8)]
    slow = how_slow({**KEPT_UP, "late_tasks": late_ones(ticks)})
    assert slow.startswith("a/client/T7 missed 7 of 97 ticks and was up to 0.00 s late; a/client/T6 missed 6 of 96")
    assert slow.endswith("; 3 more tasks were late"), "one that missed a single tick does not count"


def test_a_tick_in_a_thousand_is_not_told_and_one_that_is_much_too_late_is():
    assert late_ones([Ticks("a/client/T", 999, 1, 0.05)]) == []
    (late,) = late_ones([Ticks("a/client/T", 999, 0, 0.4)])
    assert late == {"task": "a/client/T", "ticks": 999, "missed": 0, "late_max_s": 0.4}


def test_tasks_without_ticks_do_not_count():
    row = {"service": "client", "task": "T", "ticks": 0, "missed": 0, "lateness_max_s": 0.0}
    described = {"tasks": [row, {**row, "task": "U", "ticks": 5, "missed": 2}]}
    assert ticks_of("a", described) == [Ticks("a/client/U", 5, 2, 0.0)]
