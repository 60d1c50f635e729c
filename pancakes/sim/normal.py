"""Random numbers of the normal distribution, for the noise of sensors and wheels."""

from __future__ import annotations

import math
import random
from collections.abc import Callable


def normals(random: random.Random) -> Callable[[], float]:
    """Returns what draws numbers of mean 0 and deviation 1: the same as `random.gauss` gives, at a third of its cost.

    Args:
        random: what they are drawn from, two at a time; nobody else may draw from it.
    """
    draw, sqrt, log, cos, sin, tau = random.random, math.sqrt, math.log, math.cos, math.sin, math.tau
    other: float | None = None

    def normal() -> float:
        nonlocal other
        if other is not None:
            number, other = other, None
            return number
        # Box and Muller: a random direction, and how far.
        angle_rad = draw() * tau
        away = sqrt(-2.0 * log(1.0 - draw()))
        other = sin(angle_rad) * away
        return cos(angle_rad) * away

    return normal
