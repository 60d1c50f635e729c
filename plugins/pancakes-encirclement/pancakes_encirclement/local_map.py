"""The memory of what a robot's rings of sensors saw.

A ring of thin beams shows only bits of a body at a time, and none between two beams. A robot that remembers a
few seconds of it, in the frame of the world, has the whole outline by the time it gets near.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pancakes.devices import Pose

Point = tuple[float, float]

SEEN_SHARE = 0.95
"""A reading above this share of the sensor's range means `nothing there`: it drowns in noise."""
MERGE_M = 0.03
"""Two echoes that are nearer than this are one."""
BEAM_RAD = math.radians(6.0)
"""Half of the width in which a beam proves that nothing is there."""
_BEAM_SLOPE = math.tan(BEAM_RAD)
_BEAM_EDGE = 1.001 / math.cos(BEAM_RAD)  # how much longer its edge is than its middle, and a little for rounding
THROUGH_M = 0.08
"""A beam must reach this far past an echo before the echo counts as gone."""


@dataclass(slots=True)
class _Echo:
    x_m: float
    y_m: float
    seen_s: float


class LocalMap:
    """Echoes of the last seconds, forgotten when they are old or when a beam passes through their place.

    Args:
        body_radius_m: radius of the robot's body, on whose edge the sensors sit.
        reach_m: echoes farther than this from the body's centre are not kept.
        memory_s: how long an echo is kept without being seen again.
    """

    def __init__(self, body_radius_m: float, reach_m: float, memory_s: float) -> None:
        self._body_radius_m = body_radius_m
        self._reach_m = reach_m
        self._memory_s = memory_s
        self._echoes: list[_Echo] = []

    def sweep(
        self, pose: Pose, bearings_rad: Sequence[float], ranges_m: Sequence[float], max_range_m: float, now_s: float
    ) -> None:
        """Take one sweep of a ring of sensors, seen from `pose`."""
        seen_m = SEEN_SHARE * max_range_m
        if min(ranges_m, default=seen_m) >= seen_m and not self._remembers(
            pose, self._body_radius_m + max_range_m - THROUGH_M
        ):
            return  # nothing there, and nothing remembered that a beam could reach, as most of the time
        for bearing, range_m in zip(bearings_rad, ranges_m, strict=True):
            hit = range_m < seen_m
            distance = self._body_radius_m + (range_m if hit else max_range_m)
            if self._echoes:
                self._clear(pose, bearing, distance - THROUGH_M)
            if hit and distance <= self._reach_m:
                direction = pose.theta_rad + bearing
                self._add(pose.x_m + distance * math.cos(direction), pose.y_m + distance * math.sin(direction), now_s)

    def _remembers(self, pose: Pose, free_m: float) -> bool:
        """Return whether an echo may lie in some beam that reaches `free_m` from the body's centre."""
        reach_m = free_m * _BEAM_EDGE
        return any(math.hypot(echo.x_m - pose.x_m, echo.y_m - pose.y_m) < reach_m for echo in self._echoes)

    def around(self, pose: Pose, now_s: float) -> list[Point]:
        """Return the echoes in the frame of a body at `pose`: x ahead, y to the left, in metres."""
        if not self._echoes:
            return []
        oldest_s = now_s - self._memory_s
        self._echoes = [echo for echo in self._echoes if echo.seen_s >= oldest_s]
        cos, sin = math.cos(pose.theta_rad), math.sin(pose.theta_rad)
        points = []
        for echo in self._echoes:
            dx, dy = echo.x_m - pose.x_m, echo.y_m - pose.y_m
            points.append((dx * cos + dy * sin, dy * cos - dx * sin))
        return points

    def _add(self, x_m: float, y_m: float, now_s: float) -> None:
        for echo in self._echoes:
            if abs(echo.x_m - x_m) < MERGE_M and abs(echo.y_m - y_m) < MERGE_M:
                echo.x_m, echo.y_m, echo.seen_s = x_m, y_m, now_s
                return
        self._echoes.append(_Echo(x_m, y_m, now_s))

    def _clear(self, pose: Pose, bearing_rad: float, free_m: float) -> None:
        """Forget the echoes in a beam that has just reached at least `free_m` from the body's centre."""
        direction = pose.theta_rad + bearing_rad
        cos, sin = math.cos(direction), math.sin(direction)
        x_m, y_m, radius_m = pose.x_m, pose.y_m, self._body_radius_m
        gone = []
        for echo in self._echoes:
            dx, dy = echo.x_m - x_m, echo.y_m - y_m
            ahead = dx * cos + dy * sin
            if radius_m < ahead < free_m and abs(dy * cos - dx * sin) < ahead * _BEAM_SLOPE:
                gone.append(echo)
        if gone:
            self._echoes = [echo for echo in self._echoes if echo not in gone]
