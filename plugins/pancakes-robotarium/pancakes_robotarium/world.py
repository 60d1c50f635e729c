"""`robotarium.world`: the Robotarium's own simulator as a world, on the hardware bus of every simulated world."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec

from pancakes import PancakesError, Tick, agent_of, every
from pancakes.devices import Battery, Dock, Infrared, Motion, Pose, Twist
from pancakes.worlds import (
    BatteryModel,
    BodyState,
    Disc,
    Docks,
    Fan,
    SimulatedWorld,
    Wheels,
    WorldState,
    robot_model,
    sensed_motion,
)
from pancakes_robotarium.gternal import RING
from pancakes_robotarium.laboratory import Laboratory, Place, simulator_version
from pancakes_robotarium.settings import Guest, RobotariumRobot, RobotariumSettings

STEP_S: Final = 0.033
"""The step of the Robotarium."""
EARLY_S: Final = 1e-6
"""A clock that reads this much less than a moment means that moment."""
RAYS: Final = 5
NEAR_M: Final = 0.05
"""So near to a waypoint a guest has reached it."""

_STILL: Final = Twist(0.0, 0.0)
_T = TypeVar("_T")


class Wheeled:
    """What one robot of the laboratory is told, and for how long.

    Args:
        name: what it is called.
        settings: what it is.

    Attributes:
        twist: its newest command, within the limits of its own wheels.
        driven_by: the task that gave it; empty in safe hold.
        battery: its battery; None: nobody needs one.
        position: where it is.
    """

    def __init__(self, name: str, settings: RobotariumRobot | Guest) -> None:
        self.name = name
        self.settings = settings
        self.model = robot_model(settings.model)
        self.twist = _STILL
        self.driven_by = ""
        self.battery: BatteryModel | None = None
        if isinstance(settings, RobotariumRobot):
            self.battery = BatteryModel(settings.battery, self.model.full_v, self.model.empty_v)
        self.position = (0.0, 0.0)
        self._until_s = math.inf
        self._goal = 0

    def drive(self, wheels: Wheels, until_s: float, source: str) -> None:
        """Follow a command until a moment of the mission."""
        self.twist = self.model.drive.twist(wheels)
        self._until_s, self.driven_by = until_s, source.rpartition("/")[2]

    def hold(self) -> None:
        """Stand still."""
        self.twist, self._until_s, self.driven_by = _STILL, math.inf, ""

    def before_step(self, time_s: float, place: Place) -> Twist:
        """Return what it is to do in the step that begins at `time_s`."""
        if isinstance(self.settings, Guest):
            self.twist = self._on_its_way(self.settings, place)
        elif self._until_s <= time_s or (self.battery is not None and self.battery.empty):
            self.hold()
        return self.twist

    def _on_its_way(self, guest: Guest, place: Place) -> Twist:
        if not guest.waypoints:
            return _STILL
        x_m, y_m = guest.waypoints[self._goal]
        if math.dist((x_m, y_m), (place.x_m, place.y_m)) < NEAR_M:
            self._goal = (self._goal + 1) % len(guest.waypoints)
            x_m, y_m = guest.waypoints[self._goal]
        bearing_rad = math.remainder(math.atan2(y_m - place.y_m, x_m - place.x_m) - place.theta_rad, math.tau)
        ahead = math.cos(bearing_rad) if abs(bearing_rad) < 0.5 * math.pi else 0.0
        return self.model.drive.twist(self.model.drive.wheels(Twist(guest.speed_mps * ahead, 2.0 * bearing_rad)))

    def rolled(self, done: Twist, step_s: float) -> None:
        """Drain the battery for a step in which it did this."""
        if self.battery is not None:
            half_turn_mps = 0.5 * self.model.drive.wheel_base_m * done.omega_radps
            rolled_mps = abs(done.v_mps - half_turn_mps) + abs(done.v_mps + half_turn_mps)
            self.battery.passed(step_s, rolled_mps * step_s)


class World(SimulatedWorld):
    """The Robotarium, simulated by Georgia Tech's own simulator, or the laboratory itself in its place.

    Publishes a `world_state` on `system` after each `state_steps` steps, the events `collision` and `out_of_bounds` by
    its own geometry, and the event `robotarium_verdict` with what its simulator's judge has counted, at the end.
    """

    blocking = True  # the simulator belongs to one thread, and its import takes a while

    @dataclass
    class Settings(RobotariumSettings):
        """The contents of the laboratory. They are read once, when the task starts."""

    settings: Settings
    _laboratory: Laboratory | None = None

    def on_start(self) -> None:
        settings = self.settings
        draw = self.random.uniform
        bodies: dict[str, RobotariumRobot | Guest] = {**settings.robots, **settings.movers}
        places = []
        for one in bodies.values():
            turn_rad = one.spread_rad if isinstance(one, RobotariumRobot) else 0.0
            places.append(
                Place(
                    one.x_m + draw(-one.spread_m, one.spread_m),
                    one.y_m + draw(-one.spread_m, one.spread_m),
                    one.theta_rad + draw(-turn_rad, turn_rad),
                )
            )
        self._robots = {name: Wheeled(name, one) for name, one in bodies.items()}
        self._laboratory = laboratory = Laboratory(places, self.random)
        self._discs = {
            name: Disc(name, robot.model.radius_m, 0.0, 0.0, 0.0, math.inf) for name, robot in self._robots.items()
        }
        self._docks = Docks(settings.docks, "the Robotarium")
        self._posts = {
            name: Disc(name, one.radius_m, one.x_m, one.y_m, one.theta_rad, math.inf)
            for name, one in settings.sensors.items()
        }
        self._fan = Fan(RING.sensors, RING.cone_rad, RAYS, RING.max_range_m)
        self._steps = 0
        self._ongoing: set[tuple[str, ...]] = set()
        self._lost: frozenset[str] = frozenset()
        self._place_discs(laboratory)
        super().on_start()
        self.publish_truth()
        # Each request lets it catch up, so the steps between two states need no ticks of their own. Its timer is made
        # after this.
        self.call(lambda: self.reschedule(1.0 / (settings.state_steps * laboratory.step_s)))

    def on_stop(self) -> None:
        super().on_stop()
        self._end()

    def on_failure(self, *error: Any) -> None:
        super().on_failure(*error)
        self._end()

    def _end(self) -> None:
        """End the experiment, and write down what the judge of its simulator says."""
        laboratory, self._laboratory = self._laboratory, None
        if laboratory is None:
            return
        said, counts = laboratory.end(), laboratory.counts()
        counted: dict[str, int] | None = msgspec.to_builtins(counts)
        verdict = {"rps": simulator_version(), "counts": counted, "said": said}
        self.event("robotarium_verdict", **(counted or {}), said=said)
        path = Path(self.settings.path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(verdict, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            self.log("error", f"the verdict of the Robotarium's simulator is not in {path}: {error.strerror}")

    @property
    def _now(self) -> Laboratory:
        if self._laboratory is None:
            raise PancakesError("the experiment in the Robotarium has ended")
        return self._laboratory

    # Time --------------------------------------------------------------------------------------------------------

    @every(hz=1.0 / STEP_S)
    def follow_clock(self, tick: Tick) -> None:
        """Advance to the present."""
        self.advance()

    def advance(self) -> None:
        laboratory, now_s = self._now, self.now()
        while (self._steps + 1) * laboratory.step_s <= now_s + EARLY_S:
            self._step(laboratory)

    def _step(self, laboratory: Laboratory) -> None:
        time_s = self._steps * laboratory.step_s
        robots = self._robots.values()
        laboratory.step(
            [robot.before_step(time_s, place) for robot, place in zip(robots, laboratory.places, strict=True)]
        )
        self._steps += 1
        for robot, done in zip(robots, laboratory.twists, strict=True):
            robot.rolled(done, laboratory.step_s)
        self._place_discs(laboratory)
        self._docks.settle(self._steps * laboratory.step_s, laboratory.step_s, self._robots)
        self._watch(laboratory)
        if self._steps % self.settings.state_steps == 0:
            self.publish_truth()

    def _place_discs(self, laboratory: Laboratory) -> None:
        if laboratory.unseen or self._lost:
            lost = frozenset(name for number, name in enumerate(self._robots) if number in laboratory.unseen)
            for name in sorted(lost - self._lost):
                self.log("warning", f"the Robotarium does not see {name}: it has no pose until it does")
            self._lost = lost
        for robot, disc, place in zip(self._robots.values(), self._discs.values(), laboratory.places, strict=True):
            robot.position = (place.x_m, place.y_m)
            disc.moved(place.x_m, place.y_m, place.theta_rad, 0.0, 0.0, 0.0)

    def _watch(self, laboratory: Laboratory) -> None:
        """Report what begins: two bodies that touch, and a robot of which a part is outside the arena."""
        arena = self.settings.arena
        half_x_m, half_y_m = 0.5 * arena.width_m, 0.5 * arena.height_m
        found: set[tuple[str, ...]] = set()
        rest = [(it.x_m, it.y_m, it.radius_m, it.name) for it in (*self._discs.values(), *self._posts.values())]
        for place in range(len(self._discs)):  # plain numbers: this is done in each step, for each pair
            x_m, y_m, radius_m, name = rest[place]
            if abs(x_m) + radius_m > half_x_m or abs(y_m) + radius_m > half_y_m:
                found.add((name,))
            for other_x_m, other_y_m, other_m, other in rest[place + 1 :]:
                apart_x_m, apart_y_m, touch_m = other_x_m - x_m, other_y_m - y_m, radius_m + other_m
                if apart_x_m * apart_x_m + apart_y_m * apart_y_m <= touch_m * touch_m:
                    found.add((name, other))
        for names in sorted(found - self._ongoing):
            kind = "collision" if len(names) > 1 else "out_of_bounds"
            self.incident(kind, self._steps * laboratory.step_s, names, *self._discs[names[0]].position)
        self._ongoing = found

    # Devices -----------------------------------------------------------------------------------------------------

    def truth(self) -> WorldState:
        laboratory = self._now
        bodies = []
        for robot, place, done in zip(self._robots.values(), laboratory.places, laboratory.twists, strict=True):
            battery = robot.battery
            bodies.append(
                BodyState(
                    robot.name,
                    "robot" if battery is not None else "mover",
                    place.x_m,
                    place.y_m,
                    place.theta_rad,
                    done.v_mps,
                    done.omega_radps,
                    battery.voltage_v if battery is not None else None,
                    robot.driven_by,
                    battery.spent if battery is not None else None,
                )
            )
        count = len(self.settings.robots)
        posts = [BodyState(it.name, "sensor", it.x_m, it.y_m, it.theta_rad, 0.0, 0.0) for it in self._posts.values()]
        # Robots, then sensor nodes, then movers, as every world has them.
        return WorldState(self._steps * laboratory.step_s, (*bodies[:count], *posts, *bodies[count:]))

    def check(self, body: str, device_type: str, model: str) -> None:
        match device_type:
            case "motors":
                known = self._robot(body).model.name
                if model != known:
                    raise PancakesError(f"{body} is a {known} in the Robotarium, its driver expects a {model!r}")
            case "battery" | "ir":
                self._robot(body)
            case "motion":
                _named(body, self.settings.sensors, "sensor node")
            case "pose":
                _named(body, {**self._discs, **self._posts}, "body")
            case "dock" | "dock_state":
                self._docks.check(body)
            case _:
                raise PancakesError(f"nothing in the Robotarium has a device of the type {device_type!r}")

    def sample(self, body: str, device_type: str) -> Any:
        self.check(body, device_type, "")
        match device_type:
            case "pose":
                if body in self._lost:
                    raise PancakesError(f"the Robotarium does not see {body} now")
                disc = self._discs.get(body) or self._posts[body]
                reading: Any = Pose(disc.x_m, disc.y_m, disc.theta_rad)
            case "battery":
                reading = self._measured_battery(self._robot(body))
            case "ir":
                reading = self._ranges(body)
            case "dock_state":
                reading = self._docks.state(body)
            case _:
                reading = self._motion(body)
        robot = self._robots.get(body)
        if robot is not None and robot.battery is not None:
            robot.battery.sampled(device_type)
        return reading

    def drive(self, body: str, wheels: Wheels, ttl_s: float, source: str) -> None:
        robot = self._robot(body)
        if not all(map(math.isfinite, (wheels.left_mps, wheels.right_mps, ttl_s))):
            raise PancakesError(
                f"the wheels of {body} cannot run at {wheels.left_mps:g} and {wheels.right_mps:g} m/s for {ttl_s:g} s"
            )
        if robot.battery is not None and not robot.battery.empty:
            robot.drive(wheels, self.now() + ttl_s, source)

    def act(self, body: str, device_type: str, command: Any, ttl_s: float, source: str) -> None:
        if not isinstance(command, Dock):
            super().act(body, device_type, command, ttl_s, source)
        # The robot is the agent that commands the dock: it cannot name another.
        self._robot(agent_of(source))
        self._docks.hold(body, agent_of(source), self.now() + ttl_s)

    def hold(self, body: str, device: str) -> None:
        if body in self._docks:
            self._docks.release(body)
        else:
            self._robot(body).hold()

    def radio(self, body: str, packets_sent: int | None, listening: bool | None) -> None:
        robot = self._robots.get(body)
        if robot is None or robot.battery is None:
            return
        if packets_sent is not None:
            robot.battery.packets_sent(packets_sent)
        if listening is not None:
            robot.battery.listening = listening

    def _robot(self, name: str) -> Wheeled:
        _named(name, self.settings.robots, "robot that agents drive")
        return self._robots[name]

    def _measured_battery(self, robot: Wheeled) -> Battery:
        assert robot.battery is not None and isinstance(robot.settings, RobotariumRobot)
        voltage_v = robot.battery.voltage_v + robot.settings.battery.noise_v * self.random.gauss(0.0, 1.0)
        return Battery(voltage_v, robot.battery.level_at(voltage_v), robot.battery.charging)

    def _ranges(self, name: str) -> Infrared:
        """Measure with the ring of a robot: by the simulator if it has range sensors, else by geometry."""
        far_m = RING.max_range_m
        measured = self._now.ranges()
        if measured is not None:
            row = measured[list(self._robots).index(name)]
            # NaN is no measurement; less than 0 is nothing seen, or a failure, which it does not tell apart.
            seen = [(bearing, m) for bearing, m in zip(self._fan.bearings_rad, row, strict=True) if not math.isnan(m)]
            ranges_m = tuple(far_m if m < 0.0 else min(m, far_m) for _, m in seen)
            return Infrared(tuple(bearing for bearing, _ in seen), ranges_m, far_m)
        others = (*self._discs.values(), *self._posts.values())
        found = []
        for range_m in self._fan.ranges(self._discs[name], others, math.inf, math.inf):  # its floor has no walls
            if range_m < math.inf:
                range_m *= 1.0 + self.settings.range_noise * self.random.gauss(0.0, 1.0)
            found.append(min(max(range_m, 0.0), far_m))
        return Infrared(self._fan.bearings_rad, tuple(found), far_m)

    def _motion(self, name: str) -> Motion:
        sensor = self.settings.sensors[name]
        moving = []
        for robot, place, done in zip(self._robots.values(), self._now.places, self._now.twists, strict=True):
            if robot.battery is None or sensor.motion.sees_robots:
                moving.append((place.x_m, place.y_m, abs(done.v_mps)))
        place_of = (sensor.x_m, sensor.y_m, sensor.theta_rad)
        return sensed_motion(sensor.motion, place_of, moving, lambda: self.random.gauss(0.0, 1.0))


def _named(name: str, known: Mapping[str, _T], noun: str) -> _T:
    found = known.get(name)
    if found is None:
        raise PancakesError(f"the Robotarium has no {noun} {name!r}, only {', '.join(known) or 'none'}")
    return found
