"""Which agents ran a task, and when: by the agents' events and by the robots' wheels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from pancakes.tools.demo.mission_record import Holder
from pancakes_encirclement.record import Row

_CLOCKS_AGREE_S = 0.05
"""How well the agents' mission clocks agree: each begins with a packet."""


def driven(path: Sequence[Row], task: str) -> list[Row]:
    """Return the rows in which the wheels of a robot followed a task."""
    return [row for row in path if row.driven_by == task]


def gap_s(paths: Mapping[str, list[Row]], task: str, old: str, new: str) -> float | None:
    """Return the time from the old holder's last motor command that the wheels followed to the new one's first.

    Returns:
        Seconds, to the precision of the trajectory's rows; None if one of them never drove.
    """
    before, after = driven(paths.get(old, ()), task), driven(paths.get(new, ()), task)
    if not before or not after:
        return None
    return max(0.0, after[0].t_s - before[-1].t_s)


def overlap_s(paths: Mapping[str, list[Row]], robots: Sequence[str], task: str, held: Sequence[Holder]) -> float:
    """Return for how long two agents ran a task at once: by their wheels or by their events, the longer time."""
    count: dict[float, int] = {}
    for robot in robots:
        for row in driven(paths.get(robot, ()), task):
            count[row.t_s] = count.get(row.t_s, 0) + 1
    times = sorted({row.t_s for robot in robots for row in paths.get(robot, ())})
    step_s = min((later - earlier for earlier, later in pairwise(times)), default=0.0)
    together = step_s * sum(1 for robots_driven in count.values() if robots_driven > 1)
    said = 0.0
    for earlier, later in pairwise(held):
        both_s = min(earlier.end_s, later.end_s) - later.start_s
        if both_s > _CLOCKS_AGREE_S:
            said += both_s
    return max(together, said)


@dataclass(frozen=True, slots=True)
class RadiusError:
    """How far from a circle a robot drove, once it was on it."""

    mean: float
    max: float


def radius_error(
    path: Sequence[Row], centre_m: tuple[float, float], radius_m: float, arrived_share: float, settling_s: float
) -> RadiusError | None:
    """Return how far from a circle a robot drove.

    Args:
        path: where it was, while it held the task.
        centre_m: the centre of the circle.
        radius_m: its radius.
        arrived_share: it arrives when its distance from the centre is first within this share of the radius.
        settling_s: only the time from this long after its arrival counts.

    Returns:
        The errors; None if it never arrived, or had no time left to settle.
    """
    arrived_s = math.inf
    errors = []
    for row in path:
        error = abs(math.hypot(row.x_m - centre_m[0], row.y_m - centre_m[1]) - radius_m)
        if arrived_s == math.inf and error <= arrived_share * radius_m:
            arrived_s = row.t_s
        if row.t_s >= arrived_s + settling_s:
            errors.append(error)
    return RadiusError(sum(errors) / len(errors), max(errors)) if errors else None
