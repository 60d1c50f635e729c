"""The Khepera III, the robot of the paper's experiment (paper §4)."""

from __future__ import annotations

import math
from typing import Final

from pancakes.bodies.sim.drive import DriveKinematics
from pancakes.bodies.sim.infrared import IrCurve
from pancakes.bodies.sim.robot import IrRing, RangeSensor, RobotModel, SonarRing

_DIAMETER_M = 0.13
_UNITS_PER_MPS = 144_010.0
_MAX_UNITS = 48_000

_IR_AT = (  # x, y, bearing in degrees; the left side first, mirrored below
    (-0.038, 0.048, 128.0),
    (0.019, 0.064, 75.0),
    (0.050, 0.050, 42.0),
    (0.070, 0.017, 13.0),
)
_SONAR_DEG = (90.0, 45.0, 0.0, -45.0, -90.0)


def _ir_sensors() -> tuple[RangeSensor, ...]:
    left = [RangeSensor(x_m, y_m, math.radians(deg)) for x_m, y_m, deg in _IR_AT]
    right = [RangeSensor(sensor.x_m, -sensor.y_m, -sensor.bearing_rad) for sensor in reversed(left)]
    return (*left, *right, RangeSensor(-0.048, 0.0, math.pi))


def _sonar_sensors() -> tuple[RangeSensor, ...]:
    rim_m = 0.5 * _DIAMETER_M
    bearings = [math.radians(deg) for deg in _SONAR_DEG]
    return tuple(RangeSensor(rim_m * math.cos(b), rim_m * math.sin(b), b) for b in bearings)


KHEPERA_III: Final = RobotModel(
    name="khepera3",
    diameter_m=_DIAMETER_M,
    mass_kg=0.69,
    drive=DriveKinematics(
        wheel_base_m=0.0885,
        max_wheel_mps=_MAX_UNITS / _UNITS_PER_MPS,
        max_v_mps=0.314,
        max_omega_radps=2.276,
        units_per_mps=_UNITS_PER_MPS,
    ),
    full_v=8.4,
    empty_v=6.6,
    ir=IrRing(
        sensors=_ir_sensors(),
        cone_rad=math.radians(20.0),
        curve=IrCurve(peak_raw=3960.0, decay_per_m=30.0, nearest_m=0.02, farthest_m=0.20),
    ),
    sonar=SonarRing(sensors=_sonar_sensors(), cone_rad=math.radians(30.0), max_range_m=4.0),
)
"""A Khepera III with firmware 2: nine infrared sensors, five sonars, wheels up to 0.333 m/s."""
