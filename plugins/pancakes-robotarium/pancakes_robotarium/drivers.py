"""Drivers of the Robotarium's robots (`robotarium.*`): their wheels, and what their sensors say.

They are those of every simulated world; only the robot is another. On real robots other drivers take their places, such
as `mqtt.motors`, and the tasks stay as they are (docs/robotarium.md).
"""

from __future__ import annotations

from dataclasses import dataclass

from pancakes.worlds import DifferentialDrive, SimulatedPose, SimulatedSensor


class RobotariumPose(SimulatedPose):
    """The pose of a robot, as the laboratory's cameras see it (`robotarium.pose`)."""


class RobotariumRanges(SimulatedSensor):
    """A robot's ring of seven infrared range sensors (`robotarium.ir`)."""

    type = "ir"


class RobotariumBattery(SimulatedSensor):
    """A robot's battery, which also pays for its agent's radio (`robotarium.battery`)."""

    type = "battery"
    reports_radio = True


class RobotariumMotors(DifferentialDrive):
    """The two wheels of a GTernal (`robotarium.motors`).

    A command too fast for the wheels is slowed down with its curvature kept.
    """

    @dataclass
    class Settings(DifferentialDrive.Settings):
        """Where the robot is, and what its wheels are like.

        Attributes:
            model: what kind of robot it is; the world refuses another than its own.
        """

        model: str = "gternal"

    settings: Settings
