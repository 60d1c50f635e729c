"""Drivers that need no plug-in: `host.*`, `network.*`, `null.*` and `static.*`.

- `host.*`: load, memory, temperature and battery of the computer, by psutil.
- `network.*`: virtual devices, whose hardware belongs to another agent (paper §3.3). The agent that has the reading
  sends it to the device's address, as a motion capture sends a robot its pose.
- `null.*`: stand-ins for missing hardware. A null sensor never has a reading; a null actuator takes every command and
  moves nothing.
- `static.*`: readings that never change, such as the pose of a sensor node.

A device type of your own needs a subclass of `NetworkSensor`, `NetworkActuator`, `NullSensor` or `NullActuator`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec

from pancakes.control import Hold
from pancakes.devices import Battery, Dock, Load, Memory, Pose, Temperature
from pancakes.devices.driver import Actuator, DeviceContext, Pace, Sensor
from pancakes.devices.validation import level_of
from pancakes.errors import PancakesError
from pancakes.packet import CTRL, Packet
from pancakes.util.cpu import processor_times

MOST_PERCENT: Final = 105.0
POWER_SUPPLIES: Final = Path("/sys/class/power_supply")
"""Where Linux tells the voltage of batteries, which psutil does not."""


class HostProcessorLoad(Sensor):
    """The share of all processor time in use since the reading before (`host.load`)."""

    type = "load"

    def open(self) -> None:
        self._busy_s, self._all_s = processor_times()

    def read(self) -> Load:
        # Not `psutil.cpu_percent`: it compares with the call before in the same thread, and a pool has several.
        before = self._busy_s, self._all_s
        self._busy_s, self._all_s = processor_times()
        busy_s, all_s = self._busy_s - before[0], self._all_s - before[1]
        return Load(min(max(busy_s / all_s, 0.0), 1.0) if all_s > 0 else 0.0)


class HostMemory(Sensor):
    """The memory in use: what programs could not get if they asked for it (`host.memory`)."""

    type = "memory"

    def read(self) -> Memory:
        import psutil

        memory = psutil.virtual_memory()
        return Memory(memory.total - memory.available, memory.total)


class HostTemperature(Sensor):
    """The temperature of the hottest sensor, or of one kind of sensors (`host.temperature`)."""

    type = "temperature"
    blocking = True  # some of these sensors sit on slow buses

    @dataclass
    class Settings:
        """Which sensors are asked.

        Attributes:
            chip: name of the chip that has them, such as `coretemp` or `cpu_thermal`; empty: all.
        """

        chip: str = ""

    settings: Settings

    def open(self) -> None:
        chips = _temperatures()
        if not chips:
            raise PancakesError("this computer has no temperature sensor that its operating system tells of")
        if self.settings.chip and self.settings.chip not in chips:
            raise PancakesError(
                f"this computer has no temperature sensor {self.settings.chip!r}, only {', '.join(sorted(chips))}"
            )

    def read(self) -> Temperature:
        chips = _temperatures()
        wanted = [self.settings.chip] if self.settings.chip else list(chips)
        celsius = [value for chip in wanted for value in chips.get(chip, [])]
        if not celsius:
            raise PancakesError("no temperature sensor of this computer answers")
        return Temperature(max(celsius))


class HostBattery(Sensor):
    """The battery of a laptop (`host.battery`). Its voltage is NaN where the system does not tell it."""

    type = "battery"
    blocking = True  # asking may go through the firmware

    def open(self) -> None:
        if _battery_share() is None:
            raise PancakesError("this computer has no battery that its operating system tells of")

    def read(self) -> Battery:
        share = _battery_share()
        if share is None:
            raise PancakesError("the operating system tells of no battery any more")
        return Battery(_battery_voltage_v(), share, _battery_charges())


def _temperatures() -> dict[str, list[float]]:
    """Return what all temperature sensors say, by the chip they sit on."""
    import psutil

    ask = getattr(psutil, "sensors_temperatures", None)  # not on every system
    if ask is None:
        return {}
    # A sensor without a value says NaN, or nothing at all; `max` would lose a NaN, or return it.
    chips = {
        chip: [entry.current for entry in entries if entry.current is not None and math.isfinite(entry.current)]
        for chip, entries in ask().items()
    }
    return {chip: values for chip, values in chips.items() if values}


def _battery_share() -> float | None:
    import psutil

    ask = getattr(psutil, "sensors_battery", None)  # not on every system
    battery = ask() if ask is not None else None
    if battery is None:
        return None
    percent = battery.percent
    # Linux reckons with the charge that was full last, so a little more may be left: it is full then.
    return 1.0 if 100.0 < percent <= MOST_PERCENT else level_of(percent, 100.0)


def _battery_charges() -> bool:
    """Return whether the system tells that a battery is being charged; a full one on mains is not."""
    for path in sorted(POWER_SUPPLIES.glob("BAT*/status")):
        try:
            if path.read_text().strip() == "Charging":
                return True
        except OSError:
            continue
    return False


def _battery_voltage_v() -> float:
    for path in sorted(POWER_SUPPLIES.glob("BAT*/voltage_now")):
        try:
            return int(path.read_text()) / 1e6
        except (OSError, ValueError):
            continue
    return math.nan


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

    def read(self) -> None:
        return None

    def receive(self, packet: Packet) -> None:
        """Publish a reading that came as this device's own."""
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
        """Publish a reading that came; return False if it is left out, as too many come."""
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


class NetworkEncoders(NetworkSensor):
    """Wheel encoders of another agent (`network.encoders`)."""

    type = "encoders"


class NetworkImu(NetworkSensor):
    """An inertial measurement unit of another agent (`network.imu`)."""

    type = "imu"


class NetworkGpsFix(NetworkSensor):
    """A GPS receiver of another agent (`network.gps_fix`)."""

    type = "gps_fix"


class NetworkLaserScan(NetworkSensor):
    """A laser scanner of another agent (`network.laser_scan`)."""

    type = "laser_scan"


class NetworkCamera(NetworkSensor):
    """A camera of another agent (`network.camera`)."""

    type = "camera"


class NetworkPose3D(NetworkSensor):
    """A 3-D pose that another agent measures (`network.pose_3d`)."""

    type = "pose_3d"


class NetworkActuator(Actuator):
    """An actuator of another agent; a type of one's own needs a subclass that names it.

    The other agent's device counts the command's time to live from when it comes: its own `hold_after_mission_s`,
    or less where the right of a guarded task ends sooner.
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

    def write(self, command: Any, ttl_s: float, source: str) -> None:
        self.context.send(CTRL, command, self.settings.target)

    def watchdog_s(self, hold_after_s: float) -> float:
        """The other agent holds it where this one is gone; where both are, it is as safe as its own driver says."""
        return hold_after_s

    def safe_stop(self) -> None:
        self.context.send(CTRL, Hold(f"{self.context.agent}/device/{self.context.device} holds"), self.settings.target)


class NetworkMotors(NetworkActuator):
    """Wheels of another agent (`network.motors`)."""

    type = "motors"


class NetworkDock(Actuator):
    """The docks of other agents; each command says which (`network.dock`).

    The dock's own device holds it for this robot while commands come, and no longer than its `hold_after_mission_s`
    after the last. So a dock whose robot is lost becomes free.
    """

    type = "dock"
    networked = True

    def __init__(self, context: DeviceContext, settings: Any) -> None:
        super().__init__(context, settings)
        self._held = ""

    def write(self, command: Dock, ttl_s: float, source: str) -> None:
        """Hold a dock; one that was held before is released.

        Raises:
            PancakesError: `at` is no device's address.
        """
        if command.at.count("/") != 2 or not all(command.at.split("/")):
            raise PancakesError(f"at = {command.at!r} is no device's address, such as 'dock1/device/dock'")
        if command.at != self._held:
            self.safe_stop()
        self._held = command.at
        self.context.send(CTRL, command, command.at)

    def watchdog_s(self, hold_after_s: float) -> float:
        """Return the hold time: the dock's own device counts each command's time to live."""
        return hold_after_s

    def safe_stop(self) -> None:
        """Release the dock that is held."""
        held, self._held = self._held, ""
        if held:
            self.context.send(CTRL, Hold(f"{self.context.agent}/device/{self.context.device} holds"), held)


class NullSensor(Sensor):
    """A sensor without readings; a type of one's own needs a subclass that names it."""

    rate = "optional"  # it stands in for any other sensor

    def read(self) -> None:
        return None


class NullActuator(Actuator):
    """An actuator that swallows its commands; a type of one's own needs a subclass that names it."""

    def write(self, command: Any, ttl_s: float, source: str) -> None:
        pass

    def watchdog_s(self, hold_after_s: float) -> float:
        """Nothing ever moves."""
        return 0.0

    def safe_stop(self) -> None:
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


class NullEncoders(NullSensor):
    """Counts no turns (`null.encoders`)."""

    type = "encoders"


class NullImu(NullSensor):
    """Feels no motion (`null.imu`)."""

    type = "imu"


class NullGpsFix(NullSensor):
    """Never has a fix (`null.gps_fix`)."""

    type = "gps_fix"


class NullLaserScan(NullSensor):
    """Scans nothing (`null.laser_scan`)."""

    type = "laser_scan"


class NullCamera(NullSensor):
    """Takes no image (`null.camera`)."""

    type = "camera"


class NullPose3D(NullSensor):
    """Knows no 3-D pose (`null.pose_3d`)."""

    type = "pose_3d"


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

    def read(self) -> Pose:
        theta_rad = math.pi - (math.pi - self.settings.theta_rad) % math.tau
        return Pose(self.settings.x_m, self.settings.y_m, theta_rad)
