"""`robotarium.Circle` and `robotarium.Patrol`: where they head, and what they say. Needs no simulator."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as some
from pancakes_robotarium.circle import Circle, course_rad
from pancakes_robotarium.patrol import Patrol, aim_m

from pancakes.devices import Pose, RobotPose, Twist
from pancakes.packet import SYSTEM
from pancakes.settings import SettingsError, make_settings
from pancakes.testing import Fleet

DEVICES = {"pose": "null.pose", "motors": "null.motors"}
STEP_S = 0.5


class Robot:
    """A robot with one task, which goes where the task commands."""

    def __init__(self, fleet: Fleet, kind: str, settings: dict[str, Any], pose: Pose) -> None:
        self.fleet, self.pose = fleet, pose
        task = {"type": kind, "settings": settings}
        self.agent = fleet.start("robot", devices=DEVICES, tasks={"Work": task})

    def turn(self) -> Twist:
        """Let it know its pose; return what it commands."""
        self.agent.publish(SYSTEM, self.pose)
        self.fleet.run_for(STEP_S)
        found: Twist = self.agent.probe.packets(Twist)[-1].body
        return found

    def drive(self, steps: int, push: Callable[[Pose], Pose] = lambda pose: pose) -> None:
        """Drive for a time; `push` may put it elsewhere after each step."""
        for _ in range(steps):
            twist = self.turn()
            theta_rad = self.pose.theta_rad + twist.omega_radps * STEP_S
            x_m = self.pose.x_m + twist.v_mps * STEP_S * math.cos(theta_rad)
            y_m = self.pose.y_m + twist.v_mps * STEP_S * math.sin(theta_rad)
            self.pose = push(Pose(x_m, y_m, theta_rad))

    def off_m(self, x_m: float, y_m: float, radius_m: float) -> float:
        return abs(math.hypot(self.pose.x_m - x_m, self.pose.y_m - y_m) - radius_m)


def test_course_on_the_circle_is_clockwise_along_it() -> None:
    assert course_rad((0.3, 0.0), (0.0, 0.0), 0.3, 5.0) == pytest.approx(-math.pi / 2)


def test_course_far_from_the_circle_leads_there() -> None:
    far, inside = course_rad((50.0, 0.0), (0.0, 0.0), 0.3, 5.0), course_rad((0.01, 0.0), (0.0, 0.0), 0.3, 5.0)
    assert math.cos(far - math.pi) > 0.99, "to the centre"
    assert math.cos(inside) > 0.5, "outwards"


@given(angle=some.floats(-math.pi, math.pi), heading=some.floats(-math.pi, math.pi), far_m=some.floats(0.05, 2.0))
def test_it_gets_on_its_circle_from_everywhere_with_any_heading(angle: float, heading: float, far_m: float) -> None:
    x_m, y_m, theta_rad = far_m * math.cos(angle), far_m * math.sin(angle), heading
    for _ in range(500):
        off_rad = math.remainder(course_rad((x_m, y_m), (0.0, 0.0), 0.3, 5.0) - theta_rad, math.tau)
        theta_rad += 0.1 * 2.5 * off_rad
        step_m = 0.1 * 0.1 * max(0.0, math.cos(off_rad))
        x_m, y_m = x_m + step_m * math.cos(theta_rad), y_m + step_m * math.sin(theta_rad)
    assert math.hypot(x_m, y_m) == pytest.approx(0.3, abs=0.05)


def test_circle_goes_round_and_counts_its_rounds(fleet: Fleet) -> None:
    settings = {"centre_m": [1.0, 0.0], "radius_m": 0.25, "turn_per_s": 1.2}
    robot = Robot(fleet, "robotarium.Circle", settings, Pose(0.0, 0.0, 2.0))
    robot.drive(120)
    assert robot.off_m(1.0, 0.0, 0.25) < 0.04
    assert len(robot.agent.events("on_circle")) == 1
    assert [event["count"] for event in robot.agent.events("revolution")] in ([1, 2], [1, 2, 3])


def test_circle_that_was_turned_round_comes_back_at_once(fleet: Fleet) -> None:
    robot = Robot(fleet, "robotarium.Circle", {"centre_m": [0.0, 0.0], "turn_per_s": 1.2}, Pose(0.27, 0.0, math.pi / 2))
    robot.drive(12)
    assert robot.off_m(0.0, 0.0, 0.27) < 0.1, "the wrong way round is no way"


def test_circle_follows_a_subject_and_waits_for_one_that_is_silent(fleet: Fleet) -> None:
    robot = Robot(fleet, "robotarium.Circle", {"subject": "walker"}, Pose(0.5, 0.0, math.pi))
    assert robot.turn() == Twist(0.0, 0.0)
    robot.agent.publish(SYSTEM, RobotPose("other", 9.0, 9.0, 0.0, 0.1, 0.1))
    assert robot.turn() == Twist(0.0, 0.0)
    robot.agent.publish(SYSTEM, RobotPose("walker", 0.0, 0.0, 0.0, 0.1, 0.1))
    assert robot.turn().v_mps > 0.0
    fleet.run_for(4.0)
    assert robot.turn() == Twist(0.0, 0.0)


@pytest.mark.parametrize("settings", [{}, {"centre_m": [0.0, 0.0], "subject": "walker"}])
def test_circle_needs_one_thing_to_go_round(settings: dict[str, Any]) -> None:
    with pytest.raises(SettingsError, match="either centre_m or subject"):
        make_settings(Circle.Settings, settings)


def test_patrol_gets_on_its_way_first() -> None:
    assert aim_m((0.0, 0.5), (-1.0, 0.0), (1.0, 0.0)) == pytest.approx((0.3, 0.0))
    assert aim_m((5.0, 0.5), (-1.0, 0.0), (1.0, 0.0)) == pytest.approx((1.0, 0.0)), "never beyond its end"
    assert aim_m((-5.0, 0.5), (-1.0, 0.0), (1.0, 0.0)) == pytest.approx((-0.7, 0.0)), "nor before its beginning"
    assert aim_m((0.0, 0.0), (1.0, 1.0), (1.0, 1.0)) == (1.0, 1.0)


def test_patrol_goes_from_place_to_place(fleet: Fleet) -> None:
    settings = {"waypoints_m": [[1.0, 0.0], [0.0, 0.0]], "turn_per_s": 1.2}
    robot = Robot(fleet, "robotarium.Patrol", settings, Pose(0.0, 0.0, 1.0))
    robot.drive(100)
    reached = [event["number"] for event in robot.agent.events("waypoint")]
    assert len(reached) >= 3 and reached == [0, 1, 0, 1, 0, 1][: len(reached)]
    assert robot.agent.events("round_done")[0]["count"] == 1


def test_patrol_leaves_out_a_place_that_it_does_not_reach(fleet: Fleet) -> None:
    settings = {"waypoints_m": [[1.0, 0.0], [0.0, 0.0]], "patience_s": 5.0}
    robot = Robot(fleet, "robotarium.Patrol", settings, Pose(0.5, 0.0, 0.0))
    robot.drive(30, push=lambda pose: Pose(min(pose.x_m, 0.7), pose.y_m, pose.theta_rad))
    assert [event["number"] for event in robot.agent.events("waypoint_skipped")][:1] == [0]
    robot.drive(40)
    assert [event["number"] for event in robot.agent.events("waypoint")][:1] == [1]


@pytest.mark.parametrize(
    ("waypoints", "what"),
    [
        ([], "two waypoints or more"),
        ([[1, 0], [1, 0]], "two waypoints or more, in different places"),
        ([[0, 0], [math.nan, 0]], "is not a number"),
        ([[0, 0], [math.inf, 0]], "is not finite"),
    ],
)
def test_patrol_without_places_is_refused(waypoints: list[Any], what: str) -> None:
    with pytest.raises(SettingsError, match=what):
        make_settings(Patrol.Settings, {"waypoints_m": waypoints})
