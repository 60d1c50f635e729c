"""How a robot drives to a place (paper §4, `GoHome`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pancakes import Positive
from pancakes.devices import Twist


@dataclass(frozen=True)
class Homing:
    """How a robot drives towards a bearing.

    Attributes:
        speed_mps: its speed far from the goal.
        turn_radps: its highest turning rate.
        cone_rad: it drives only if the goal lies within this of its heading; otherwise it turns on the spot.
        gain_per_s: speed for each metre still to go, and turning rate for each radian still to turn.
    """

    speed_mps: Positive = 0.1
    turn_radps: Positive = 0.22
    cone_rad: Positive = math.pi / 8
    gain_per_s: Positive = 1.0

    def towards(self, bearing_rad: float, distance_m: float) -> Twist:
        """Return the twist that brings a robot to a goal.

        Args:
            bearing_rad: direction of the goal in the frame of the body, in (-pi, pi].
            distance_m: distance to the goal.
        """
        omega = max(-self.turn_radps, min(self.turn_radps, self.gain_per_s * bearing_rad))
        if abs(bearing_rad) > self.cone_rad:
            return Twist(0.0, math.copysign(self.turn_radps, bearing_rad))
        return Twist(min(self.speed_mps, self.gain_per_s * distance_m), omega)
