"""A robot's steering: combine what a law wants and what the robot sees into one twist.

`Steering` is a state machine without packets or clocks: poses, sweeps and times go in, twists come out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from pancakes.devices import Pose, Twist
from pancakes_encirclement.angles import wrap
from pancakes_encirclement.avoidance import Avoidance, blocked, free_bearing, room_ahead
from pancakes_encirclement.homing import Homing
from pancakes_encirclement.local_map import LocalMap

_TIGHTER = (1.0, 0.5, 0.2)
"""Shares of the wanted clearance that a robot tries in turn if it finds no way."""
_STOP_SHARE = 0.3
"""The share of the clearance that a robot never drives into."""
_SLOWEST_SHARE = 0.2
"""The share of its speed that a robot keeps even if its way leads far from the wanted direction."""
_WORTH_WAITING_RAD = 0.2
"""If a way round deviates more than this, the robot first waits for a free one."""

_Points = list[tuple[float, float]]


class Steering:
    """Lead a robot round what its sensors show.

    Args:
        avoidance: how carefully it drives.
    """

    def __init__(self, avoidance: Avoidance) -> None:
        self._avoidance = avoidance
        self._reach_m = avoidance.body_radius_m + avoidance.look_ahead_m
        kept_m = self._reach_m + 2.0 * avoidance.clearance_m
        self._map = LocalMap(avoidance.body_radius_m, kept_m, avoidance.memory_s)
        self._pose: Pose | None = None
        self._side = 0
        self._blocked_since_s: float | None = None

    def sweep(self, bearings_rad: Sequence[float], ranges_m: Sequence[float], max_range_m: float, now_s: float) -> None:
        """Take a sweep of a ring of sensors; without a pose it is ignored."""
        if self._pose is not None:
            self._map.sweep(self._pose, bearings_rad, ranges_m, max_range_m, now_s)

    def moved(self, pose: Pose) -> None:
        """Take the robot's newest pose."""
        self._pose = pose

    def follow(self, wanted: Twist, now_s: float) -> Twist:
        """Return the wanted twist if its way is free.

        Otherwise the robot first waits a while for an obstacle that may move away, such as another robot that leaves
        the circle, and then takes a way round. Robots that did not wait would push each other off the circle.
        """
        points = self._points(now_s)
        # The chord of the arc, as far ahead as the robot looks, is the direction that the law wants to take.
        chord = wanted.omega_radps / wanted.v_mps * self._reach_m / 2.0 if wanted.v_mps > 0.0 else 0.0
        chord = max(-math.pi / 2, min(math.pi / 2, chord))
        if wanted.v_mps <= 0.0 or not blocked(points, chord, self._keep_m(1.0), self._reach_m):
            self._side, self._blocked_since_s = 0, None
            return self._slowed(wanted, points)
        if self._blocked_since_s is None:
            self._blocked_since_s = now_s
        bearing = self._way_round(points, chord, self._reach_m)
        patient = now_s - self._blocked_since_s < self._avoidance.patience_s
        if bearing is None or (patient and abs(wrap(bearing - chord)) > _WORTH_WAITING_RAD):
            return Twist(0.0, 0.0)
        return self._detour(points, chord, bearing, math.inf, Homing(wanted.v_mps, self._avoidance.turn_radps))

    def drive_to(self, bearing_rad: float, distance_m: float, homing: Homing, now_s: float) -> Twist:
        """Return the twist that brings the robot to a goal, round obstacles.

        Args:
            bearing_rad: direction of the goal in the frame of the body.
            distance_m: distance to the goal.
            homing: the law to drive by.
            now_s: mission time.
        """
        points = self._points(now_s)
        reach = min(self._reach_m, distance_m + self._keep_m(1.0))
        if not blocked(points, bearing_rad, self._keep_m(1.0), reach):
            self._side = 0
            return self._slowed(homing.towards(bearing_rad, distance_m), points)
        bearing = self._way_round(points, bearing_rad, reach)
        if bearing is None:  # no free bearing: it waits until obstacles move
            return Twist(0.0, 0.0)
        return self._detour(points, bearing_rad, bearing, distance_m, homing)

    def _points(self, now_s: float) -> _Points:
        return [] if self._pose is None else self._map.around(self._pose, now_s)

    def _keep_m(self, share: float) -> float:
        return self._avoidance.body_radius_m + share * self._avoidance.clearance_m

    def _way_round(self, points: _Points, wanted_rad: float, reach_m: float) -> float | None:
        for share in _TIGHTER:
            bearing = free_bearing(points, wanted_rad, self._keep_m(share), reach_m, self._side)
            if bearing is not None:
                return bearing
        return None

    def _detour(
        self, points: _Points, wanted_rad: float, bearing_rad: float, distance_m: float, homing: Homing
    ) -> Twist:
        turn = wrap(bearing_rad - wanted_rad)
        if turn != 0.0:
            self._side = 1 if turn > 0.0 else -1
        twist = homing.towards(bearing_rad, distance_m)
        # Slower, the farther off: otherwise two robots side by side would block each other from turning for ever.
        share = max(_SLOWEST_SHARE, 1.0 - abs(turn) / (math.pi / 2))
        return self._slowed(Twist(twist.v_mps * share, twist.omega_radps), points)

    def _slowed(self, twist: Twist, points: _Points) -> Twist:
        room = room_ahead(points, self._keep_m(_STOP_SHARE))
        return Twist(min(twist.v_mps, room / self._avoidance.reaction_s), twist.omega_radps)
