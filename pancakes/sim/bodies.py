"""The bodies of the simulated world: discs, robots, sensor nodes, people, and the settings that place them.

Settings are tables by name, and the name is that of the body: a simulated device finds its body by the name of its
agent, unless its settings name another. `Disc` is where a body is and how it moves; `Robot` adds wheels and a battery.
No physics: pymunk is not imported here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from pancakes.devices import Motion
from pancakes.errors import PancakesError
from pancakes.settings import NotNegative, Positive
from pancakes.sim.battery import BatteryModel, BatterySettings
from pancakes.sim.docks import DockSettings, check_docks
from pancakes.sim.pedestrian import MoverSettings, Obstacle, Wayfinder
from pancakes.sim.robot_models import (
    STILL,
    IrRing,
    LaserScanner,
    RobotModel,
    SonarRing,
    WheelEncoders,
    Wheels,
    robot_model,
)

_Part = TypeVar("_Part")


class Disc:
    """A round body.

    A moving body is given its velocity, which it takes up in the next step. Contact with something solid takes away the
    part of the velocity that would bring the body into it.

    Args:
        name: what it is called.
        radius_m: its size.
        x_m: where its centre is.
        y_m: where its centre is.
        angle_rad: its heading.
        mass_kg: its mass; infinity: it never moves.

    Attributes:
        angle_rad: its heading as its turns add up.
        vx_mps: its true velocity along the arena's x axis.
        vy_mps: the same along y.
        turning_radps: how fast it truly turns.
        top_mps: its top speed with the present command.
    """

    def __init__(self, name: str, radius_m: float, x_m: float, y_m: float, angle_rad: float, mass_kg: float) -> None:
        self.name = name
        self.radius_m = radius_m
        self.mass_kg = mass_kg
        self.x_m = x_m
        self.y_m = y_m
        self.angle_rad = angle_rad
        self.vx_mps = self.vy_mps = self.turning_radps = self.top_mps = 0.0
        self._forward_mps = self._omega_radps = 0.0
        self._walk: tuple[float, float] | None = None
        self._looks_rad = angle_rad

    def roll(self, v_mps: float, omega_radps: float) -> None:
        """Move along its heading from now on, turning at `omega_radps`."""
        self._forward_mps, self._omega_radps, self._walk = v_mps, omega_radps, None
        self.top_mps = max(self.top_mps, abs(v_mps))

    def walk(self, vx_mps: float, vy_mps: float) -> None:
        """Move with a velocity along the arena's axes from now on, and look where it goes."""
        self._walk = (vx_mps, vy_mps)
        self.top_mps = max(self.top_mps, math.hypot(vx_mps, vy_mps))
        if vx_mps or vy_mps:
            self._looks_rad = math.atan2(vy_mps, vx_mps)

    @property
    def position(self) -> tuple[float, float]:
        return self.x_m, self.y_m

    @property
    def velocity(self) -> tuple[float, float]:
        """Its true velocity along the arena's axes, in m/s."""
        return self.vx_mps, self.vy_mps

    @property
    def theta_rad(self) -> float:
        """Its heading, in (-pi, pi]."""
        theta_rad = self._looks_rad if self._walk is not None else self.angle_rad
        return math.pi - (math.pi - theta_rad) % math.tau

    def course(self) -> tuple[float, float, float]:
        """Return its heading, its true speed along that, and its true turning rate, in one call."""
        theta_rad = self.theta_rad
        v_mps = self.vx_mps * math.cos(theta_rad) + self.vy_mps * math.sin(theta_rad)
        return theta_rad, v_mps, 0.0 if self._walk is not None else self.turning_radps

    def asked_for(self) -> tuple[float, float, float, float]:
        """Return its forward speed, its turning rate, and its velocity along the axes, as asked for."""
        if self._walk is not None:
            return 0.0, 0.0, *self._walk
        return self._forward_mps, self._omega_radps, 0.0, 0.0

    def moved(
        self, x_m: float, y_m: float, angle_rad: float, vx_mps: float, vy_mps: float, turning_radps: float
    ) -> None:
        """Take the results of a step."""
        self.x_m, self.y_m, self.angle_rad = x_m, y_m, angle_rad
        self.vx_mps, self.vy_mps, self.turning_radps = vx_mps, vy_mps, turning_radps
        asked_mps = math.hypot(*self._walk) if self._walk is not None else abs(self._forward_mps)
        true_mps = math.hypot(vx_mps, vy_mps)
        self.top_mps = asked_mps if asked_mps > true_mps else true_mps

    def coast(self, steps: int, dt_s: float) -> None:
        """Move by this many steps of `dt_s`, without touching anything."""
        vx_mps, vy_mps, turning_radps = self.vx_mps, self.vy_mps, self.turning_radps
        x_m, y_m, angle_rad = self.x_m, self.y_m, self.angle_rad
        if self._walk is not None:
            for _ in range(steps):
                x_m += vx_mps * dt_s
                y_m += vy_mps * dt_s
                angle_rad += turning_radps * dt_s
                (vx_mps, vy_mps), turning_radps = self._walk, 0.0
        else:
            forward_mps, omega_radps = self._forward_mps, self._omega_radps
            if not (forward_mps or omega_radps or self.top_mps or turning_radps):
                return
            # The chord of the arc that the next step makes points along the heading in the middle of that step.
            half_rad = 0.5 * omega_radps * dt_s
            cos, sin = math.cos, math.sin
            for _ in range(steps):
                x_m += vx_mps * dt_s
                y_m += vy_mps * dt_s
                angle_rad += turning_radps * dt_s
                middle_rad = angle_rad + half_rad
                vx_mps, vy_mps, turning_radps = (
                    forward_mps * cos(middle_rad),
                    forward_mps * sin(middle_rad),
                    omega_radps,
                )
        self.moved(x_m, y_m, angle_rad, vx_mps, vy_mps, turning_radps)


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
        model: what kind of robot it is, a robot model that is installed: `khepera3`, `pioneer3dx`, ...
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
        locates: whether it can measure where the motion is.
        sees_robots: whether it senses robots too.
        least_speed_mps: slower things do not count as moving.
        bearing_noise_rad: standard deviation of the bearing that it measures.
        range_noise_m: standard deviation of the range that it measures.
    """

    range_m: Positive = 2.0
    field_of_view_rad: Positive = math.tau
    locates: bool = False
    sees_robots: bool = False
    least_speed_mps: NotNegative = 0.02
    bearing_noise_rad: NotNegative = 0.02
    range_noise_m: NotNegative = 0.02


def sensed_motion(
    settings: MotionSettings,
    place: tuple[float, float, float],
    bodies: Iterable[tuple[float, float, float]],
    normal: Callable[[], float],
) -> Motion:
    """Return what a motion sensor says: whether one of some bodies moves in its field of view.

    Args:
        settings: the sensor.
        place: where it is: x and y in m, and its heading in rad.
        bodies: the bodies that it takes notice of: x and y in m, and the speed in m/s.
        normal: draws the noise, of mean 0 and deviation 1.

    Returns:
        Also where the nearest one is, if the sensor can tell.
    """
    x_m, y_m, theta_rad = place
    nearest: tuple[float, float] | None = None
    for body_x_m, body_y_m, speed_mps in bodies:
        if speed_mps < settings.least_speed_mps:
            continue
        dx_m, dy_m = body_x_m - x_m, body_y_m - y_m
        range_m = math.hypot(dx_m, dy_m)
        bearing_rad = math.remainder(math.atan2(dy_m, dx_m) - theta_rad, math.tau)
        seen = range_m <= settings.range_m and abs(bearing_rad) <= 0.5 * settings.field_of_view_rad
        if seen and (nearest is None or range_m < nearest[0]):
            nearest = (range_m, bearing_rad)
    if nearest is None or not settings.locates:
        return Motion(nearest is not None)
    range_m = nearest[0] + settings.range_noise_m * normal()
    bearing_rad = nearest[1] + settings.bearing_noise_rad * normal()
    return Motion(True, math.remainder(bearing_rad, math.tau), max(range_m, 0.0))


@dataclass
class SensorSettings:
    """A sensor node: it stands, is solid, and senses motion.

    Attributes:
        x_m: where it stands.
        y_m: where it stands.
        theta_rad: its heading.
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
    """The noise of the simulated hardware, drawn from the seed.

    Attributes:
        wheel: standard deviation of a wheel's speed, as a share of it, drawn for each command.
        ir_share: standard deviation of an infrared sensor's raw value, as a share of it.
        ir_raw: standard deviation of an infrared sensor's raw value, in its own units, in addition.
        sonar_m: standard deviation of a sonar's range.
        laser_m: standard deviation of the range along a ray of a laser scanner.
    """

    wheel: NotNegative = 0.01
    ir_share: NotNegative = 0.01
    ir_raw: NotNegative = 1.0
    sonar_m: NotNegative = 0.005
    laser_m: NotNegative = 0.01


@dataclass
class WorldSettings:
    """The bodies of a world, by name, and its floor; the page, verdicts and figures read them of any world.

    Attributes:
        arena: the floor.
        robots: the robots.
        sensors: the sensor nodes.
        movers: what moves and belongs to no agent, such as persons that walk through it.
    """

    arena: ArenaSettings = field(default_factory=ArenaSettings)
    robots: dict[str, RobotSettings] = field(default_factory=dict)
    sensors: dict[str, SensorSettings] = field(default_factory=dict)
    movers: dict[str, MoverSettings] = field(default_factory=dict)

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


@dataclass
class ContentSettings(WorldSettings):
    """All that is in the simulated world of the core, by name.

    Attributes:
        noise: the noise of the hardware.
        docks: the docks; a simulated dock finds its own by the name of its agent, as a robot finds its body.
    """

    noise: NoiseSettings = field(default_factory=NoiseSettings)
    docks: dict[str, DockSettings] = field(default_factory=dict)

    def __post_init__(self) -> None:
        WorldSettings.__post_init__(self)
        bodies = (*self.robots, *self.sensors, *self.movers)
        check_docks(self.docks, bodies, 0.5 * self.arena.width_m, 0.5 * self.arena.height_m)


class Robot:
    """A robot's wheels and battery, and the body they move.

    The wheels follow the newest command for as long as it is good, then they stand: the safe hold that still
    works if the robot's agent is dead.

    Args:
        model: see below.
        disc: likewise.
        battery: likewise.
        wheel_noise: the noise of a wheel's speed, as a share of it, as a standard deviation.
        normal: draws the noise, of mean 0 and deviation 1.

    Attributes:
        model: what kind of robot it is.
        disc: its body.
        battery: its battery.
        driven_by: the task whose command the wheels follow now; empty in safe hold.
        wheels: how fast both wheels run now.
    """

    def __init__(
        self, model: RobotModel, disc: Disc, battery: BatteryModel, wheel_noise: float, normal: Callable[[], float]
    ) -> None:
        self.model = model
        self.disc = disc
        self.battery = battery
        self._wheel_noise = wheel_noise
        self._normal = normal
        self._good_until_s = math.inf
        self._rolling_mps = 0.0
        self.driven_by = ""
        self.wheels = STILL
        self._turned_m = (0.0, 0.0)
        self._turned_steps = 0
        self._step_s = 0.0
        self._rolled_m = 0.0

    @property
    def position(self) -> tuple[float, float]:
        """Where it is."""
        return self.disc.position

    def infrared_ring(self) -> IrRing:
        """Return its infrared ring.

        Raises:
            PancakesError: robots of its kind have none.
        """
        return self._fitted(self.model.ir, "infrared sensors")

    def sonar_ring(self) -> SonarRing:
        """Return its sonar ring.

        Raises:
            PancakesError: robots of its kind have none.
        """
        return self._fitted(self.model.sonar, "sonars")

    def laser_scanner(self) -> LaserScanner:
        """Return its laser scanner.

        Raises:
            PancakesError: robots of its kind have none.
        """
        return self._fitted(self.model.laser, "laser scanner")

    def wheel_encoders(self) -> WheelEncoders:
        """Return the encoders of its wheels.

        Raises:
            PancakesError: robots of its kind have none.
        """
        return self._fitted(self.model.encoders, "wheel encoders")

    def _fitted(self, part: _Part | None, name: str) -> _Part:
        if part is None:
            raise PancakesError(f"{self.disc.name} is a {self.model.name}, which has no {name}")
        return part

    def drive(self, wheels: Wheels, until_s: float, source: str) -> None:
        """Follow a command.

        Args:
            wheels: the speeds of both wheels.
            until_s: the mission time until which the command is valid.
            source: address of the task that gave it.
        """
        if self.battery.empty:
            return
        asked = self.model.drive.carried_out(wheels)
        left_mps = asked.left_mps * (1.0 + self._wheel_noise * self._normal())
        right_mps = asked.right_mps * (1.0 + self._wheel_noise * self._normal())
        done = self.model.drive.carried_out(Wheels(left_mps, right_mps))
        twist = self.model.drive.twist(done)
        self.disc.roll(twist.v_mps, twist.omega_radps)
        self._turn_on(done)
        self._rolling_mps = abs(done.left_mps) + abs(done.right_mps)
        self._good_until_s = until_s
        self.driven_by = source.rpartition("/")[2]

    def hold(self) -> None:
        """Stop the wheels."""
        self.disc.roll(0.0, 0.0)
        self._turn_on(STILL)
        self._rolling_mps = 0.0
        self._good_until_s = math.inf
        self.driven_by = ""

    def before_step(self, time_s: float) -> float:
        """Begin a step at `time_s`; return when its command expires, infinity if it has none."""
        if self._good_until_s <= time_s:
            self.hold()
        return self._good_until_s

    def rolls(self, steps: int, dt_s: float) -> None:
        """Roll the wheels for this many steps."""
        if self._rolling_mps:
            for _ in range(steps):
                self._rolled_m += self._rolling_mps * dt_s
            self._turned_steps += steps
            self._step_s = dt_s

    def turned_m(self) -> tuple[float, float]:
        """Return how far the left and the right wheel have rolled; backwards is negative.

        It is the same however the steps were grouped: they are counted, and only a command adds up the distance.
        """
        (left_m, right_m), time_s = self._turned_m, self._turned_steps * self._step_s
        return left_m + self.wheels.left_mps * time_s, right_m + self.wheels.right_mps * time_s

    def _turn_on(self, wheels: Wheels) -> None:
        """Go on with other speeds of the wheels."""
        if self._turned_steps:
            self._turned_m, self._turned_steps = self.turned_m(), 0
        self.wheels = wheels

    def settle(self, elapsed_s: float) -> None:
        """Drain the battery for the last `elapsed_s`."""
        self.battery.passed(elapsed_s, self._rolled_m)
        self._rolled_m = 0.0
        if self.battery.empty:
            self.hold()


@dataclass
class SensorNode:
    """A sensor node: a body that stands, with a motion sensor."""

    disc: Disc
    motion: MotionSettings


@dataclass
class Walker:
    """A walking person.

    Attributes:
        disc: the body.
        wayfinder: decides where it goes.
        settings: how it walks.
        standing: the obstacles that never move.
    """

    disc: Disc
    wayfinder: Wayfinder
    settings: MoverSettings
    standing: Sequence[Obstacle]
