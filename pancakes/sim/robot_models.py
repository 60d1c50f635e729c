"""Robot models: the wheels, infrared rings and sonar rings of the Khepera III and the Pioneer 3-DX, as data.

`robot_model(name)` returns what a configuration calls `khepera3`, `pioneer3dx`, or by the name of a model that another
distribution brings (entry point group `pancakes.robot_models`). `DriveKinematics` turns wheel speeds
into the motion of the body and back, within the limits of the motors. `IrCurve` turns raw infrared values into metres.
The Khepera III is the robot of the paper's experiment (paper §4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import msgspec

from pancakes.devices import Twist
from pancakes.errors import PancakesError, PluginError
from pancakes.util.plugins import UnknownPluginError, installed, to_install
from pancakes.util.text import did_you_mean

GROUP: Final = "pancakes.robot_models"
"""The entry point group of robot models."""


class Wheels(msgspec.Struct, frozen=True, gc=False):
    """The speeds of both wheels over the ground, in m/s."""

    left_mps: float
    right_mps: float


STILL = Wheels(0.0, 0.0)
"""Both wheels stand."""


@dataclass(frozen=True, slots=True)
class DriveKinematics:
    """Two wheels on one axle.

    Attributes:
        wheel_base_m: distance between the wheels.
        max_wheel_mps: the fastest that a wheel can run, either way.
        max_v_mps: the fastest forward speed that the course controller takes.
        max_omega_radps: the fastest turning rate that the course controller takes.
        units_per_mps: the motor controller's whole units of speed for 1 m/s; it can do nothing in between.
    """

    wheel_base_m: float
    max_wheel_mps: float
    max_v_mps: float
    max_omega_radps: float
    units_per_mps: float

    def wheels(self, twist: Twist) -> Wheels:
        """Return the wheel speeds for a command, within every limit.

        Where a limit is in the way, the whole command is scaled down, so that the robot is slower on the same
        path: its curvature is kept.
        """
        # Before all comparisons: `max` loses a NaN that does not come first.
        if not (math.isfinite(twist.v_mps) and math.isfinite(twist.omega_radps)):
            return STILL
        half_turn_mps = 0.5 * self.wheel_base_m * twist.omega_radps
        left_mps, right_mps = twist.v_mps - half_turn_mps, twist.v_mps + half_turn_mps
        excess = max(
            abs(twist.v_mps) / self.max_v_mps,
            abs(twist.omega_radps) / self.max_omega_radps,
            abs(left_mps) / self.max_wheel_mps,
            abs(right_mps) / self.max_wheel_mps,
        )
        if not math.isfinite(excess):  # they are numbers, and too large to reckon with
            return STILL
        if excess > 1.0:
            left_mps, right_mps = left_mps / excess, right_mps / excess
        return Wheels(left_mps, right_mps)

    def twist(self, wheels: Wheels) -> Twist:
        """Return the body's motion that wheel speeds make."""
        return Twist(
            0.5 * (wheels.left_mps + wheels.right_mps),
            (wheels.right_mps - wheels.left_mps) / self.wheel_base_m,
        )

    def carried_out(self, wheels: Wheels) -> Wheels:
        """Return what the motor controller makes of wheel speeds: whole units, and no faster than it can."""
        return Wheels(self._whole_units(wheels.left_mps), self._whole_units(wheels.right_mps))

    def _whole_units(self, speed_mps: float) -> float:
        limit_mps = self.max_wheel_mps
        if not -limit_mps <= speed_mps <= limit_mps:
            speed_mps = min(max(speed_mps, -limit_mps), limit_mps)
        return round(speed_mps * self.units_per_mps) / self.units_per_mps


@dataclass(frozen=True, slots=True)
class IrCurve:
    """The sensor's own units over distance: `raw = peak * exp(-decay * (distance - nearest))`.

    The Khepera III's figures are those of the original simulation; the calibration table of the original
    robots (3945 units at the sensor, 22 at 20 cm) lies within 3 cm of it everywhere.

    Attributes:
        peak_raw: what it says at the nearest distance it can tell, and nearer.
        decay_per_m: how fast that falls.
        nearest_m: the nearest distance it can tell.
        farthest_m: its range.
    """

    peak_raw: float
    decay_per_m: float
    nearest_m: float
    farthest_m: float

    def raw(self, distance_m: float) -> float:
        """Return what the sensor says of something at `distance_m`; infinity means that it sees nothing."""
        return self.peak_raw * math.exp(-self.decay_per_m * (max(distance_m, self.nearest_m) - self.nearest_m))

    def distance(self, raw: float) -> float:
        """Return the distance that `raw` means, in metres, within the sensor's range."""
        if raw <= 0.0:
            return self.farthest_m
        distance_m = self.nearest_m + math.log(self.peak_raw / raw) / self.decay_per_m
        return min(max(distance_m, self.nearest_m), self.farthest_m)


@dataclass(frozen=True, slots=True)
class RangeSensor:
    """One proximity sensor on a body.

    Attributes:
        x_m: position ahead of the body's centre.
        y_m: position to the left of the body's centre.
        bearing_rad: where it looks, from straight ahead, counter-clockwise.
    """

    x_m: float
    y_m: float
    bearing_rad: float


@dataclass(frozen=True, slots=True)
class IrRing:
    """Infrared sensors around a body; each sees a cone, and says what is nearest in it."""

    sensors: tuple[RangeSensor, ...]
    cone_rad: float
    curve: IrCurve


@dataclass(frozen=True, slots=True)
class SonarRing:
    """Sonars around a body; each sees a cone, and says what is nearest in it."""

    sensors: tuple[RangeSensor, ...]
    cone_rad: float
    max_range_m: float


@dataclass(frozen=True, slots=True)
class LaserScanner:
    """A laser scanner on a body, which looks ahead.

    Attributes:
        ahead_m: where it is, ahead of the body's centre.
        start_rad: direction of its first ray, from straight ahead, counter-clockwise.
        step_rad: from each ray to the next.
        rays: the number of rays.
        max_range_m: its full range.
    """

    ahead_m: float
    start_rad: float
    step_rad: float
    rays: int
    max_range_m: float

    @property
    def sensors(self) -> tuple[RangeSensor, ...]:
        """Its rays, each as a sensor."""
        return tuple(RangeSensor(self.ahead_m, 0.0, self.start_rad + ray * self.step_rad) for ray in range(self.rays))


@dataclass(frozen=True, slots=True)
class WheelEncoders:
    """The encoders of two wheels.

    Attributes:
        wheel_radius_m: the radius of a wheel.
        ticks_per_turn: how many ticks a turn of a wheel makes.
    """

    wheel_radius_m: float
    ticks_per_turn: int

    def angle_rad(self, rolled_m: float) -> float:
        """Return how far a wheel has turned, in whole ticks, if it has rolled over a distance."""
        per_tick_rad = math.tau / self.ticks_per_turn
        return round(rolled_m / self.wheel_radius_m / per_tick_rad) * per_tick_rad


@dataclass(frozen=True, slots=True)
class RobotModel:
    """A kind of robot.

    Attributes:
        name: what configurations call it.
        diameter_m: the body is a disc of this diameter.
        mass_kg: its mass.
        drive: its wheels.
        full_v: voltage of its full battery.
        empty_v: voltage at which its battery counts as empty.
        ir: its infrared ring, or None.
        sonar: its sonar ring, or None.
        laser: its laser scanner, or None.
        encoders: the encoders of its wheels, or None.
    """

    name: str
    diameter_m: float
    mass_kg: float
    drive: DriveKinematics
    full_v: float
    empty_v: float
    ir: IrRing | None = None
    sonar: SonarRing | None = None
    laser: LaserScanner | None = None
    encoders: WheelEncoders | None = None

    @property
    def radius_m(self) -> float:
        return 0.5 * self.diameter_m


_DIAMETER_M = 0.13
_UNITS_PER_MPS = 144_010.0
_MAX_UNITS = 48_000

_IR_AT = (  # x, y, bearing in degrees; the left side first, mirrored below
    (-0.038, 0.048, 128.0),
    (0.019, 0.064, 75.0),
    (0.050, 0.050, 42.0),
    (0.070, 0.017, 13.0),
)
_SONAR_DEG = (90.0, 45.0, 0.0, -45.0, -90.0)


def _ir_sensors() -> tuple[RangeSensor, ...]:
    left = [RangeSensor(x_m, y_m, math.radians(deg)) for x_m, y_m, deg in _IR_AT]
    right = [RangeSensor(sensor.x_m, -sensor.y_m, -sensor.bearing_rad) for sensor in reversed(left)]
    return (*left, *right, RangeSensor(-0.048, 0.0, math.pi))


def _sonar_sensors() -> tuple[RangeSensor, ...]:
    rim_m = 0.5 * _DIAMETER_M
    bearings = [math.radians(deg) for deg in _SONAR_DEG]
    return tuple(RangeSensor(rim_m * math.cos(b), rim_m * math.sin(b), b) for b in bearings)


KHEPERA_III: Final = RobotModel(
    name="khepera3",
    diameter_m=_DIAMETER_M,
    mass_kg=0.69,
    drive=DriveKinematics(
        wheel_base_m=0.0885,
        max_wheel_mps=_MAX_UNITS / _UNITS_PER_MPS,
        max_v_mps=0.314,
        max_omega_radps=2.276,
        units_per_mps=_UNITS_PER_MPS,
    ),
    full_v=8.4,
    empty_v=6.6,
    ir=IrRing(
        sensors=_ir_sensors(),
        cone_rad=math.radians(20.0),
        curve=IrCurve(peak_raw=3960.0, decay_per_m=30.0, nearest_m=0.02, farthest_m=0.20),
    ),
    sonar=SonarRing(sensors=_sonar_sensors(), cone_rad=math.radians(30.0), max_range_m=4.0),
    laser=LaserScanner(
        ahead_m=0.0, start_rad=math.radians(-120.0), step_rad=math.radians(360.0 / 1024 * 3), rays=228, max_range_m=4.0
    ),
    encoders=WheelEncoders(wheel_radius_m=0.0205, ticks_per_turn=2764),
)
"""A Khepera III with firmware 2: nine infrared sensors, five sonars, wheels up to 0.333 m/s. Its laser scanner is the
Hokuyo URG-04LX that K-Team sells for it, with each third step."""


_PIONEER_DIAMETER_M = 0.455
_FRONT_DEG = (90.0, 50.0, 30.0, 10.0, -10.0, -30.0, -50.0, -90.0)
_REAR_DEG = (-90.0, -130.0, -150.0, -170.0, 170.0, 150.0, 130.0, 90.0)


def _sensor(deg: float, ahead_m: float) -> RangeSensor:
    """Both of its sonar arrays are bent round the body; the two that look sideways sit apart on each side."""
    bearing_rad = math.radians(deg)
    rim_m = 0.5 * _PIONEER_DIAMETER_M
    x_m, y_m = rim_m * math.cos(bearing_rad), rim_m * math.sin(bearing_rad)
    if abs(deg) == 90.0:
        x_m = ahead_m
        y_m = math.copysign(math.sqrt(rim_m**2 - ahead_m**2), deg)
    return RangeSensor(x_m, y_m, bearing_rad)


PIONEER_3DX: Final = RobotModel(
    name="pioneer3dx",
    diameter_m=_PIONEER_DIAMETER_M,
    mass_kg=9.0,
    drive=DriveKinematics(
        wheel_base_m=0.33,
        max_wheel_mps=0.75,
        max_v_mps=0.7,
        max_omega_radps=math.radians(140.0),
        units_per_mps=1000.0,
    ),
    full_v=12.6,
    empty_v=11.0,
    sonar=SonarRing(
        sensors=(*(_sensor(deg, 0.07) for deg in _FRONT_DEG), *(_sensor(deg, -0.07) for deg in _REAR_DEG)),
        cone_rad=math.radians(15.0),
        max_range_m=5.0,
    ),
    laser=LaserScanner(
        ahead_m=0.02, start_rad=math.radians(-90.0), step_rad=math.radians(1.0), rays=181, max_range_m=8.0
    ),
    encoders=WheelEncoders(wheel_radius_m=0.0975, ticks_per_turn=76_600),
)
"""A Pioneer 3-DX with both sonar arrays; its controller takes whole millimetres a second. Its laser scanner is a SICK
LMS200 at 1 degree and millimetres."""


class UnknownRobotModelError(PancakesError, ValueError):
    """There is no robot model of this name that can be used; the message says why, and lists those there are."""


def robot_model(name: str) -> RobotModel:
    """Return the robot model that a configuration calls `name`: one of the core, or an installed plug-in.

    Raises:
        UnknownRobotModelError: there is none of that name, or its plug-in cannot be loaded.
    """
    plugins = installed()
    try:
        found = plugins.get(GROUP, name)
    except UnknownPluginError:
        known = plugins.names(GROUP)
        command = to_install(GROUP, name, known)
        hint = f": {command}" if command else did_you_mean(name, known)
        raise UnknownRobotModelError(f"there is no robot model {name!r} (there are {', '.join(known)}){hint}") from None
    except PluginError as error:
        raise UnknownRobotModelError(str(error)) from None
    if not isinstance(found, RobotModel):
        raise UnknownRobotModelError(f"the robot model {name!r} is a {type(found).__name__}, not a RobotModel")
    if found.name != name:  # bodies and drivers compare names
        raise UnknownRobotModelError(f"the robot model {name!r} calls itself {found.name!r}: both must be one name")
    return found
