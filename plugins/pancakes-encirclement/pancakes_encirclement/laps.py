"""Count how often a robot has gone round a point."""

from __future__ import annotations

import math

from pancakes_encirclement.angles import wrap
from pancakes_encirclement.circle import Point

ON_CIRCLE_SHARE = 0.1
"""A robot is on the circle if its distance from the centre is within this share of the radius."""


def on_circle(position_m: Point, centre_m: Point, radius_m: float) -> bool:
    """Return whether a place is on a circle, to within `ON_CIRCLE_SHARE` of its radius."""
    distance = math.hypot(position_m[0] - centre_m[0], position_m[1] - centre_m[1])
    return abs(distance - radius_m) <= ON_CIRCLE_SHARE * radius_m


class Laps:
    """Sum the angle that a robot sweeps clockwise round a centre, in revolutions.

    Motion the other way is subtracted, but never from a complete revolution: poses have noise, and a robot that stands
    still at the end of a revolution completes it only once.

    Args:
        revolutions: the earlier count, from this robot or another.
    """

    def __init__(self, revolutions: float = 0.0) -> None:
        self._swept = revolutions
        self._complete = math.floor(revolutions)
        self._bearing_rad: float | None = None

    @property
    def revolutions(self) -> float:
        """The revolutions swept, at least the complete ones."""
        return max(self._swept, float(self._complete))

    def recentred(self) -> None:
        """Begin a new arc with the next position, because the centre has moved."""
        self._bearing_rad = None

    def passed(self, position_m: Point, centre_m: Point) -> bool:
        """Take a position.

        Returns:
            Whether it completes a revolution, for the first time.
        """
        bearing = math.atan2(position_m[1] - centre_m[1], position_m[0] - centre_m[0])
        if self._bearing_rad is not None:
            self._swept -= wrap(bearing - self._bearing_rad) / (2.0 * math.pi)
        self._bearing_rad = bearing
        if math.floor(self._swept) <= self._complete:
            return False
        self._complete = math.floor(self._swept)
        return True
