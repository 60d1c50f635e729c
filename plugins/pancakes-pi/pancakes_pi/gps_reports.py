"""What gpsd reports, and what it means for a pose. Pure.

Source: gpsd_json(5), protocol 3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import msgspec

from pancakes.devices import Pose
from pancakes.util import codecs
from pancakes.util.codecs import MALFORMED

WATCH: Final = b'?WATCH={"enable":true,"json":true}\n'
EQUATOR_M: Final = 6_378_137.0
FLATTENING: Final = 1 / 298.257223563
"""The ellipsoid of WGS 84."""
FIX: Final = 2
"""The mode of a report with a position; below, there is none."""
_decode: Final = codecs.json_decoder()


class Origin(msgspec.Struct, frozen=True):
    """The place on the earth at which x and y are 0: x leads east, y leads north.

    Attributes:
        lat_deg: its latitude.
        lon_deg: its longitude.
    """

    lat_deg: float
    lon_deg: float

    def metres(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        """Returns a place in metres east and north, on the plane that touches the ellipsoid at the origin.

        Within 10 km it is right to a thousandth.
        """
        sine = math.sin(math.radians(self.lat_deg))
        squared = FLATTENING * (2.0 - FLATTENING)
        root = math.sqrt(1.0 - squared * sine * sine)
        across_m, along_m = EQUATOR_M / root, EQUATOR_M * (1.0 - squared) / root**3
        turn_deg = (lon_deg - self.lon_deg + 180.0) % 360.0 - 180.0
        east_m = math.radians(turn_deg) * across_m * math.cos(math.radians(self.lat_deg))
        return east_m, math.radians(lat_deg - self.lat_deg) * along_m


class Position(msgspec.Struct, frozen=True):
    """One report with a position.

    Attributes:
        lat_deg, lon_deg: where the receiver is.
        speed_mps: how fast it moves; None: not told.
        track_deg: where it moves to, from north clockwise; None: not told.
    """

    lat_deg: float
    lon_deg: float
    speed_mps: float | None = None
    track_deg: float | None = None


def report_in(line: bytes) -> Mapping[str, Any]:
    """Returns a report; an empty one where the line is none."""
    try:
        report = _decode(line)
    except MALFORMED:
        return {}
    return report if isinstance(report, Mapping) else {}


def position_in(report: Mapping[str, Any]) -> Position | None:
    """Returns the position that a report tells; None where it tells none."""
    if report.get("class") != "TPV" or not isinstance(report.get("mode"), int) or report["mode"] < FIX:
        return None
    lat_deg, lon_deg = _number(report, "lat"), _number(report, "lon")
    if lat_deg is None or lon_deg is None or abs(lat_deg) > 90.0 or abs(lon_deg) > 360.0:
        return None
    return Position(lat_deg, lon_deg, _number(report, "speed"), _number(report, "track"))


def pose_at(position: Position, origin: Origin, least_mps: float, theta_rad: float) -> Pose:
    """Returns the pose of a receiver.

    Args:
        position: where it is.
        origin: where x and y are 0.
        least_mps: a receiver that is slower cannot tell where it moves to.
        theta_rad: its heading so far, which it keeps then.
    """
    x_m, y_m = origin.metres(position.lat_deg, position.lon_deg)
    speed_mps, track_deg = position.speed_mps, position.track_deg
    if speed_mps is not None and track_deg is not None and speed_mps >= least_mps:
        turned = math.radians(90.0 - track_deg)
        theta_rad = math.atan2(math.sin(turned), math.cos(turned))
    return Pose(x_m, y_m, theta_rad)


def _number(report: Mapping[str, Any], key: str) -> float | None:
    value = report.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        return None
    return float(value)
