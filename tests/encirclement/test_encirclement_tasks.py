"""The tasks, on agents in virtual time: what they hear, and what they say."""

from __future__ import annotations

import math
from typing import Any

import pytest

from pancakes.control import Reschedule, Stop
from pancakes.devices import Battery, Infrared, Motion, Pose, Twist
from pancakes_encirclement.packets import MotionDetected, NeighbourPose

DEVICES = """
    [device.pose]
    driver = "network.pose"
    [device.motors]
    driver = "null.motors"
"""
SCAN = '[task.ScanTarget]\ntype = "encirclement.ScanTarget"\n'
HOME = '[task.GoHome]\ntype = "encirclement.GoHome"\nsettings = { home_m = [1.0, 0.0] }\n'


def last_twist(crew: Any) -> Twist:
    return crew.heard("robot", Twist)[-1]


def test_scan_target_stands_until_it_knows_where_the_target_is(crew: Any) -> None:
    crew.join("robot", 1, tables=DEVICES + SCAN)
    crew.say("robot", "system", Pose(1.0, 0.0, math.pi))
    assert crew.heard("robot", Twist) == []
    crew.say("robot", "system", MotionDetected(0.0, 0.0))
    crew.say("robot", "system", Pose(1.0, 0.0, math.pi))
    assert last_twist(crew).v_mps == pytest.approx(0.1)


def test_scan_target_bends_its_way_by_the_law(crew: Any) -> None:
    crew.join("robot", 1, tables=DEVICES + SCAN + "settings = { centre_m = [2.0, 0.0] }")
    crew.say("robot", "system", Pose(2.55, 0.0, -math.pi / 2))
    assert last_twist(crew) == Twist(0.1, pytest.approx(-0.1 / 0.55))


def test_a_report_from_nearly_the_same_place_is_no_new_centre(crew: Any) -> None:
    crew.join("robot", 1, tables=DEVICES + SCAN)
    for x_m in (0.0, 0.09, 0.18, 0.05):
        crew.say("robot", "system", MotionDetected(x_m, 0.0))
    assert [event["x_m"] for event in crew.events("robot", "new_centre")] == [0.0, 0.18, 0.05]


def test_scan_target_tells_of_the_circle_once_and_of_each_revolution(crew: Any) -> None:
    crew.join("robot", 1, tables=DEVICES + SCAN + "settings = { centre_m = [0.0, 0.0] }")
    for step in range(81):
        angle = -math.pi * step / 20
        crew.say("robot", "system", Pose(0.55 * math.cos(angle), 0.55 * math.sin(angle), angle - math.pi / 2))
    assert len(crew.events("robot", "on_circle")) == 1
    assert [event["count"] for event in crew.events("robot", "revolution")] in ([1], [1, 2])


def test_scan_target_waits_for_a_neighbour_that_lies_behind_on_the_circle(crew: Any) -> None:
    crew.join("robot", 1, tables=DEVICES + SCAN + "settings = { centre_m = [0.0, 0.0] }")
    crew.join("other", 2, 1, tables=DEVICES + '[task.PoseSharing]\ntype = "encirclement.PoseSharing"')
    crew.say("other", "system", Pose(0.0, -0.55, math.pi))
    crew.run(0.5)
    assert crew.heard("robot", NeighbourPose)
    crew.say("robot", "system", Pose(0.55, 0.0, -math.pi / 2))
    assert last_twist(crew).v_mps == 0.0, "it has three quarters of the circle behind it"
    crew.say("other", "system", Pose(0.0, 0.55, 0.0))
    crew.run(0.5)
    crew.say("robot", "system", Pose(0.55, 0.0, -math.pi / 2))
    assert last_twist(crew).v_mps == pytest.approx(0.1)


def test_scan_target_stops_for_what_the_infrared_sees(crew: Any) -> None:
    crew.join("robot", 1, tables=DEVICES + SCAN + "settings = { centre_m = [0.0, 0.0] }")
    crew.say("robot", "system", Pose(1.5, 0.0, math.pi))
    assert last_twist(crew).v_mps > 0.0
    crew.say("robot", "system", Infrared((0.0,), (0.05,), 0.2))
    crew.say("robot", "system", Pose(1.5, 0.0, math.pi))
    assert last_twist(crew).v_mps == 0.0


def test_a_pose_that_another_robot_told_moves_nobody(crew: Any) -> None:
    crew.join("robot", 1, tables=DEVICES + HOME)
    crew.join("other", 2, 1)
    crew.ear("other").publish("system", Pose(0.0, 0.0, 0.0), to="robot")
    crew.run(0.2)
    assert crew.heard("robot", Pose)
    assert crew.heard("robot", Twist) == []


def test_go_home_turns_drives_and_parks(crew: Any) -> None:
    crew.join("robot", 1, tables=DEVICES + HOME)
    crew.say("robot", "system", Pose(0.0, 0.0, math.pi / 2))
    assert last_twist(crew) == Twist(0.0, -0.22)
    crew.say("robot", "system", Pose(0.0, 0.0, 0.0))
    assert last_twist(crew) == Twist(0.1, 0.0)
    crew.say("robot", "system", Pose(0.99, 0.0, 0.0))
    assert last_twist(crew) == Twist(0.0, 0.0)
    crew.say("robot", "system", Pose(0.97, 0.0, 0.0))
    assert last_twist(crew) == Twist(0.0, 0.0), "a little nudge does not wake it"
    assert len(crew.events("robot", "parked")) == 1
    crew.say("robot", "system", Pose(0.5, 0.0, 0.0))
    assert last_twist(crew).v_mps == 0.1, "but it comes back from farther away"


def test_pose_sharing_tells_the_neighbours_five_times_a_second(crew: Any) -> None:
    crew.join("robot", 1, tables=DEVICES + '[task.PoseSharing]\ntype = "encirclement.PoseSharing"')
    crew.join("other", 2, 1)
    crew.run(1.0)
    assert crew.heard("other", NeighbourPose) == [], "it knows nothing to tell yet"
    crew.say("robot", "system", Pose(1.0, 2.0, 0.5), run_s=2.0)
    assert crew.heard("other", NeighbourPose)[0] == NeighbourPose(1.0, 2.0, 0.5)
    assert len(crew.heard("other", NeighbourPose)) == pytest.approx(10, abs=1)
    assert crew.heard("robot", NeighbourPose) == []


WATCHDOG = """
    [device.battery]
    driver = "network.battery"
    [task.PoseSharing]
    type = "encirclement.PoseSharing"
    [task.BatteryWatchdog]
    type = "encirclement.BatteryWatchdog"
    settings = { below = 0.9, slow = { "client/PoseSharing" = 1.0, "client/Nobody" = 0.1 } }
"""


def test_the_watchdog_slows_tasks_down_once(crew: Any) -> None:
    crew.join("robot", 1, tables=DEVICES + WATCHDOG)
    for level in (0.95, 0.9, 0.899, 0.905, 0.89, 0.91, 0.88):
        crew.say("robot", "system", Battery(8.0, level))
    assert crew.heard("robot", Reschedule)[0] == Reschedule("client/PoseSharing", 1.0)
    assert len(crew.events("robot", "saving_power")) == 1
    sharing = crew.fleet.agents["robot"].kernel.registry.get("robot/client/PoseSharing")
    assert sharing.timers["share"].period_s == 1.0


def test_a_battery_that_was_charged_can_run_low_again(crew: Any) -> None:
    crew.join("robot", 1, tables=DEVICES + WATCHDOG)
    for level in (0.89, 0.93, 0.89):
        crew.say("robot", "system", Battery(8.0, level))
    assert len(crew.events("robot", "saving_power")) == 2


DETECTOR = """
    [device.pose]
    driver = "network.pose"
    [device.motion]
    driver = "network.motion"
    [task.MotionDetection]
    type = "encirclement.MotionDetection"
"""


def test_motion_is_reported_with_the_sensors_own_place_every_two_seconds(crew: Any) -> None:
    crew.join("sensor", 1, tables=DETECTOR)
    crew.join("robot", 2, 1)
    crew.say("sensor", "system", Motion(True))
    assert crew.heard("robot", MotionDetected) == [], "it does not know yet where it is"
    crew.say("sensor", "system", Pose(0.1, 0.2, 0.0))
    for _ in range(50):
        crew.say("sensor", "system", Motion(True), run_s=0.1)
    assert crew.heard("robot", MotionDetected) == [MotionDetected(0.1, 0.2)] * 3
    crew.say("sensor", "system", Motion(False), run_s=3.0)
    assert len(crew.heard("robot", MotionDetected)) == 3
    assert len(crew.events("sensor", "motion_detected")) == 1


def test_a_sensor_that_can_locate_reports_the_place_of_what_moves(crew: Any) -> None:
    crew.join("sensor", 1, tables=DETECTOR + "settings = { locate = true, period_s = 0.0 }")
    crew.join("robot", 2, 1)
    crew.say("sensor", "system", Pose(1.0, 0.0, math.pi / 2))
    crew.say("sensor", "system", Motion(True))
    crew.say("sensor", "system", Motion(True, bearing_rad=math.pi / 2, range_m=2.0))
    report = crew.heard("robot", MotionDetected)[0]
    assert (report.x_m, report.y_m) == pytest.approx((-1.0, 0.0))


SENTINEL = SCAN + "start = false\n" + '[task.Sentinel]\ntype = "encirclement.Sentinel"\n'


def test_the_sentinel_starts_a_task_at_the_first_report_and_only_then(crew: Any) -> None:
    crew.join("robot", 1, tables=DEVICES + SENTINEL)
    for x_m in (1.0, 1.05, 1.09):
        crew.say("robot", "system", MotionDetected(x_m, 2.0), run_s=0.5)
    assert len(crew.events("robot", "alarm")) == 1
    scan = crew.fleet.agents["robot"].kernel.registry.get("robot/client/ScanTarget")
    assert scan.facade.state.centre_m == (1.0, 2.0), "the task begins at the place of the report that started it"


def test_the_sentinel_starts_the_task_again_after_it_was_stopped(crew: Any) -> None:
    crew.join("robot", 1, tables=DEVICES + SENTINEL)
    crew.say("robot", "system", MotionDetected(1.0, 2.0), run_s=0.5)
    crew.say("robot", "sysctrl", Stop("client/ScanTarget"), run_s=0.5)
    crew.say("robot", "system", MotionDetected(1.0, 2.0), run_s=0.5)
    assert len(crew.events("robot", "alarm")) == 2
