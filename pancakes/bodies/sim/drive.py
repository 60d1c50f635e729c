"""Differential drive: what the two wheels do for a body's speed and turning rate, and how far they can."""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec

from pancakes.bodies.devices.types import Twist


class Wheels(msgspec.Struct, frozen=True, gc=False):
    """The speeds of both wheels over the ground, in m/s."""

    left_mps: float
    right_mps: float


STILL = Wheels(0.0, 0.0)
"""Both wheels stand."""


@dataclass(frozen=True, slots=True)
class DriveKinematics:
    """Two wheels on one axle.

    Attributes:
        wheel_base_m: distance between the wheels.
        max_wheel_mps: the fastest that a wheel can run, either way.
        max_v_mps: the fastest forward speed that the course controller takes.
        max_omega_radps: the fastest turning rate that the course controller takes.
        units_per_mps: the motor controller's whole units of speed for 1 m/s; it can do nothing in between.
    """

    wheel_base_m: float
    max_wheel_mps: float
    max_v_mps: float
    max_omega_radps: float
    units_per_mps: float

    def wheels(self, twist: Twist) -> Wheels:
        """Returns the wheel speeds for a command, within every limit.

        Where a limit is in the way, the whole command is scaled down, so that the robot is slower on the same
        path: its curvature is kept.
        """
        # Before all comparisons: `max` loses a NaN that does not come first.
        if not (math.isfinite(twist.v_mps) and math.isfinite(twist.omega_radps)):
            return STILL
        half_turn_mps = 0.5 * self.wheel_base_m * twist.omega_radps
        left_mps, right_mps = twist.v_mps - half_turn_mps, twist.v_mps + half_turn_mps
        excess = max(
            abs(twist.v_mps) / self.max_v_mps,
            abs(twist.omega_radps) / self.max_omega_radps,
            abs(left_mps) / self.max_wheel_mps,
            abs(right_mps) / self.max_wheel_mps,
        )
        if not math.isfinite(excess):  # they are numbers, and too large to reckon with
            return STILL
        if excess > 1.0:
            left_mps, right_mps = left_mps / excess, right_mps / excess
        return Wheels(left_mps, right_mps)

    def twist(self, wheels: Wheels) -> Twist:
        """Returns the body's motion that wheel speeds make."""
        return Twist(
            0.5 * (wheels.left_mps + wheels.right_mps),
            (wheels.right_mps - wheels.left_mps) / self.wheel_base_m,
        )

    def carried_out(self, wheels: Wheels) -> Wheels:
        """Returns what the motor controller makes of wheel speeds: whole units, and no faster than it can."""
        return Wheels(self._whole_units(wheels.left_mps), self._whole_units(wheels.right_mps))

    def _whole_units(self, speed_mps: float) -> float:
        limit_mps = self.max_wheel_mps
        if not -limit_mps <= speed_mps <= limit_mps:
            speed_mps = min(max(speed_mps, -limit_mps), limit_mps)
        return round(speed_mps * self.units_per_mps) / self.units_per_mps
