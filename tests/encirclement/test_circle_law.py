"""The laws of curvature and spacing, with the figures of the paper's experiment in SI units."""

from __future__ import annotations

import math
import random

import pytest

from pancakes_encirclement.angles import wrap
from pancakes_encirclement.circle import curvature, gap_behind, spaced_speed

R, ALPHA, V = 0.55, 4.0, 0.1


def drive(x: float, y: float, theta: float, duration_s: float, radius_m: float = R) -> list[tuple[float, float, float]]:
    """Lets a point with a heading follow the law; commands change ten times a second, as on the robot."""
    path = []
    for _ in range(round(duration_s * 10)):
        omega = V * curvature((x, y), theta, (0.0, 0.0), radius_m, ALPHA)
        for _ in range(10):
            x += V * 0.01 * math.cos(theta)
            y += V * 0.01 * math.sin(theta)
            theta += omega * 0.01
        path.append((x, y, theta))
    return path


@pytest.mark.parametrize(
    "start", [(1.4, 1.0, -2.5), (1.4, -1.0, 2.5), (-1.0, 0.3, 0.0), (0.2, 0.0, 1.0), (0.6, 0.0, 1.6)]
)
def test_it_settles_at_55_cm_from_any_start(start: tuple[float, float, float]) -> None:
    x, y, _ = drive(*start, 200.0)[-1]
    assert math.hypot(x, y) == pytest.approx(0.5501, abs=0.0005)


@pytest.mark.parametrize("radius_m", [0.3, 0.55, 0.8, 1.2])
def test_it_settles_at_the_radius_it_is_told(radius_m: float) -> None:
    x, y, _ = drive(1.8, 1.0, 3.0, 300.0, radius_m)[-1]
    assert math.hypot(x, y) == pytest.approx(radius_m, rel=0.002)


def test_it_stays_within_5_percent_after_67_s() -> None:
    path = drive(1.4, -1.0, 2.52, 200.0)
    late = [math.hypot(x, y) for x, y, _ in path[670:]]
    early = [math.hypot(x, y) for x, y, _ in path[450:600]]
    assert max(abs(r - R) for r in late) <= 0.05 * R
    assert max(abs(r - R) for r in early) > 0.05 * R, "it takes its time: the figure says about 67 s"


def test_it_goes_round_clockwise() -> None:
    path = drive(1.4, 1.0, -2.5, 200.0)
    (x0, y0, _), (x1, y1, theta) = path[-10], path[-1]
    assert x0 * y1 - y0 * x1 < 0.0
    assert wrap(theta - (math.atan2(y1, x1) - math.pi / 2)) == pytest.approx(0.0, abs=0.02)


def test_on_the_circle_it_bends_by_the_circle() -> None:
    clockwise = curvature((R, 0.0), -math.pi / 2, (0.0, 0.0), R, ALPHA)
    assert clockwise == pytest.approx(-1.0 / R)


def test_outside_it_turns_inwards_and_inside_outwards() -> None:
    outside = curvature((2 * R, 0.0), -math.pi / 2, (0.0, 0.0), R, ALPHA)
    inside = curvature((0.5 * R, 0.0), -math.pi / 2, (0.0, 0.0), R, ALPHA)
    assert outside < -1.0 / (2 * R), "clockwise, inwards is to the right"
    assert inside > 0.0


def test_the_centre_itself_gives_no_curvature() -> None:
    assert curvature((0.3, 0.4), 1.0, (0.3, 0.4), R, ALPHA) == 0.0


def test_the_law_only_knows_where_the_robot_is_seen_from_the_centre() -> None:
    rng = random.Random(3)
    for _ in range(50):
        x, y, theta, turn = (rng.uniform(-2.0, 2.0) for _ in range(4))
        here = curvature((x, y), theta, (0.0, 0.0), R, ALPHA)
        cos, sin = math.cos(turn), math.sin(turn)
        there = curvature((5.0 + x * cos - y * sin, 7.0 + x * sin + y * cos), theta + turn, (5.0, 7.0), R, ALPHA)
        assert there == pytest.approx(here, abs=1e-9)


def test_alone_on_the_circle_a_robot_drives_at_full_speed() -> None:
    assert spaced_speed(None, 1, R, V) == V


def test_a_robot_waits_for_a_follower_that_lies_far_behind() -> None:
    even = 2 * math.pi / 3
    assert spaced_speed(even, 3, R, V) == pytest.approx(V)
    assert spaced_speed(even + 0.1, 3, R, V) == pytest.approx(V - R * 0.1)
    assert spaced_speed(even - 0.5, 3, R, V) == V, "never faster than it may"
    assert spaced_speed(even + 3.0, 3, R, V) == -V


def test_the_follower_is_the_next_robot_counter_clockwise() -> None:
    others = [(0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)]
    assert gap_behind((1.0, 0.0), (0.0, 0.0), others) == pytest.approx(math.pi / 2)
    assert gap_behind((1.0, 0.0), (0.0, 0.0), [(0.0, -1.0)]) == pytest.approx(1.5 * math.pi)
    assert gap_behind((1.0, 0.0), (0.0, 0.0), []) is None


def test_three_robots_come_to_stand_evenly_apart() -> None:
    angles = [0.0, 0.4, 0.9]
    for _ in range(3000):
        places = [(R * math.cos(a), R * math.sin(a)) for a in angles]
        for i, place in enumerate(places):
            gap = gap_behind(place, (0.0, 0.0), places[:i] + places[i + 1 :])
            angles[i] -= max(0.0, spaced_speed(gap, 3, R, V)) / R * 0.1  # clockwise
    angles = sorted(a % (2 * math.pi) for a in angles)
    gaps = [(b - a) % (2 * math.pi) for a, b in zip(angles, angles[1:] + angles[:1], strict=True)]
    assert gaps == pytest.approx([2 * math.pi / 3] * 3, abs=0.02)


@pytest.mark.parametrize(
    ("angle", "wrapped"), [(0.0, 0.0), (math.pi, math.pi), (-math.pi, math.pi), (7.0, 7.0 - 2 * math.pi)]
)
def test_angles_are_wrapped_into_half_open_turns(angle: float, wrapped: float) -> None:
    assert wrap(angle) == pytest.approx(wrapped)
