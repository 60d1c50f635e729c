"""A person who walks through the arena (a *mover*) and gives way to robots, so that motion sensors see something.

The course is decided ten times a second, from positions and speeds only: straight to the next waypoint if that keeps
clear of everything for the next two seconds, else the smallest turn that does, else stop, else whatever leads away
fastest. Robots need not see the person for that.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import msgspec

from pancakes.settings import NotNegative, Positive

DECIDE_EVERY_S: Final = 0.1
"""How often a mover decides where to go."""

_HORIZON_S = 2.0
_TURNS = 16
_NEAR_M = 0.05
_LEG_TIMEOUT_S = 40.0
_TRIES = 50


@dataclass
class MoverSettings:
    """How a person walks.

    Attributes:
        x_m: where it stands at first.
        y_m: where it stands at first.
        radius_m: its size, as a disc.
        min_speed_mps: the slowest speed drawn for a leg of its way.
        max_speed_mps: the fastest one, and its speed when it gets out of the way.
        max_pause_s: the longest that it rests at a waypoint.
        starts_s: when it begins to walk.
        clearance_m: gap between its edge and a robot's that it keeps, if the robot leaves it a way to.
        keep_out_m: distance that its centre keeps from the centre of a sensor node. Larger than the circle on
            which robots go round the node, it does not walk among them.
        wall_m: gap between its edge and a wall.
        waypoints: the places it walks to, in turn, over and over; the seed draws places if there are none.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    radius_m: Positive = 0.1
    min_speed_mps: Positive = 0.15
    max_speed_mps: Positive = 0.3
    max_pause_s: NotNegative = 3.0
    starts_s: NotNegative = 0.0
    clearance_m: NotNegative = 0.4
    keep_out_m: NotNegative = 0.9
    wall_m: NotNegative = 0.1
    waypoints: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        if self.min_speed_mps > self.max_speed_mps:
            raise ValueError(f"min_speed_mps = {self.min_speed_mps} exceeds max_speed_mps = {self.max_speed_mps}")


class Obstacle(msgspec.Struct, frozen=True, gc=False):
    """A disc that the mover keeps away from.

    Attributes:
        x_m: centre.
        y_m: centre.
        vx_mps: how it moves now.
        vy_mps: how it moves now.
        distance_m: how far the mover's centre must stay from its centre.
    """

    x_m: float
    y_m: float
    vx_mps: float
    vy_mps: float
    distance_m: float


class Wayfinder:
    """Decide where a person walks.

    Args:
        settings: how it walks.
        half_width_m: the arena reaches from minus this to this along x.
        half_height_m: the same along y.
        random: draws waypoints, speeds and pauses.
    """

    def __init__(
        self, settings: MoverSettings, half_width_m: float, half_height_m: float, random: random.Random
    ) -> None:
        self._settings = settings
        margin_m = settings.radius_m + settings.wall_m
        self._reach_x_m = max(half_width_m - margin_m, 0.0)
        self._reach_y_m = max(half_height_m - margin_m, 0.0)
        self._random = random
        self._goal: tuple[float, float] | None = None
        self._next_waypoint = 0
        self._rest_until_s = settings.starts_s
        self._leg_ends_s = 0.0
        self._speed_mps = settings.max_speed_mps
        self._side = 1.0  # the side on which it last went round something: it stays on it

    def decide(
        self, time_s: float, x_m: float, y_m: float, robots: Sequence[Obstacle], fixed: Sequence[Obstacle]
    ) -> tuple[float, float]:
        """Return the velocity to walk with from now on, in m/s along the arena's axes.

        Args:
            time_s: mission time.
            x_m: where it stands.
            y_m: where it stands.
            robots: what it gives way to.
            fixed: the obstacles that never move.
        """
        obstacles = (*robots, *fixed)
        self._follow_plan(time_s, x_m, y_m, fixed)
        if self._goal is None:
            if self._slack(x_m, y_m, 0.0, 0.0, obstacles) >= 0.0:
                return 0.0, 0.0
            return self._get_away(x_m, y_m, obstacles)
        dx_m, dy_m = self._goal[0] - x_m, self._goal[1] - y_m
        speed_mps = min(self._speed_mps, math.hypot(dx_m, dy_m) / DECIDE_EVERY_S)
        course_rad = math.atan2(dy_m, dx_m)
        for turn in range(_TURNS // 4 + 1):
            for side in (self._side, -self._side) if turn else (self._side,):
                angle_rad = course_rad + side * turn * math.tau / _TURNS
                vx_mps, vy_mps = speed_mps * math.cos(angle_rad), speed_mps * math.sin(angle_rad)
                if self._slack(x_m, y_m, vx_mps, vy_mps, obstacles) >= 0.0:
                    self._side = side
                    return vx_mps, vy_mps
        if self._slack(x_m, y_m, 0.0, 0.0, obstacles) >= 0.0:
            return 0.0, 0.0
        return self._get_away(x_m, y_m, obstacles)

    def _follow_plan(self, time_s: float, x_m: float, y_m: float, fixed: Sequence[Obstacle]) -> None:
        """Rests at a waypoint it has reached, and sets out for the next when it has rested."""
        goal = self._goal
        if goal is not None:
            arrived = math.hypot(goal[0] - x_m, goal[1] - y_m) <= _NEAR_M
            if arrived or time_s >= self._leg_ends_s:
                self._goal = None
                pause_s = self._random.uniform(0.0, self._settings.max_pause_s)
                self._rest_until_s = time_s + pause_s if arrived else time_s
        if self._goal is None and time_s >= self._rest_until_s:
            self._goal = self._next_goal(x_m, y_m, fixed)
            self._speed_mps = self._random.uniform(self._settings.min_speed_mps, self._settings.max_speed_mps)
            self._leg_ends_s = time_s + _LEG_TIMEOUT_S

    def _next_goal(self, x_m: float, y_m: float, fixed: Sequence[Obstacle]) -> tuple[float, float]:
        waypoints = self._settings.waypoints
        if waypoints:
            goal = waypoints[self._next_waypoint % len(waypoints)]
            self._next_waypoint += 1
            return goal
        for _ in range(_TRIES):
            goal_x_m = self._random.uniform(-self._reach_x_m, self._reach_x_m)
            goal_y_m = self._random.uniform(-self._reach_y_m, self._reach_y_m)
            far_enough = math.hypot(goal_x_m - x_m, goal_y_m - y_m) > 2 * self._settings.radius_m
            if far_enough and all(
                math.hypot(goal_x_m - thing.x_m, goal_y_m - thing.y_m) >= thing.distance_m for thing in fixed
            ):
                return goal_x_m, goal_y_m
        return x_m, y_m

    def _get_away(self, x_m: float, y_m: float, obstacles: Sequence[Obstacle]) -> tuple[float, float]:
        """Return the velocity, of all there are, that leaves the most room."""
        best, best_room_m = (0.0, 0.0), self._room(x_m, y_m, 0.0, 0.0, obstacles)
        for turn in range(_TURNS):
            angle_rad = turn * math.tau / _TURNS
            vx_mps = self._settings.max_speed_mps * math.cos(angle_rad)
            vy_mps = self._settings.max_speed_mps * math.sin(angle_rad)
            room_m = self._room(x_m, y_m, vx_mps, vy_mps, obstacles)
            if room_m > best_room_m:
                best, best_room_m = (vx_mps, vy_mps), room_m
        return best

    def _room(self, x_m: float, y_m: float, vx_mps: float, vy_mps: float, obstacles: Sequence[Obstacle]) -> float:
        """Like `_slack`, but among ways that never come nearer, the one that ends farther away has more."""
        ahead_s = 0.5 * _HORIZON_S
        end_m = min(
            math.hypot(
                x_m + vx_mps * ahead_s - thing.x_m - thing.vx_mps * ahead_s,
                y_m + vy_mps * ahead_s - thing.y_m - thing.vy_mps * ahead_s,
            )
            - thing.distance_m
            for thing in obstacles
        )
        return self._slack(x_m, y_m, vx_mps, vy_mps, obstacles) + 0.5 * end_m

    def _slack(self, x_m: float, y_m: float, vx_mps: float, vy_mps: float, obstacles: Sequence[Obstacle]) -> float:
        """Return by how much the least of all distances on this way exceeds what it should be."""
        wall_s = DECIDE_EVERY_S * 2
        over_x_m = abs(x_m + vx_mps * wall_s) - self._reach_x_m
        over_y_m = abs(y_m + vy_mps * wall_s) - self._reach_y_m
        if (over_x_m > 0.0 and x_m * vx_mps > 0.0) or (over_y_m > 0.0 and y_m * vy_mps > 0.0):
            return -math.inf
        slack_m = math.inf
        for thing in obstacles:
            dx_m, dy_m = thing.x_m - x_m, thing.y_m - y_m
            wx_mps, wy_mps = thing.vx_mps - vx_mps, thing.vy_mps - vy_mps
            square = wx_mps * wx_mps + wy_mps * wy_mps
            nearest_s = 0.0
            if square > 0.0:
                nearest_s = -(dx_m * wx_mps + dy_m * wy_mps) / square
                nearest_s = 0.0 if nearest_s < 0.0 else nearest_s if nearest_s < _HORIZON_S else _HORIZON_S
            gap_m = math.hypot(dx_m + wx_mps * nearest_s, dy_m + wy_mps * nearest_s) - thing.distance_m
            if gap_m < slack_m:
                slack_m = gap_m
        return slack_m
