"""The Pioneer 3-DX: larger and faster than a Khepera, with sonars all round and no infrared."""

from __future__ import annotations

import math
from typing import Final

from pancakes.bodies.sim.drive import DriveKinematics
from pancakes.bodies.sim.robot import RangeSensor, RobotModel, SonarRing

_DIAMETER_M = 0.455
_FRONT_DEG = (90.0, 50.0, 30.0, 10.0, -10.0, -30.0, -50.0, -90.0)
_REAR_DEG = (-90.0, -130.0, -150.0, -170.0, 170.0, 150.0, 130.0, 90.0)


def _sensor(deg: float, ahead_m: float) -> RangeSensor:
    """Both of its sonar arrays are bent round the body; the two that look sideways sit apart on each side."""
    bearing_rad = math.radians(deg)
    rim_m = 0.5 * _DIAMETER_M
    x_m, y_m = rim_m * math.cos(bearing_rad), rim_m * math.sin(bearing_rad)
    if abs(deg) == 90.0:
        x_m = ahead_m
        y_m = math.copysign(math.sqrt(rim_m**2 - ahead_m**2), deg)
    return RangeSensor(x_m, y_m, bearing_rad)


PIONEER_3DX: Final = RobotModel(
    name="pioneer3dx",
    diameter_m=_DIAMETER_M,
    mass_kg=9.0,
    drive=DriveKinematics(
        wheel_base_m=0.33,
        max_wheel_mps=0.75,
        max_v_mps=0.7,
        max_omega_radps=math.radians(140.0),
        units_per_mps=1000.0,
    ),
    full_v=12.6,
    empty_v=11.0,
    sonar=SonarRing(
        sensors=(*(_sensor(deg, 0.07) for deg in _FRONT_DEG), *(_sensor(deg, -0.07) for deg in _REAR_DEG)),
        cone_rad=math.radians(15.0),
        max_range_m=5.0,
    ),
)
"""A Pioneer 3-DX with both sonar arrays; its controller takes whole millimetres a second."""
