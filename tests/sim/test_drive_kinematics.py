"""The wheels of the Khepera III and of the Pioneer 3-DX: their figures, and what a command makes of them."""

import math

import pytest

from pancakes.devices import Twist
from pancakes.sim.robot_models import KHEPERA_III, PIONEER_3DX, Wheels

KHEPERA = KHEPERA_III.drive


def test_the_khepera_has_the_limits_of_the_real_one():
    assert KHEPERA.max_wheel_mps == pytest.approx(0.333, abs=0.0005)
    assert KHEPERA.max_wheel_mps * KHEPERA.units_per_mps == pytest.approx(48_000)
    assert (KHEPERA.max_v_mps, KHEPERA.max_omega_radps) == (0.314, 2.276)
    assert KHEPERA.wheel_base_m == 0.0885
    assert (KHEPERA_III.diameter_m, KHEPERA_III.mass_kg) == (0.13, 0.69)


def test_the_outer_wheel_runs_faster_in_a_turn():
    wheels = KHEPERA.wheels(Twist(0.1, 0.1 / 0.55))  # the paper's circle, counter-clockwise
    assert wheels.right_mps - wheels.left_mps == pytest.approx(0.0885 * 0.1 / 0.55)
    assert (wheels.right_mps + wheels.left_mps) / 2 == pytest.approx(0.1)


@pytest.mark.parametrize("twist", [Twist(0.1, 0.2), Twist(-0.3, 0.5), Twist(0.0, 2.0), Twist(0.0, 0.0)])
def test_wheels_and_twist_are_two_sides_of_the_same(twist):
    back = KHEPERA.twist(KHEPERA.wheels(twist))
    assert (back.v_mps, back.omega_radps) == pytest.approx((twist.v_mps, twist.omega_radps))


@pytest.mark.parametrize(
    "twist", [Twist(1.0, 0.5), Twist(-0.4, 3.0), Twist(0.3, 2.2), Twist(0.05, 9.0), Twist(0.314, -2.276)]
)
@pytest.mark.parametrize("drive", [KHEPERA, PIONEER_3DX.drive])
def test_a_command_beyond_the_limits_is_slowed_down_on_the_same_path(twist, drive):
    wheels = drive.wheels(twist)
    done = drive.twist(wheels)
    assert max(abs(wheels.left_mps), abs(wheels.right_mps)) <= drive.max_wheel_mps + 1e-12
    assert abs(done.v_mps) <= drive.max_v_mps + 1e-12
    assert abs(done.omega_radps) <= drive.max_omega_radps + 1e-12
    assert done.omega_radps / done.v_mps == pytest.approx(twist.omega_radps / twist.v_mps)


def test_a_command_within_the_limits_is_left_alone():
    assert KHEPERA.twist(KHEPERA.wheels(Twist(0.2, 1.0))).v_mps == pytest.approx(0.2)


def test_the_full_course_limits_together_are_more_than_the_wheels_can():
    done = KHEPERA.twist(KHEPERA.wheels(Twist(0.314, 2.276)))
    assert done.v_mps < 0.314
    assert KHEPERA.wheels(Twist(0.314, 2.276)).right_mps == pytest.approx(KHEPERA.max_wheel_mps)


def test_a_command_that_is_no_number_moves_nothing():
    for twist in (Twist(math.nan, 0.0), Twist(0.1, math.nan), Twist(0.1, math.inf), Twist(1e308, 1e308)):
        assert KHEPERA.wheels(twist) == Wheels(0.0, 0.0)


def test_the_motor_controller_knows_whole_units_only_and_its_own_limit():
    done = KHEPERA.carried_out(Wheels(0.1000001, 5.0))
    assert done.left_mps * KHEPERA.units_per_mps == pytest.approx(14_401)
    assert done.right_mps == pytest.approx(KHEPERA.max_wheel_mps)


def test_the_pioneer_is_wider_and_faster():
    drive = PIONEER_3DX.drive
    assert drive.wheel_base_m == 0.33
    assert drive.twist(drive.wheels(Twist(5.0, 0.0))).v_mps == pytest.approx(0.7)
