"""Find the point of a plane that is nearest to a wanted one and lies in given half-planes. Pure.

This is a quadratic program in two variables, solved exactly: the half-planes are added one after the other, and if the
best point so far is not in the next one, the new best point lies on its edge (Seidel 1991; de Berg et al.,
*Computational Geometry*, chapter 4). The tests compare it with a general solver.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

PARALLEL: Final = 1e-12
TOLERANCE: Final = 1e-9
HALVINGS: Final = 12
"""The slack of `least_bad` is found to this many binary digits of the largest one that may be needed."""


class HalfPlane(NamedTuple):
    """The points (x, y) with `nx * x + ny * y >= c`.

    Attributes:
        nx: x of the unit vector that points into it.
        ny: y of that vector.
        c: the distance of its edge from the origin, along that vector.
    """

    nx: float
    ny: float
    c: float


def nearest(x: float, y: float, planes: Sequence[HalfPlane]) -> tuple[float, float] | None:
    """Return the point nearest to (x, y) that lies in all half-planes; None: they have no point in common."""
    best_x, best_y = x, y
    for index, (nx, ny, c) in enumerate(planes):
        if nx * best_x + ny * best_y >= c - TOLERANCE:
            continue
        # On the edge: from its point nearest to the origin, along (-ny, nx), between `low` and `high`.
        at_x, at_y = c * nx, c * ny
        low, high = -math.inf, math.inf
        for mx, my, d in planes[:index]:
            slope, lacks = ny * -mx + nx * my, d - (mx * at_x + my * at_y)
            if slope > PARALLEL:
                low = max(low, lacks / slope)
            elif slope < -PARALLEL:
                high = min(high, lacks / slope)
            elif lacks > TOLERANCE:
                return None
        if low > high + TOLERANCE:
            return None
        along = min(max((x - at_x) * -ny + (y - at_y) * nx, low), high)
        best_x, best_y = at_x - along * ny, at_y + along * nx
    return best_x, best_y


def least_bad(
    x: float, y: float, hard: Sequence[HalfPlane], soft: Sequence[HalfPlane], gives: Sequence[float] = ()
) -> tuple[float, float]:
    """Return the point nearest to (x, y) in all hard half-planes, outside of the soft ones as little as possible.

    As little as possible: the largest distance outside of one of them, for what it gives, is the smallest that the hard
    ones allow.

    Args:
        x: the wanted point.
        y: the wanted point.
        hard: half-planes that all have the origin in them.
        soft: the others.
        gives: how much each soft one gives way, compared with the others, above 0; empty: all alike.
    """
    found = nearest(x, y, [*hard, *soft])
    if found is not None:
        return found
    gives = gives or [1.0] * len(soft)
    # With this slack the origin is in all of them.
    enough = max((it.c / give for it, give in zip(soft, gives, strict=True)), default=0.0)
    little = 0.0
    best = (0.0, 0.0)
    for _ in range(HALVINGS):
        slack = 0.5 * (little + enough)
        wider = (HalfPlane(it.nx, it.ny, it.c - slack * give) for it, give in zip(soft, gives, strict=True))
        found = nearest(x, y, [*hard, *wider])
        if found is None:
            little = slack
        else:
            enough, best = slack, found
    return best
