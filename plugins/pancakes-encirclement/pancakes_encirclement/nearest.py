"""A cost function: the robot that is nearest to the circle takes it."""

from __future__ import annotations

import math
from collections.abc import Mapping

from pancakes import Cost, CostFacts


class Nearest(Cost):
    """How far the agent is from the centre of `ScanTarget`'s circle, in metres (`encirclement.nearest`)."""

    name = "encirclement.nearest"
    reads = ("pose",)

    def terms(self, facts: CostFacts) -> Mapping[str, float]:
        pose = facts.reading("pose")
        x_m, y_m = facts.offered("centre_m")
        return {"metres": math.hypot(pose.x_m - x_m, pose.y_m - y_m)}
