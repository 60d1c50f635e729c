"""Virtual devices: the hardware is another agent's, the packets come over the mesh (`network.*`; paper §3.3).

To the tasks of an agent a virtual sensor is a local one. The agent that has the reading sends it to the device's
address, as a motion capture sends a robot its pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import msgspec

from pancakes.bodies.devices.driver import Actuator, DeviceContext, Sensor
from pancakes.bodies.devices.pace import Pace
from pancakes.control import Hold
from pancakes.packet import CTRL, Packet

_Positive = Annotated[float, msgspec.Meta(gt=0)]


class NetworkSensor(Sensor):
    """A sensor whose readings come from another agent; a type of one's own needs a subclass that names it.

    A reading is published as soon as it comes, so the device takes no rate: `max_hz` bounds it.
    """

    networked = True
    rate = "none"
    silent_s = 2.0

    @dataclass
    class Settings:
        """How many readings are wanted.

        Attributes:
            max_hz: how many readings a second are published, where more come; without it, all are.
        """

        max_hz: _Positive | None = None

    settings: Settings

    def __init__(self, context: DeviceContext, settings: Any) -> None:
        super().__init__(context, settings)
        self._pace = Pace(settings.max_hz) if settings.max_hz is not None else None
        self._strange_told = False

    def sample(self) -> None:
        return None

    def receive(self, packet: Packet) -> None:
        """Publishes a reading that came as this device's own."""
        if packet.type != self.type or isinstance(packet.body, dict):
            if not self._strange_told:
                self._strange_told = True
                self.context.log(
                    "warning",
                    f"this device takes packets of the type {self.type!r}; {packet.source} sent {packet.type!r}",
                )
            return
        self.take(packet.body)

    def take(self, body: Any) -> bool:
        """Publishes a reading that came; returns False if it is left out, as too many come."""
        if self._pace is not None and not self._pace.due(self.context.now()):
            self.context.alive()
            return False
        self.context.deliver(body)
        return True


class NetworkPose(NetworkSensor):
    """A pose that another agent measures (`network.pose`)."""

    type = "pose"


class NetworkMotion(NetworkSensor):
    """Motion that another agent senses (`network.motion`)."""

    type = "motion"


class NetworkBattery(NetworkSensor):
    """A battery that another agent measures (`network.battery`)."""

    type = "battery"


class NetworkInfrared(NetworkSensor):
    """Infrared sensors of another agent (`network.ir`)."""

    type = "ir"


class NetworkSonar(NetworkSensor):
    """Sonars of another agent (`network.sonar`)."""

    type = "sonar"


class NetworkTemperature(NetworkSensor):
    """A thermometer of another agent (`network.temperature`)."""

    type = "temperature"


class NetworkActuator(Actuator):
    """An actuator of another agent; a type of one's own needs a subclass that names it.

    The other agent's device counts the command's time to live from when it comes: its own `hold_after_s`, or less where
    the right of a guarded task ends sooner.
    """

    networked = True

    @dataclass
    class Settings:
        """Which actuator it is.

        Attributes:
            target: the device's address, such as `agent2/device/motors`.
        """

        target: str

        def __post_init__(self) -> None:
            if self.target.count("/") != 2 or not all(self.target.split("/")):
                raise ValueError(f"target = {self.target!r} is no device's address, such as 'agent2/device/motors'")

    settings: Settings

    def apply(self, command: Any, ttl_s: float, source: str) -> None:
        self.context.send(CTRL, command, self.settings.target)

    def holds_by_itself(self, hold_after_s: float) -> float:
        """The other agent holds it where this one is gone; where both are, it is as safe as its own driver says."""
        return hold_after_s

    def hold(self) -> None:
        self.context.send(CTRL, Hold(f"{self.context.agent}/device/{self.context.device} holds"), self.settings.target)


class NetworkMotors(NetworkActuator):
    """Wheels of another agent (`network.motors`)."""

    type = "motors"
