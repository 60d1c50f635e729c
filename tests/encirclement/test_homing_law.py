"""The law of `GoHome`: turn on the spot, then drive."""

from __future__ import annotations

import math

import pytest

from pancakes.devices import Twist
from pancakes_encirclement.angles import wrap
from pancakes_encirclement.homing import Homing

LAW = Homing()


def test_it_turns_on_the_spot_while_the_goal_lies_aside() -> None:
    assert LAW.towards(1.0, 2.0) == Twist(0.0, 0.22)
    assert LAW.towards(-3.0, 2.0) == Twist(0.0, -0.22)


def test_it_drives_and_still_steers_once_the_goal_lies_ahead() -> None:
    assert LAW.towards(0.1, 2.0) == Twist(0.1, 0.1)
    assert LAW.towards(math.pi / 8, 2.0).v_mps == 0.1
    assert LAW.towards(math.pi / 8 + 0.001, 2.0).v_mps == 0.0


def test_it_slows_down_near_the_goal() -> None:
    assert LAW.towards(0.0, 0.04).v_mps == pytest.approx(0.04)


@pytest.mark.parametrize("heading", [0.0, 1.5, 3.1, -3.1, -1.5])
def test_it_arrives_from_any_heading(heading: float) -> None:
    x, y, theta = 0.3, -0.4, heading
    for _ in range(600):
        dx, dy = 1.4 - x, 1.0 - y
        twist = LAW.towards(wrap(math.atan2(dy, dx) - theta), math.hypot(dx, dy))
        assert abs(twist.omega_radps) <= 0.22
        theta += twist.omega_radps * 0.1
        x += twist.v_mps * 0.1 * math.cos(theta)
        y += twist.v_mps * 0.1 * math.sin(theta)
    assert math.hypot(1.4 - x, 1.0 - y) < 0.02
