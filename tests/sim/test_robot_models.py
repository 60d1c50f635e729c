"""The robots that a configuration can name, and the sensors they carry."""

import math

import pytest

from pancakes.errors import PancakesError
from pancakes.sim.robot_models import KHEPERA_III, PIONEER_3DX, robot_model


def degrees(ring):
    return [round(math.degrees(sensor.bearing_rad)) for sensor in ring.sensors]


def test_models_are_found_by_name():
    assert robot_model("khepera3") is KHEPERA_III
    assert robot_model("pioneer3dx") is PIONEER_3DX


def test_an_unknown_model_gets_a_suggestion():
    with pytest.raises(PancakesError, match="no robot model 'kepera3'.*khepera3, pioneer3dx.*did you mean 'khepera3'"):
        robot_model("kepera3")


def test_the_khepera_has_nine_infrared_sensors_where_the_real_one_has_them():
    ring = KHEPERA_III.ir
    assert ring is not None
    assert sorted(degrees(ring)) == [-128, -75, -42, -13, 13, 42, 75, 128, 180]
    places = {round(math.degrees(s.bearing_rad)): (s.x_m, s.y_m) for s in ring.sensors}
    assert places[128] == (-0.038, 0.048)
    assert places[-128] == (-0.038, -0.048)
    assert places[13] == (0.070, 0.017)
    assert places[180] == (-0.048, 0.0)
    assert math.degrees(ring.cone_rad) == pytest.approx(20)
    assert (ring.curve.nearest_m, ring.curve.farthest_m) == (0.02, 0.20)


def test_the_khepera_has_five_sonars_that_reach_four_metres():
    ring = KHEPERA_III.sonar
    assert ring is not None and degrees(ring) == [90, 45, 0, -45, -90]
    assert ring.max_range_m == 4.0
    assert (KHEPERA_III.full_v, KHEPERA_III.empty_v) == (8.4, 6.6)


def test_the_pioneer_has_sonars_all_round_and_no_infrared():
    assert PIONEER_3DX.ir is None
    ring = PIONEER_3DX.sonar
    assert ring is not None and degrees(ring)[:8] == [90, 50, 30, 10, -10, -30, -50, -90]
    assert len(ring.sensors) == 16
    for sensor in ring.sensors:
        assert math.hypot(sensor.x_m, sensor.y_m) == pytest.approx(PIONEER_3DX.radius_m)
