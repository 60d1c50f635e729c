"""The contents of a simulated world: its arena, its robots, its sensor nodes, its walking persons.

Tables are keyed by name, and a name is the body's: a simulated device of the agent of the same name finds its
body by it.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field

from pancakes.bodies.sim.battery import BatterySettings
from pancakes.bodies.sim.models import robot_model
from pancakes.bodies.sim.quantities import NotNegative, Positive
from pancakes.bodies.sim.wayfinder import MoverSettings


@dataclass
class ArenaSettings:
    """The floor, a rectangle round the origin with walls.

    Attributes:
        width_m: size along x.
        height_m: size along y.
    """

    width_m: Positive = 5.0
    height_m: Positive = 4.0


@dataclass
class RobotSettings:
    """A robot in the arena.

    Attributes:
        x_m: where it starts.
        y_m: where it starts.
        theta_rad: how it looks at the start.
        model: what kind of robot it is, `khepera3` or `pioneer3dx`.
        spread_m: the seed moves its start by at most this along each axis.
        spread_rad: the seed turns it at the start by at most this, either way.
        battery: its battery.
    """

    x_m: float
    y_m: float
    theta_rad: float = 0.0
    model: str = "khepera3"
    spread_m: NotNegative = 0.02
    spread_rad: NotNegative = 0.1
    battery: BatterySettings = field(default_factory=BatterySettings)

    def __post_init__(self) -> None:
        robot_model(self.model)  # an unknown one is a fault of the settings


@dataclass
class MotionSettings:
    """What a motion sensor sees.

    Attributes:
        range_m: how far it sees.
        field_of_view_rad: how wide it sees, around the heading of its body.
        locates: whether it can tell where the motion is.
        sees_robots: whether it takes notice of robots too.
        least_speed_mps: what is slower does not move, for it.
        bearing_noise_rad: standard deviation of the bearing that it tells.
        range_noise_m: standard deviation of the range that it tells.
    """

    range_m: Positive = 2.0
    field_of_view_rad: Positive = math.tau
    locates: bool = False
    sees_robots: bool = False
    least_speed_mps: NotNegative = 0.02
    bearing_noise_rad: NotNegative = 0.02
    range_noise_m: NotNegative = 0.02


@dataclass
class SensorSettings:
    """A sensor node: it stands, is solid, and senses motion.

    Attributes:
        x_m: where it stands.
        y_m: where it stands.
        theta_rad: how it looks.
        radius_m: its size, as a disc.
        motion: its motion sensor.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    theta_rad: float = 0.0
    radius_m: Positive = 0.06
    motion: MotionSettings = field(default_factory=MotionSettings)


@dataclass
class NoiseSettings:
    """How far the simulated hardware is off; all of it is drawn from the seed.

    Attributes:
        wheel: standard deviation of a wheel's speed, as a share of it, drawn for each command.
        ir_share: standard deviation of an infrared sensor's raw value, as a share of it.
        ir_raw: standard deviation of an infrared sensor's raw value, in its own units, added to that.
        sonar_m: standard deviation of a sonar's range.
    """

    wheel: NotNegative = 0.01
    ir_share: NotNegative = 0.01
    ir_raw: NotNegative = 1.0
    sonar_m: NotNegative = 0.005


@dataclass
class ContentSettings:
    """All that is in a simulated world, by name.

    Attributes:
        arena: the floor.
        robots: the robots.
        sensors: the sensor nodes.
        movers: the persons that walk through it.
        noise: how far the hardware is off.
    """

    arena: ArenaSettings = field(default_factory=ArenaSettings)
    robots: dict[str, RobotSettings] = field(default_factory=dict)
    sensors: dict[str, SensorSettings] = field(default_factory=dict)
    movers: dict[str, MoverSettings] = field(default_factory=dict)
    noise: NoiseSettings = field(default_factory=NoiseSettings)

    def __post_init__(self) -> None:
        names = [*self.robots, *self.sensors, *self.movers]
        for name in names:
            if not re.fullmatch(r"[A-Za-z0-9_.-]+", name):
                raise ValueError(f"{name!r} cannot be a body's name: letters, digits, '_', '.' and '-' make one")
            if names.count(name) > 1:
                raise ValueError(f"there are several bodies of the name {name!r}")
        half_x_m, half_y_m = 0.5 * self.arena.width_m, 0.5 * self.arena.height_m
        bodies: dict[str, RobotSettings | SensorSettings | MoverSettings]
        bodies = {**self.robots, **self.sensors, **self.movers}
        for name, body in bodies.items():
            if abs(body.x_m) > half_x_m or abs(body.y_m) > half_y_m:
                raise ValueError(f"{name} stands outside the arena, at ({body.x_m}, {body.y_m}) m")
