"""The curve of the Khepera's infrared sensors, against its formula and the calibration of the original robots."""

import math

import pytest

from pancakes.sim.robot_models import KHEPERA_III

assert KHEPERA_III.ir is not None
CURVE = KHEPERA_III.ir.curve


@pytest.mark.parametrize("distance_m", [0.02, 0.05, 0.1, 0.15, 0.2])
def test_raw_values_follow_the_formula_and_lead_back(distance_m):
    raw = CURVE.raw(distance_m)
    assert raw == pytest.approx(3960 * math.exp(-30 * (distance_m - 0.02)))
    assert CURVE.distance(raw) == pytest.approx(distance_m)


@pytest.mark.parametrize(
    ("raw", "distance_m"), [(3945, 0.0), (1342, 0.05), (163, 0.10), (38, 0.15), (22, 0.20), (12, 0.25)]
)
def test_the_calibration_of_the_original_lies_within_three_centimetres(raw, distance_m):
    in_range_m = min(max(distance_m, 0.02), 0.20)
    assert CURVE.distance(raw) == pytest.approx(in_range_m, abs=0.03)


def test_nearer_than_it_can_tell_is_the_nearest():
    assert CURVE.raw(0.0) == CURVE.raw(0.02) == 3960
    assert CURVE.distance(4095) == 0.02


def test_nothing_in_sight_is_its_full_range():
    assert CURVE.raw(math.inf) == 0.0
    for raw in (0.0, -3.0, 1.0):
        assert CURVE.distance(raw) == 0.20
