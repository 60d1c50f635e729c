"""The base of all tasks that drive a robot: they read the sensors round its body."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from pancakes import SYSTEM, Packet, Task, agent_of, on
from pancakes.devices import Infrared, Sonar
from pancakes_encirclement.avoidance import Avoidance
from pancakes_encirclement.steering import Steering


class DrivingTask(Task):
    """The base of tasks that drive, and steer round what infrared and sonar sensors see.

    A robot needs neither ring of sensors: without them only the law steers it.
    """

    requires = ("pose", "motors")

    @dataclass
    class Settings:
        """How it drives.

        Attributes:
            avoidance: how carefully it drives; the sizes are those of the robot.
        """

        avoidance: Avoidance = field(default_factory=Avoidance)

    settings: Any

    def on_start(self) -> None:
        self.steering = Steering(self.settings.avoidance)

    def on_settings(self) -> None:
        self.steering = Steering(self.settings.avoidance)

    @on(SYSTEM, Infrared, queue="latest")
    def infrared_seen(self, packet: Packet) -> None:
        """Take a sweep of the infrared ring."""
        self._sweep(packet.body)

    @on(SYSTEM, Sonar, queue="latest")
    def sonar_seen(self, packet: Packet) -> None:
        """Take a sweep of the sonar ring."""
        self._sweep(packet.body)

    def _sweep(self, ring: Infrared | Sonar) -> None:
        self.steering.sweep(ring.bearings_rad, ring.ranges_m, ring.max_range_m, self.now())

    def is_own(self, packet: Packet) -> bool:
        """Return whether a packet was published on this robot."""
        return agent_of(packet.source) == self.agent
