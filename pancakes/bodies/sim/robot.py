"""What the simulator must know of a kind of robot, as data."""

from __future__ import annotations

from dataclasses import dataclass

from pancakes.bodies.sim.drive import DriveKinematics
from pancakes.bodies.sim.infrared import IrCurve


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
    """

    name: str
    diameter_m: float
    mass_kg: float
    drive: DriveKinematics
    full_v: float
    empty_v: float
    ir: IrRing | None = None
    sonar: SonarRing | None = None

    @property
    def radius_m(self) -> float:
        return 0.5 * self.diameter_m
