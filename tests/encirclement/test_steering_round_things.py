"""What a robot remembers of its sensors, and how it steers round that."""

from __future__ import annotations

import math

import pytest

from pancakes.devices import Pose, Twist
from pancakes_encirclement.avoidance import Avoidance, blocked, free_bearing, room_ahead
from pancakes_encirclement.homing import Homing
from pancakes_encirclement.local_map import BEAM_RAD, LocalMap
from pancakes_encirclement.steering import Steering

HERE = Pose(0.0, 0.0, 0.0)
KEEP, REACH = 0.125, 0.4


def test_an_echo_is_where_the_beam_ended() -> None:
    seen = LocalMap(body_radius_m=0.065, reach_m=0.5, memory_s=4.0)
    seen.sweep(Pose(1.0, 2.0, math.pi / 2), (0.0, math.pi / 2), (0.2, 4.0), 4.0, now_s=0.0)
    assert seen.around(Pose(1.0, 2.0, math.pi / 2), 0.0) == [pytest.approx((0.265, 0.0))]


def test_an_echo_stays_in_its_place_while_the_robot_moves() -> None:
    seen = LocalMap(0.065, 0.5, 4.0)
    seen.sweep(HERE, (0.0,), (0.2,), 4.0, now_s=0.0)
    assert seen.around(Pose(0.1, 0.0, math.pi / 2), 1.0) == [pytest.approx((0.0, -0.165))]


def test_nothing_seen_is_no_echo() -> None:
    seen = LocalMap(0.065, 0.5, 4.0)
    seen.sweep(HERE, (0.0, 1.0), (0.2, 0.196), 0.2, now_s=0.0)
    assert seen.around(HERE, 0.0) == [], "0.2 m is the sensor's whole range, and near it noise reigns"


def test_echoes_grow_old() -> None:
    seen = LocalMap(0.065, 0.5, 4.0)
    seen.sweep(HERE, (0.0,), (0.2,), 4.0, now_s=0.0)
    assert seen.around(HERE, 4.0)
    assert not seen.around(HERE, 4.1)


def test_what_a_beam_passes_through_has_gone() -> None:
    seen = LocalMap(0.065, 0.5, 4.0)
    seen.sweep(HERE, (0.0,), (0.2,), 4.0, now_s=0.0)
    seen.sweep(HERE, (0.0,), (2.0,), 4.0, now_s=0.1)
    assert seen.around(HERE, 0.1) == []


def test_a_beam_that_meets_nothing_passes_through_what_has_gone_as_well() -> None:
    # Along its edge a beam reaches farther out than along its middle.
    for bearing_rad, max_range_m in ((0.0, 0.381), (BEAM_RAD - 1e-6, 0.379), (1e-6 - BEAM_RAD, 0.379)):
        seen = LocalMap(0.065, 0.5, 4.0)
        seen.sweep(HERE, (bearing_rad,), (0.3,), 4.0, now_s=0.0)
        seen.sweep(HERE, (0.0,), (max_range_m,), max_range_m, now_s=0.1)
        assert seen.around(HERE, 0.1) == []


def test_what_a_beam_does_not_reach_stays() -> None:
    seen = LocalMap(0.065, 0.5, 4.0)
    seen.sweep(HERE, (0.0,), (0.3,), 4.0, now_s=0.0)
    seen.sweep(HERE, (0.0,), (0.37,), 0.37, now_s=0.1)
    assert seen.around(HERE, 0.1) == [pytest.approx((0.365, 0.0))]


def test_a_point_shuts_the_bearings_on_which_the_body_would_come_too_near() -> None:
    point = [(0.3, 0.0)]
    half = math.asin(KEEP / 0.3)
    assert blocked(point, half - 0.01, KEEP, REACH)
    assert not blocked(point, half + 0.01, KEEP, REACH)
    assert not blocked([(0.5, 0.0)], 0.0, KEEP, REACH), "that is too far away to mind"


def test_a_point_that_is_too_near_shuts_its_whole_half() -> None:
    assert blocked([(0.1, 0.0)], math.pi / 2 - 0.01, KEEP, REACH)
    assert not blocked([(0.1, 0.0)], math.pi / 2 + 0.01, KEEP, REACH), "away from it is always allowed"


def test_the_free_bearing_is_the_nearest_to_the_wanted_one() -> None:
    half = math.asin(KEEP / 0.3)
    assert free_bearing([(0.3, 0.0)], 1.0, KEEP, REACH) == 1.0
    left = free_bearing([(0.3, 0.0)], 0.2, KEEP, REACH)
    assert left == pytest.approx(half, abs=0.05)
    right = free_bearing([(0.3, 0.0)], -0.4, KEEP, REACH)
    assert right == pytest.approx(-half, abs=0.05)


def test_in_doubt_a_robot_passes_on_the_left_and_keeps_to_its_side() -> None:
    ahead = [(0.3, 0.0)]
    assert (free_bearing(ahead, 0.0, KEEP, REACH) or 0.0) > 0.0
    assert (free_bearing(ahead, 0.0, KEEP, REACH, side=-1) or 0.0) < 0.0


def test_a_robot_that_is_shut_in_has_no_free_bearing() -> None:
    ring = [(0.2 * math.cos(a), 0.2 * math.sin(a)) for a in (0.0, 1.0, 2.0, 3.0, -2.0, -1.0)]
    assert free_bearing(ring, 0.0, KEEP, REACH) is None


def test_room_ahead_ends_where_the_body_would_touch() -> None:
    assert room_ahead([(0.5, 0.0)], 0.1) == pytest.approx(0.4)
    assert room_ahead([(0.5, 0.2), (-0.3, 0.0)], 0.1) == math.inf, "what lies aside or behind is not in the way"
    assert room_ahead([(0.05, 0.0)], 0.1) == 0.0


def seeing(*points: tuple[float, float], avoidance: Avoidance | None = None) -> Steering:
    steering = Steering(avoidance or Avoidance())
    steering.moved(HERE)
    look(steering, *points)
    return steering


def look(steering: Steering, *points: tuple[float, float], now_s: float = 0.0) -> None:
    bearings = [math.atan2(y, x) for x, y in points]
    steering.sweep(bearings, [math.hypot(x, y) - 0.065 for x, y in points], 4.0, now_s)


def test_a_free_way_is_driven_as_the_law_wants() -> None:
    wanted = Twist(0.1, -0.18)
    assert seeing().follow(wanted, 0.0) == wanted


def test_the_target_in_the_middle_of_the_circle_does_not_disturb_it() -> None:
    wanted = Twist(0.1, -0.1 / 0.55)
    sensor_node = (0.0, -0.49)
    assert seeing(sensor_node).follow(wanted, 0.0) == wanted


def test_on_the_circle_a_robot_first_waits_and_then_goes_round() -> None:
    steering = seeing((0.2, 0.0), avoidance=Avoidance(patience_s=5.0))
    assert steering.follow(Twist(0.1, 0.0), 0.0) == Twist(0.0, 0.0)
    look(steering, (0.2, 0.0), now_s=4.9)
    assert steering.follow(Twist(0.1, 0.0), 4.9) == Twist(0.0, 0.0)
    look(steering, (0.2, 0.0), now_s=5.1)
    assert steering.follow(Twist(0.1, 0.0), 5.1).omega_radps > 0.0


def test_on_the_way_home_a_robot_goes_round_at_once() -> None:
    twist = seeing((0.25, 0.0)).drive_to(0.0, 2.0, Homing(), 0.0)
    assert twist.omega_radps > 0.0


def test_a_robot_never_drives_into_what_stands_right_ahead() -> None:
    assert seeing((0.085, 0.0)).drive_to(0.0, 2.0, Homing(), 0.0).v_mps <= 0.01


def test_what_stands_behind_the_goal_is_not_in_the_way() -> None:
    twist = seeing((0.38, 0.0)).drive_to(0.0, 0.1, Homing(), 0.0)
    assert twist == Twist(0.1, 0.0)


def test_without_a_pose_or_sensors_a_robot_follows_the_law_alone() -> None:
    steering = Steering(Avoidance())
    steering.sweep((0.0,), (0.1,), 4.0, 0.0)
    assert steering.drive_to(0.0, 2.0, Homing(), 0.0) == Twist(0.1, 0.0)
