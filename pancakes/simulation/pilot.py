"""The task by which a program outside the simulation drives a robot in it, and reads what the robot reads."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec

from pancakes.bodies.devices.types import Infrared, Pose
from pancakes.bodies.sim.drive import STILL, Wheels
from pancakes.bodies.sim.models import robot_model
from pancakes.packet import CTRL, SYSTEM, Packet, packet_type
from pancakes.task import Task, Tick, every, on


@packet_type("simulation.wheels")
class WheelSpeeds(msgspec.Struct, frozen=True):
    """How fast a robot's wheels are to run from now on.

    Attributes:
        left_mps: speed of the left wheel over the ground, forward.
        right_mps: speed of the right wheel.
    """

    left_mps: float
    right_mps: float


class Pilot(Task):
    """Drives as the newest `WheelSpeeds` on `ctrl` say, until others come; keeps the newest readings.

    Attributes:
        pose: the newest pose; None: there is none yet.
        infrared: the newest sweep of the infrared ring; None: there is none yet.
    """

    requires = ("motors",)

    @dataclass
    class Settings:
        """What it drives.

        Attributes:
            model: the kind of robot.
        """

        model: str = "khepera3"

        def __post_init__(self) -> None:
            robot_model(self.model)  # an unknown one is a fault of the settings

    settings: Settings
    pose: Pose | None = None
    infrared: Infrared | None = None
    _wheels = STILL

    @on(CTRL, WheelSpeeds, keep="latest")
    def steered(self, packet: Packet) -> None:
        """Follows new speeds."""
        self._wheels = Wheels(packet.body.left_mps, packet.body.right_mps)
        self._drive()

    @every(hz=10)
    def go_on(self, tick: Tick) -> None:
        """Says them again: a command is good for half a second."""
        self._drive()

    def _drive(self) -> None:
        self.publish(CTRL, robot_model(self.settings.model).drive.twist(self._wheels))

    @on(SYSTEM, Pose, keep="latest")
    def located(self, packet: Packet) -> None:
        """Keeps the newest pose."""
        self.pose = packet.body

    @on(SYSTEM, Infrared, keep="latest")
    def swept(self, packet: Packet) -> None:
        """Keeps the newest sweep of the infrared ring."""
        self.infrared = packet.body
