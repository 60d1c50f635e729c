"""The null driver: a device that is there and does nothing, for any type (`null.*`; paper §3.3).

It lets an agent run where its hardware is missing: a null sensor never has a reading, a null actuator takes every
command and moves nothing.
"""

from __future__ import annotations

from typing import Any

from pancakes.bodies.devices.driver import Actuator, Sensor


class NullSensor(Sensor):
    """A sensor without readings; a type of one's own needs a subclass that names it."""

    rate = "optional"  # it stands in for any other sensor

    def sample(self) -> None:
        return None


class NullActuator(Actuator):
    """An actuator that swallows its commands; a type of one's own needs a subclass that names it."""

    def apply(self, command: Any, ttl_s: float, source: str) -> None:
        pass

    def holds_by_itself(self, hold_after_s: float) -> float:
        """Nothing ever moves."""
        return 0.0

    def hold(self) -> None:
        pass


class NullMotors(NullActuator):
    """Wheels that never turn (`null.motors`)."""

    type = "motors"


class NullPose(NullSensor):
    """Knows no pose (`null.pose`)."""

    type = "pose"


class NullBattery(NullSensor):
    """Knows nothing of a battery (`null.battery`)."""

    type = "battery"


class NullInfrared(NullSensor):
    """Sees nothing (`null.ir`)."""

    type = "ir"


class NullSonar(NullSensor):
    """Hears nothing (`null.sonar`)."""

    type = "sonar"


class NullMotion(NullSensor):
    """Notices nothing (`null.motion`)."""

    type = "motion"


class NullTemperature(NullSensor):
    """Feels nothing (`null.temperature`)."""

    type = "temperature"
