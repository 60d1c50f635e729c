"""`GoHome`: drive back to the home station, and stay there (paper §4)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from pancakes import CTRL, SYSTEM, Packet, Positive, on
from pancakes.devices import Pose, Twist
from pancakes_encirclement.angles import wrap
from pancakes_encirclement.driving import DrivingTask
from pancakes_encirclement.homing import Homing

LEAVE_FACTOR = 3.0
"""A parked robot drives again if it is farther from home than this many times the tolerance."""


class GoHome(DrivingTask):
    """Drive to the robot's home, and stay there. Event: `parked`."""

    @dataclass
    class Settings(DrivingTask.Settings):
        """Where home is, and how to get there.

        Attributes:
            home_m: the home station, (x, y) in the frame of the world. It must be set: a task that starts while the
                robot drives cannot know where it came from.
            tolerance_m: how near is home.
            homing: how it drives.
        """

        home_m: tuple[float, float] = field(kw_only=True)
        tolerance_m: Positive = 0.02
        homing: Homing = field(default_factory=Homing)

    settings: Settings
    _parked = False

    @on(SYSTEM, Pose, queue="latest")
    def steer(self, packet: Packet) -> None:
        """Drive on from the robot's present pose."""
        if not self.is_own(packet):
            return
        pose: Pose = packet.body
        self.steering.moved(pose)
        dx_m, dy_m = self.settings.home_m[0] - pose.x_m, self.settings.home_m[1] - pose.y_m
        distance = math.hypot(dx_m, dy_m)
        tolerance = self.settings.tolerance_m
        if self._parked and distance > LEAVE_FACTOR * tolerance:
            self._parked = False
        elif not self._parked and distance <= tolerance:
            self._parked = True
            self.event("parked", distance_m=distance)
        if self._parked:
            self.publish(CTRL, Twist(0.0, 0.0))
            return
        bearing = wrap(math.atan2(dy_m, dx_m) - pose.theta_rad)
        self.publish(CTRL, self.steering.drive_to(bearing, distance, self.settings.homing, self.now()))
