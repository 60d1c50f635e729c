"""What never changes and needs no hardware (`static.*`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pancakes.bodies.devices.driver import Sensor
from pancakes.bodies.devices.types import Pose


class StaticPose(Sensor):
    """The pose of something that was put down and stays there, such as a sensor node (`static.pose`)."""

    type = "pose"

    @dataclass
    class Settings:
        """Where it is.

        Attributes:
            x_m: position along the world's x axis.
            y_m: position along the world's y axis.
            theta_rad: heading, counter-clockwise from the x axis; any multiple of a full turn may be added.
        """

        x_m: float
        y_m: float
        theta_rad: float = 0.0

    settings: Settings

    def sample(self) -> Pose:
        theta_rad = math.pi - (math.pi - self.settings.theta_rad) % math.tau
        return Pose(self.settings.x_m, self.settings.y_m, theta_rad)
