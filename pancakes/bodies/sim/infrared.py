"""What an infrared proximity sensor says of a distance, and what its words mean in metres."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class IrCurve:
    """The sensor's own units over distance: `raw = peak * exp(-decay * (distance - nearest))`.

    The Khepera III's figures are those of the original simulation; the calibration table of the original
    robots (3945 units at the sensor, 22 at 20 cm) lies within 3 cm of it everywhere.

    Attributes:
        peak_raw: what it says at the nearest distance it can tell, and nearer.
        decay_per_m: how fast that falls.
        nearest_m: the nearest distance it can tell.
        farthest_m: its range.
    """

    peak_raw: float
    decay_per_m: float
    nearest_m: float
    farthest_m: float

    def raw(self, distance_m: float) -> float:
        """Returns what the sensor says of something at `distance_m`; infinity means that it sees nothing."""
        return self.peak_raw * math.exp(-self.decay_per_m * (max(distance_m, self.nearest_m) - self.nearest_m))

    def distance(self, raw: float) -> float:
        """Returns the distance that `raw` means, in metres, within the sensor's range."""
        if raw <= 0.0:
            return self.farthest_m
        distance_m = self.nearest_m + math.log(self.peak_raw / raw) / self.decay_per_m
        return min(max(distance_m, self.nearest_m), self.farthest_m)
