"""The packets between the tasks of the encirclement."""

from __future__ import annotations

import msgspec

from pancakes import packet_type


@packet_type("encirclement.motion_detected")
class MotionDetected(msgspec.Struct, frozen=True):
    """Motion was sensed here: the place to go round, in the frame of the world."""

    x_m: float
    y_m: float


@packet_type("encirclement.neighbour_pose")
class NeighbourPose(msgspec.Struct, frozen=True):
    """Where the sender is, in the frame of the world; heading in radians, counter-clockwise from the x axis."""

    x_m: float
    y_m: float
    theta_rad: float
