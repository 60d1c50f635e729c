"""Angles, in radians counter-clockwise."""

from __future__ import annotations

import math


def wrap(angle_rad: float) -> float:
    """Return the same direction, in (-pi, pi]."""
    wrapped = math.remainder(angle_rad, 2.0 * math.pi)
    return math.pi if wrapped == -math.pi else wrapped
