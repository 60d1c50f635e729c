"""The simulated world: sensors with noise, the physics of all bodies, and the task `sim.world` that owns them.

`Physics` needs no agent: it stays at mission time 0 until it is advanced, in steps of 10 ms, and repeats itself for the
same seed and the same calls. `World` runs in an agent of the role `environment`, answers the hardware bus, and
publishes the true state. While the mission is held at 0, so is the world.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, TypeVar

from pancakes.devices import Battery, Dock, Encoders, Infrared, LaserScan, Motion, Pose, Sonar
from pancakes.errors import PancakesError
from pancakes.packet import agent_of
from pancakes.settings import Positive
from pancakes.sim.arena import Arena, Incident
from pancakes.sim.battery import BatteryModel
from pancakes.sim.bodies import (
    ContentSettings,
    Disc,
    NoiseSettings,
    Robot,
    SensorNode,
    Walker,
    sensed_motion,
)
from pancakes.sim.docks import Docks
from pancakes.sim.pedestrian import DECIDE_EVERY_S, Obstacle, Wayfinder
from pancakes.sim.rays import Fan
from pancakes.sim.robot_models import IrRing, LaserScanner, SonarRing, Wheels, robot_model
from pancakes.sim.simulated_world import EARLY_S, SimulatedWorld
from pancakes.sim.world_state import BodyState, Kind, Spent, WorldState
from pancakes.supervision.task_core import TaskCore
from pancakes.task import Tick, every

_IR_RAYS = 3
_SONAR_RAYS = 5
_IR_MAX_RAW = 4095  # its converter has 12 bits


@cache
def _fan(ring: IrRing | SonarRing, rays: int, limit_m: float) -> Fan:
    return Fan(ring.sensors, ring.cone_rad, rays, limit_m)


@cache
def _laser_fan(laser: LaserScanner) -> Fan:
    return Fan(laser.sensors, 0.0, 1, laser.max_range_m)


class Senses:
    """Read the sensors of the bodies in an arena, at the moment they are asked.

    Args:
        arena: where the bodies are.
        noise: how far the sensors are off.
        random: draws the noise, and nothing else.
    """

    def __init__(self, arena: Arena, noise: NoiseSettings, random: random.Random) -> None:
        self._arena = arena
        self._noise = noise
        self._normal = random.gauss

    def battery(self, robot: Robot, noise_v: float) -> Battery:
        """Measure a robot's battery."""
        voltage_v = robot.battery.voltage_v + noise_v * self._normal()
        return Battery(voltage_v, robot.battery.level_at(voltage_v), robot.battery.charging)

    def infrared(self, robot: Robot) -> Infrared:
        """Ask a robot's infrared ring. Distances come from the raw values, noise and rounding included.

        Raises:
            PancakesError: robots of this kind have none.
        """
        ring = robot.infrared_ring()
        normal, curve = self._normal, ring.curve
        ir_share, ir_raw = self._noise.ir_share, self._noise.ir_raw
        fan = _fan(ring, _IR_RAYS, curve.farthest_m)
        raw = []
        for distance_m in self._arena.ranges(robot.disc, fan):
            noisy = ir_raw * normal()
            if distance_m < math.inf:
                noisy += curve.raw(distance_m) * (1.0 + ir_share * normal())
            raw.append(round(noisy) if 0.0 < noisy < _IR_MAX_RAW else 0 if noisy < 1.0 else _IR_MAX_RAW)
        return Infrared(fan.bearings_rad, tuple(map(curve.distance, raw)), curve.farthest_m, tuple(raw))

    def sonar(self, robot: Robot) -> Sonar:
        """Ask a robot's sonar ring.

        Raises:
            PancakesError: robots of this kind have none.
        """
        ring = robot.sonar_ring()
        limit_m, sonar_m, normal = ring.max_range_m, self._noise.sonar_m, self._normal
        fan = _fan(ring, _SONAR_RAYS, limit_m)
        ranges_m = []
        for distance_m in self._arena.ranges(robot.disc, fan):
            if distance_m < math.inf:
                distance_m += sonar_m * normal()
            ranges_m.append(0.0 if distance_m < 0.0 else distance_m if distance_m < limit_m else limit_m)
        return Sonar(fan.bearings_rad, tuple(ranges_m), limit_m)

    def laser(self, robot: Robot) -> LaserScan:
        """Ask a robot's laser scanner.

        Raises:
            PancakesError: robots of this kind have none.
        """
        laser = robot.laser_scanner()
        laser_m, normal = self._noise.laser_m, self._normal
        ranges_m = [
            max(0.0, distance_m + laser_m * normal()) if distance_m < math.inf else math.inf
            for distance_m in self._arena.ranges(robot.disc, _laser_fan(laser))
        ]
        return LaserScan.of(laser.start_rad, laser.step_rad, ranges_m, laser.max_range_m)

    def encoders(self, robot: Robot) -> Encoders:
        """Ask the encoders of a robot's wheels.

        Raises:
            PancakesError: robots of this kind have none.
        """
        encoders, (left_m, right_m) = robot.wheel_encoders(), robot.turned_m()
        radius_m = encoders.wheel_radius_m
        angles_rad = (encoders.angle_rad(left_m), encoders.angle_rad(right_m))
        speeds_radps = (robot.wheels.left_mps / radius_m, robot.wheels.right_mps / radius_m)
        return Encoders(("left", "right"), angles_rad, speeds_radps)

    def motion(self, sensor: SensorNode, discs: Sequence[Disc]) -> Motion:
        """Ask a motion sensor which of some discs move in its field of view."""
        moving = [(*disc.position, math.hypot(*disc.velocity)) for disc in discs]
        place = (*sensor.disc.position, sensor.disc.theta_rad)
        return sensed_motion(sensor.motion, place, moving, self._normal)


_T = TypeVar("_T")

STEP_S: Final = 0.01
"""The step of the simulation."""

_LOOK_STEPS = round(DECIDE_EVERY_S / STEP_S)
_WALKER_KG = 70.0


class Physics:
    """A world with everything that its settings put into it.

    Args:
        settings: its contents.
        random: all that is drawn is drawn from this.
    """

    def __init__(self, settings: ContentSettings, random: random.Random) -> None:
        self._settings = settings
        # One source for each purpose: the mover's way must not depend on how often a sensor was asked.
        self._start_random = _branch(random)
        self._wheel_normal = _branch(random).gauss
        self._walk_random = _branch(random)
        self._arena = Arena(settings.arena.width_m, settings.arena.height_m)
        self._senses = Senses(self._arena, settings.noise, _branch(random))
        self._robots: dict[str, Robot] = {}
        self._sensors: dict[str, SensorNode] = {}
        self._standing: list[BodyState] = []  # of the sensors, which never move
        self._walkers: dict[str, Walker] = {}
        self._docks = Docks(settings.docks)
        self._outside: dict[str, bool] = {}
        self._incidents: list[Incident] = []
        self._steps = 0
        self._fill()
        bodies: dict[str, Robot | SensorNode | Walker] = {**self._robots, **self._sensors, **self._walkers}
        self._discs = {name: body.disc for name, body in bodies.items()}

    def _fill(self) -> None:
        draw = self._start_random.uniform
        for name, robot in self._settings.robots.items():
            model = robot_model(robot.model)
            disc = self._arena.add(
                name,
                robot.x_m + draw(-robot.spread_m, robot.spread_m),
                robot.y_m + draw(-robot.spread_m, robot.spread_m),
                robot.theta_rad + draw(-robot.spread_rad, robot.spread_rad),
                model.radius_m,
                model.mass_kg,
            )
            battery = BatteryModel(robot.battery, model.full_v, model.empty_v)
            self._robots[name] = Robot(model, disc, battery, self._settings.noise.wheel, self._wheel_normal)
        for name, sensor in self._settings.sensors.items():
            disc = self._arena.add(name, sensor.x_m, sensor.y_m, sensor.theta_rad, sensor.radius_m)
            self._sensors[name] = SensorNode(disc, sensor.motion)
            self._standing.append(_body_state(disc, "sensor"))
        for name, walker in self._settings.movers.items():
            disc = self._arena.add(name, walker.x_m, walker.y_m, 0.0, walker.radius_m, _WALKER_KG)
            disc.walk(0.0, 0.0)
            way = Wayfinder(walker, self._arena.half_width_m, self._arena.half_height_m, _branch(self._walk_random))
            standing = [
                _obstacle(sensor.disc, max(walker.keep_out_m, walker.radius_m + sensor.disc.radius_m))
                for sensor in self._sensors.values()
            ]
            self._walkers[name] = Walker(disc, way, walker, standing)

    @property
    def time_s(self) -> float:
        """Mission time up to which it has advanced."""
        return self._steps * STEP_S

    def advance(self, to_s: float) -> None:
        """Advance in whole steps until the next would lie beyond `to_s`. Never goes back."""
        last_step = math.floor((to_s + EARLY_S) / STEP_S)
        while self._steps < last_step:
            self._go(last_step)

    def _go(self, last_step: int) -> None:
        """Advance by as many steps as no command begins or ends in, up to `last_step`."""
        steps = self._steps
        time_s = steps * STEP_S
        if steps % _LOOK_STEPS == 0:
            for walker in self._walkers.values():
                self._look(walker, time_s)
        changes_s = math.inf
        for robot in self._robots.values():
            good_until_s = robot.before_step(time_s)
            if good_until_s < changes_s:
                changes_s = good_until_s
        until = min(last_step, steps - steps % _LOOK_STEPS + _LOOK_STEPS)
        while until - 1 > steps and (until - 1) * STEP_S >= changes_s:
            until -= 1
        self._arena.step((steps + 1) * STEP_S, STEP_S, until - steps)
        for robot in self._robots.values():
            robot.rolls(until - steps, STEP_S)
        self._steps = until
        if until % _LOOK_STEPS == 0:
            for robot in self._robots.values():
                robot.settle(DECIDE_EVERY_S)
            self._docks.settle(self.time_s, DECIDE_EVERY_S, self._robots)
            self._watch_bounds()

    def _look(self, walker: Walker, time_s: float) -> None:
        settings = walker.settings
        robots = [
            _obstacle(robot.disc, settings.radius_m + robot.model.radius_m + settings.clearance_m)
            for robot in self._robots.values()
        ]
        fixed = list(walker.standing)
        fixed += [
            _obstacle(other.disc, settings.radius_m + 2 * other.disc.radius_m)
            for other in self._walkers.values()
            if other is not walker
        ]
        walker.disc.walk(*walker.wayfinder.decide(time_s, walker.disc.x_m, walker.disc.y_m, robots, fixed))

    def _watch_bounds(self) -> None:
        for name, robot in self._robots.items():
            outside = not self._arena.inside(robot.disc)
            if outside and not self._outside.get(name, False):
                self._incidents.append(Incident("out_of_bounds", self.time_s, (name,), *robot.disc.position))
            self._outside[name] = outside

    def drive(self, name: str, wheels: Wheels, ttl_s: float, source: str) -> None:
        """Let a robot's wheels run for the next `ttl_s` seconds, or until the next command.

        Args:
            name: the robot.
            wheels: how fast the wheels are to run.
            ttl_s: for how long the command is good, in mission seconds.
            source: address of the task that gave the command.

        Raises:
            PancakesError: there is no such robot, or one of the numbers is none.
        """
        numbers = (wheels.left_mps, wheels.right_mps, ttl_s)
        if not all(map(math.isfinite, numbers)):  # one of them would stop the whole world
            raise PancakesError(
                f"the wheels of {name} cannot run at {wheels.left_mps:g} and {wheels.right_mps:g} m/s for {ttl_s:g} s"
            )
        self._robot(name).drive(wheels, self.time_s + ttl_s, source)

    def hold(self, name: str) -> None:
        """Stop a robot's wheels, or release a dock.

        Raises:
            PancakesError: there is no such robot, nor such a dock.
        """
        if name in self._docks:
            self._docks.release(name)
        else:
            self._robot(name).hold()

    def dock(self, name: str, ttl_s: float, robot: str) -> None:
        """Hold a dock for a robot for the next `ttl_s` seconds, or until the next command.

        Raises:
            PancakesError: there is no such dock, or no such robot.
        """
        self._robot(robot)
        self._docks.hold(name, robot, self.time_s + ttl_s)

    def check(self, name: str, device_type: str, model: str = "") -> None:
        """Make sure that a body has a device of a type.

        Args:
            name: the body.
            device_type: the type of the device.
            model: for `motors`, the kind of robot that the device believes it drives.

        Raises:
            PancakesError: it has not, or it is a robot of another kind.
        """
        match device_type:
            case "motors":
                known = self._robot(name).model.name
                if model != known:
                    raise PancakesError(f"{name} is a {known} in the simulated world, its driver expects a {model!r}")
            case "pose":
                self._disc(name)
            case "battery":
                self._robot(name)
            case "ir":
                self._robot(name).infrared_ring()
            case "sonar":
                self._robot(name).sonar_ring()
            case "laser_scan":
                self._robot(name).laser_scanner()
            case "encoders":
                self._robot(name).wheel_encoders()
            case "motion":
                self._sensor(name)
            case "dock":
                self._docks.check(name)
            case _:
                raise PancakesError(f"the simulated world has no device of the type {device_type!r}")

    def sample(self, name: str, device_type: str) -> Any:
        """Ask a body's sensor, which takes from its battery.

        Returns:
            The reading, a body of the packet type `device_type`.

        Raises:
            PancakesError: there is no such body, or it has no such sensor.
        """
        match device_type:
            case "pose":
                disc = self._disc(name)
                reading: Any = Pose(*disc.position, disc.theta_rad)
            case "battery":
                reading = self._senses.battery(self._robot(name), self._settings.robots[name].battery.noise_v)
            case "ir":
                reading = self._senses.infrared(self._robot(name))
            case "sonar":
                reading = self._senses.sonar(self._robot(name))
            case "laser_scan":
                reading = self._senses.laser(self._robot(name))
            case "encoders":
                reading = self._senses.encoders(self._robot(name))
            case "motion":
                reading = self._senses.motion(self._sensor(name), self._moving_discs(name))
            case "dock_state":
                reading = self._docks.state(name)
            case _:
                raise PancakesError(f"the simulated world has no sensor of the type {device_type!r}")
        robot = self._robots.get(name)
        if robot is not None:
            robot.battery.sampled(device_type)
        return reading

    def packets_sent(self, name: str, total: int) -> None:
        """Take how many mission packets a robot's agent has sent so far, which drains its battery."""
        robot = self._robots.get(name)
        if robot is not None:
            robot.battery.packets_sent(total)

    def listens(self, name: str, listening: bool) -> None:
        """Take whether the radio of a robot's agent listens, which drains its battery."""
        robot = self._robots.get(name)
        if robot is not None:
            robot.battery.listening = listening

    def state(self) -> WorldState:
        """Return what all bodies do now."""
        bodies = [
            _body_state(robot.disc, "robot", robot.battery.voltage_v, robot.driven_by, robot.battery.spent)
            for robot in self._robots.values()
        ]
        bodies += self._standing
        bodies += [_body_state(walker.disc, "mover") for walker in self._walkers.values()]
        return WorldState(self.time_s, tuple(bodies))

    def take_incidents(self) -> list[Incident]:
        """Return the incidents since the last call, by time."""
        collisions = self._arena.take_collisions()
        if not collisions and not self._incidents:
            return []
        incidents, self._incidents = self._incidents, []
        return sorted([*incidents, *collisions], key=lambda incident: incident.time_s)

    def _robot(self, name: str) -> Robot:
        return _named(name, self._robots, "robot")

    def _sensor(self, name: str) -> SensorNode:
        return _named(name, self._sensors, "sensor node")

    def _moving_discs(self, sensor_name: str) -> list[Disc]:
        """Return what a motion sensor takes notice of, if it moves."""
        discs = [walker.disc for walker in self._walkers.values()]
        if self._sensor(sensor_name).motion.sees_robots:
            discs += [robot.disc for robot in self._robots.values()]
        return discs

    def _disc(self, name: str) -> Disc:
        return _named(name, self._discs, "body")


def _named(name: str, known: Mapping[str, _T], noun: str) -> _T:
    found = known.get(name)
    if found is None:
        raise PancakesError(f"the simulated world has no {noun} {name!r}, only {', '.join(known) or 'none'}")
    return found


def _branch(source: random.Random) -> random.Random:
    return random.Random(source.getrandbits(64))


def _obstacle(disc: Disc, distance_m: float) -> Obstacle:
    return Obstacle(disc.x_m, disc.y_m, disc.vx_mps, disc.vy_mps, distance_m)


def _body_state(
    disc: Disc, kind: Kind, battery_v: float | None = None, driven_by: str = "", spent: Spent | None = None
) -> BodyState:
    theta_rad, v_mps, omega_radps = disc.course()
    return BodyState(disc.name, kind, disc.x_m, disc.y_m, theta_rad, v_mps, omega_radps, battery_v, driven_by, spent)


class World(TaskCore, SimulatedWorld):
    """The simulated world.

    Publishes a `world_state` packet on `system` at exact multiples of its period in mission time, and the events
    `collision` and `out_of_bounds` on `log`.
    """

    @dataclass
    class Settings(ContentSettings):
        """The contents of the world, and its address. The contents are read once, when the task starts.

        Attributes:
            bus: address at which simulated devices reach it.
            state_hz: how often it publishes its state; a period must be a whole number of steps of 10 ms.
        """

        bus: str = "tcp://127.0.0.1:7499"
        state_hz: Positive = 20.0

        def __post_init__(self) -> None:
            ContentSettings.__post_init__(self)
            steps = 1.0 / (self.state_hz * STEP_S)
            if round(steps) < 1 or abs(steps - round(steps)) > 1e-6:
                raise ValueError(f"state_hz = {self.state_hz} gives a period that is no whole number of {STEP_S} s")

    settings: Settings

    def on_start(self) -> None:
        self._simulation = Physics(self.settings, self.random)
        self._state_steps = round(1.0 / (self.settings.state_hz * STEP_S))
        self._next_state_step = 0
        self._advanced_s = -1.0
        super().on_start()

    def truth(self) -> WorldState:
        return self._simulation.state()

    def initial_period_s(self, method: str, period_s: float) -> float:
        # Exactly when a state is due. A request in between lets the world go on to its moment.
        return super().initial_period_s(method, 1.0 / self.settings.state_hz)

    @every(hz=20)
    def follow_clock(self, tick: Tick) -> None:
        """Advance to the present."""
        self.advance()

    def advance(self) -> None:
        now = self.kernel.now  # not `self.now`, which only calls it: each request asks
        now_s = now()
        if now_s == self._advanced_s:
            return  # several ask at one moment, in virtual time nearly always
        self._advanced_s = now_s
        while self._next_state_step * STEP_S <= now_s + EARLY_S:
            self._simulation.advance(self._next_state_step * STEP_S)
            self.publish_truth()
            self._next_state_step += self._state_steps
        self._simulation.advance(now_s)
        for found in self._simulation.take_incidents():
            self.incident(found.kind, found.time_s, found.names, found.x_m, found.y_m)

    def check(self, body: str, device_type: str, model: str) -> None:
        self._simulation.check(body, device_type, model)

    def sample(self, body: str, device_type: str) -> Any:
        return self._simulation.sample(body, device_type)

    def drive(self, body: str, wheels: Wheels, ttl_s: float, source: str) -> None:
        self._simulation.drive(body, wheels, ttl_s, source)

    def act(self, body: str, device_type: str, command: Any, ttl_s: float, source: str) -> None:
        if not isinstance(command, Dock):
            super().act(body, device_type, command, ttl_s, source)
        # The robot is the agent that commands the dock: it cannot name another.
        self._simulation.dock(body, ttl_s, agent_of(source))

    def hold(self, body: str, device: str) -> None:
        self._simulation.hold(body)

    def radio(self, body: str, packets_sent: int | None, listening: bool | None) -> None:
        if packets_sent is not None:
            self._simulation.packets_sent(body, packets_sent)
        if listening is not None:
            self._simulation.listens(body, listening)
