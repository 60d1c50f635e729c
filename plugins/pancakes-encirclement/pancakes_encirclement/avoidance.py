"""How a robot steers round obstacles.

A round robot with two driven wheels can always stop, and turn on the spot without touching anything. So it is safe as
long as it never drives forward into an obstacle: `room_ahead` bounds the speed. It passes an obstacle by turning to the
free bearing nearest to the wanted one: `free_bearing` (after the vector field histogram of Borenstein and Koren, 1991,
with exact bearings instead of sectors).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pancakes import NotNegative, Positive
from pancakes_encirclement.angles import wrap

Point = tuple[float, float]

EDGE_RAD = math.radians(2.0)
"""How far beside a blocked bearing the robot steers."""
TO_THE_RIGHT_RAD = 0.5
"""The extra cost of passing on the right. Two robots that meet both keep to the left; and on a
circle that is taken clockwise the left is outside, where there is room and the way leads on along the circle."""
CHANGE_RAD = 1.2
"""The cost of changing the side: noise never gains this much."""


@dataclass(frozen=True)
class Avoidance:
    """How carefully a robot drives; the sizes are those of the robot.

    Attributes:
        body_radius_m: radius of its body.
        clearance_m: how much room it wants between its edge and what it passes.
        look_ahead_m: the distance from its edge within which obstacles count.
        memory_s: how long it remembers what it no longer sees.
        turn_radps: how fast it turns towards a free bearing.
        patience_s: how long a robot on a circle waits for an obstacle that may move away.
        reaction_s: it drives no faster than to reach an obstacle in this time.
    """

    body_radius_m: Positive = 0.065
    clearance_m: Positive = 0.06
    look_ahead_m: Positive = 0.33
    memory_s: NotNegative = 4.0
    turn_radps: Positive = 0.8
    patience_s: NotNegative = 12.0
    reaction_s: Positive = 1.0


def blocked(points: Sequence[Point], bearing_rad: float, keep_m: float, reach_m: float) -> bool:
    """Return whether something lies within `keep_m` of the way in a direction, up to `reach_m` from here."""
    return any(abs(wrap(bearing_rad - middle)) < half for middle, half in _sectors(points, keep_m, reach_m))


def free_bearing(
    points: Sequence[Point], wanted_rad: float, keep_m: float, reach_m: float, side: int = 0
) -> float | None:
    """Return the free bearing that is nearest to the wanted one.

    Args:
        points: what the robot sees, in the frame of its body.
        wanted_rad: where it would like to drive.
        keep_m: how far its centre must stay from every point.
        reach_m: the distance from its centre within which they count.
        side: the side on which it already passes something: 1 left, -1 right, 0 none.

    Returns:
        A bearing in (-pi, pi]; None if there is no free bearing.
    """
    sectors = _sectors(points, keep_m, reach_m)
    best, best_cost = None, math.inf
    candidates = [wanted_rad]
    for middle, half in sectors:
        candidates += (middle - half - EDGE_RAD, middle + half + EDGE_RAD)
    for candidate in candidates:
        turn = wrap(candidate - wanted_rad)
        cost = abs(turn)
        if turn < 0.0:
            cost += TO_THE_RIGHT_RAD
        if turn * side < 0.0:
            cost += CHANGE_RAD
        if cost < best_cost and all(abs(wrap(candidate - middle)) >= half for middle, half in sectors):
            best, best_cost = wrap(candidate), cost
    return best


def room_ahead(points: Sequence[Point], keep_m: float) -> float:
    """Return how far a body may drive straight on until its centre is within `keep_m` of a point.

    Returns:
        A distance in metres; 0 if a point ahead is that near already, infinity if the way is free.
    """
    room = math.inf
    for x, y in points:
        if x > 0.0 and abs(y) < keep_m:
            room = min(room, max(0.0, x - math.sqrt(keep_m * keep_m - y * y)))
    return room


def _sectors(points: Sequence[Point], keep_m: float, reach_m: float) -> list[tuple[float, float]]:
    """Return the blocked bearings, each as (middle, half of its width)."""
    sectors = []
    for x, y in points:
        distance = math.hypot(x, y)
        if distance <= reach_m:
            half = math.asin(keep_m / distance) if distance > keep_m else math.pi / 2
            sectors.append((math.atan2(y, x), half))
    return sectors
