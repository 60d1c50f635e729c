"""The robots of the Robotarium, GTernals, as a robot model (`gternal`), and their ring of range sensors. Pure.

Size and wheels are those of `rps` 0.0.0, which has no battery and no mass. The battery is one lithium cell, by the
robots' firmware; its voltages and the mass are assumptions.
"""

from __future__ import annotations

import math
from typing import Final

from pancakes.worlds import DriveKinematics, RangeSensor, RobotModel, SonarRing

MAX_MPS: Final = 0.2
"""The fastest that a wheel runs, and so the robot."""
DIAMETER_M: Final = 0.11

ROUNDING: Final = 1e-9
"""As a share: wheels exactly at their limit may be counted as faster, after a conversion there and back."""

GTERNAL: Final = RobotModel(
    name="gternal",
    diameter_m=DIAMETER_M,
    mass_kg=0.3,
    drive=DriveKinematics(
        wheel_base_m=0.105,
        max_wheel_mps=MAX_MPS * (1.0 - ROUNDING),
        max_v_mps=MAX_MPS * (1.0 - ROUNDING),
        max_omega_radps=2.0 * MAX_MPS / DIAMETER_M * (1.0 - ROUNDING),
        units_per_mps=1e9,
    ),
    full_v=4.2,
    empty_v=3.3,
)
"""A GTernal: 0.11 m wide, two wheels of up to 0.2 m/s, one lithium cell."""

_RANGERS = (  # x, y in m and bearing in degrees; left to right, as on the robot
    (-0.04, 0.04, 180.0),
    (0.0, 0.06, 90.0),
    (0.04, 0.05, 45.0),
    (0.05, 0.0, 0.0),
    (0.04, -0.05, -45.0),
    (0.0, -0.06, -90.0),
    (-0.04, -0.04, -180.0),
)
RING: Final = SonarRing(
    sensors=tuple(RangeSensor(x_m, y_m, math.radians(deg)) for x_m, y_m, deg in _RANGERS),
    cone_rad=math.radians(25.0),
    max_range_m=1.2,
)
"""Its seven infrared range sensors: where the simulator of version 2.1 has them, up to 1.2 m."""
