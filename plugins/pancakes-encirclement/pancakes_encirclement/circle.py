"""How a robot goes round a point: the laws of curvature and of spacing (paper §4).

The curvature law follows a boundary by gyroscopic control: it sets only how sharply the robot turns, never
how fast it drives (Zhang, Justh and Krishnaprasad, "Boundary following using gyroscopic control", CDC 2004).
The circle is taken clockwise: from any other heading the law turns the robot until it goes that way.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

Point = tuple[float, float]
"""A place, (x, y) in metres in the frame of the world."""


def curvature(
    position_m: Point, heading_rad: float, centre_m: Point, radius_m: float, alpha_per_m: float = 4.0
) -> float:
    """Return the curvature to drive with, in 1/m, positive to the left.

    With r = position - centre and R the radius:

        kappa = x1.y2 - alpha (1 - (R/|r|)^2) (r^.y2) - (x1.x2)/|r|

    where x2 is the heading, y2 its left normal, r^ = r/|r|, and x1 is r^ turned clockwise by 90 degrees.
    The first term turns the robot along the circle, the second towards it, the third bends the way round.
    The turning rate is the curvature times the speed.

    Args:
        position_m: where the robot is.
        heading_rad: where it looks, counter-clockwise from the x axis.
        centre_m: the point to go round.
        radius_m: the radius of the circle.
        alpha_per_m: how strongly the robot is drawn to the circle.

    Returns:
        The curvature; 0 at the centre itself, where the law has no meaning.
    """
    rx, ry = position_m[0] - centre_m[0], position_m[1] - centre_m[1]
    distance = math.hypot(rx, ry)
    if distance == 0.0:
        return 0.0
    rx, ry = rx / distance, ry / distance
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    outwards = rx * cos + ry * sin  # r^.x2, which is -(x1.y2)
    along = ry * cos - rx * sin  # r^.y2, which is x1.x2 as well: both pairs are a quarter turn apart
    pull = alpha_per_m * (1.0 - (radius_m / distance) ** 2)
    return -outwards - pull * along - along / distance


def spaced_speed(
    gap_behind_rad: float | None, robots: int, radius_m: float, speed_mps: float, gain_per_s: float = 1.0
) -> float:
    """Return the speed with which robots spread evenly on a circle.

        v = clip(v_max + k (2 pi R / n - R gap), -v_max, v_max)

    A robot whose follower is further behind than it should be slows down, one that is pressed by its follower
    goes at full speed. On a circle that is taken clockwise the follower is the next robot counter-clockwise.

    Args:
        gap_behind_rad: angle to the next robot counter-clockwise, in [0, 2 pi); None if there is none.
        robots: how many robots are on the circle, this one included.
        radius_m: the radius of the circle.
        speed_mps: v_max.
        gain_per_s: k.
    """
    if gap_behind_rad is None or robots < 2:
        return speed_mps
    even_m = 2.0 * math.pi * radius_m / robots
    speed = speed_mps + gain_per_s * (even_m - radius_m * gap_behind_rad)
    return max(-speed_mps, min(speed_mps, speed))


def gap_behind(position_m: Point, centre_m: Point, others_m: Iterable[Point]) -> float | None:
    """Return the angle from a robot to the next one counter-clockwise around the centre, in [0, 2 pi).

    Returns:
        None if there is no other robot.
    """
    own = math.atan2(position_m[1] - centre_m[1], position_m[0] - centre_m[0])
    gaps = [(math.atan2(y - centre_m[1], x - centre_m[0]) - own) % (2.0 * math.pi) for x, y in others_m]
    return min(gaps, default=None)
