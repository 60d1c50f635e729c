"""Learning environments for gymnasium (extra `gym`); importing this module registers them.

    import gymnasium
    import pancakes.gym

    environment = gymnasium.make("pancakes/DriveToGoal-v0")

In one step, also in a process that imports nothing else: `gymnasium.make("pancakes.gym:pancakes/DriveToGoal-v0")`.
An environment of your own works the same way: a task in the robot (`Pilot`) takes the action and keeps the readings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import msgspec
import numpy as np
import numpy.typing as npt

from pancakes.devices import Infrared, Pose
from pancakes.errors import needing_extra
from pancakes.packet import CTRL, SYSTEM, Packet, packet_type
from pancakes.sim.robot_models import KHEPERA_III, STILL, Wheels, robot_model
from pancakes.sim.world_state import BodyState
from pancakes.simulation.agent_handle import SimulationError
from pancakes.simulation.simulation import Simulation
from pancakes.task import Task, Tick, every, on

__all__ = ["DriveToGoal"]


@packet_type("simulation.wheels")
class WheelSpeeds(msgspec.Struct, frozen=True):
    """The speeds of a robot's wheels from now on.

    Attributes:
        left_mps: speed of the left wheel over the ground, forward.
        right_mps: speed of the right wheel.
    """

    left_mps: float
    right_mps: float


class Pilot(Task):
    """Drive at the newest `WheelSpeeds` on `ctrl`, until others come, and keep the newest readings.

    Attributes:
        pose: the newest pose; None: there is none yet.
        infrared: the newest sweep of the infrared ring; None: there is none yet.
    """

    requires = ("motors",)

    @dataclass
    class Settings:
        """Say which robot it drives.

        Attributes:
            model: the kind of robot.
        """

        model: str = "khepera3"

        def __post_init__(self) -> None:
            robot_model(self.model)  # an unknown one is a fault of the settings

    settings: Settings
    pose: Pose | None = None
    infrared: Infrared | None = None
    _wheels = STILL

    @on(CTRL, WheelSpeeds, queue="latest")
    def set_speeds(self, packet: Packet) -> None:
        """Drive at new speeds."""
        self._wheels = Wheels(packet.body.left_mps, packet.body.right_mps)
        self._drive()

    @every(hz=10)
    def repeat(self, tick: Tick) -> None:
        """Publish the speeds again: a command is good for half a second."""
        self._drive()

    def _drive(self) -> None:
        self.publish(CTRL, robot_model(self.settings.model).drive.twist(self._wheels))

    @on(SYSTEM, Pose, queue="latest")
    def keep_pose(self, packet: Packet) -> None:
        """Keep the newest pose."""
        self.pose = packet.body

    @on(SYSTEM, Infrared, queue="latest")
    def keep_infrared(self, packet: Packet) -> None:
        """Keep the newest sweep of the infrared ring."""
        self.infrared = packet.body


with needing_extra("no learning environment can be made"):
    import gymnasium

_TOP_MPS = KHEPERA_III.drive.max_wheel_mps
_POST_M = 0.06
_APART_M = 0.35
"""Start, goals and posts are drawn so far from each other and from the walls."""
_BUS = "tcp://world:7499"
_PIXELS_PER_M = 100
_FLOOR, _GOAL, _POST, _ROBOT, _NOSE = (
    np.array(colour, np.uint8)
    for colour in ((255, 255, 255), (120, 200, 120), (110, 110, 110), (60, 90, 200), (255, 200, 60))
)
_Floats = npt.NDArray[np.float32]


class DriveToGoal(gymnasium.Env[_Floats, _Floats]):
    """One robot in a walled arena, its goal, and posts in its way, all drawn from the seed.

    - **Action**: `float32[2]`, the speeds of the left and the right wheel over the ground in m/s, forward, each at most
      0.333 either way. They hold until the next step.
    - **Observation**: `float32[11]`, from the robot's own readings: where the goal is in the robot's frame, ahead and
      to the left, in m; then the ranges of its nine infrared sensors in m, the full range if one sees nothing.
    - **Reward**: metres that the robot came nearer to the goal, plus 1 at the goal, minus `collision_cost` for each
      contact that begins with a post or a wall.
    - **Ends**: terminated when its centre is within `goal_m` of the goal. `gymnasium.make` truncates after 600 steps.
    - **info**: `time_s` (mission time), `distance_m` (true distance to the goal), `collisions` (so far).

    Args:
        width_m: size of the arena along x.
        height_m: size along y.
        posts: how many posts stand about.
        goal_m: how near is near enough.
        step_s: seconds of simulated time for each step.
        collision_cost: see above.
        render_mode: `rgb_array`, a picture of the arena from above with 100 pixels for each metre; None: no pictures.

    Attributes:
        simulation: the simulation, to look at; the environment owns it.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        width_m: float = 3.0,
        height_m: float = 3.0,
        posts: int = 3,
        goal_m: float = 0.1,
        step_s: float = 0.1,
        collision_cost: float = 0.1,
        render_mode: str | None = None,
    ) -> None:
        if min(width_m, height_m) < 2.0 or not 0 <= posts <= 4 * width_m * height_m / 9:
            raise SimulationError(
                f"an arena of {width_m:g} m x {height_m:g} m with {posts} posts cannot be drawn: each side is 2 m or"
                " more, and there are at most four posts for each 9 m²"
            )
        if not step_s > 0.0 or not goal_m > 0.0:
            raise SimulationError(f"step_s = {step_s} and goal_m = {goal_m}: both must be more than 0")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise SimulationError(f"there is no render_mode {render_mode!r}, only 'rgb_array' and None")
        self.render_mode = render_mode
        self.simulation = Simulation()
        self._size_m = (width_m, height_m)
        self._posts = posts
        self._goal_m = goal_m
        self._step_s = step_s
        self._collision_cost = collision_cost
        self._goal = (0.0, 0.0)
        self._distance_m = 0.0
        self._collisions = 0
        ring = KHEPERA_III.ir
        assert ring is not None
        reach = math.hypot(width_m, height_m)
        ranges = len(ring.sensors)
        low = np.array([-reach, -reach] + [0.0] * ranges, np.float32)
        high = np.array([reach, reach] + [ring.curve.farthest_m] * ranges, np.float32)
        self.observation_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        self.action_space = gymnasium.spaces.Box(-_TOP_MPS, _TOP_MPS, (2,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[_Floats, dict[str, Any]]:
        """Draw an arena and start its agents.

        Args:
            seed: draws everything; None: the next arena of the series that the last seed began.
            options: none are known.
        """
        super().reset(seed=seed)
        start, self._goal, *posts = self._places(2 + self._posts)
        theta_rad = float(self.np_random.uniform(-math.pi, math.pi))
        room = {
            "bus": _BUS,
            "arena": {"width_m": self._size_m[0], "height_m": self._size_m[1]},
            "robots": {"robot": {"x_m": start[0], "y_m": start[1], "theta_rad": theta_rad, "spread_m": 0.0}},
            "sensors": {f"post{n}": {"x_m": x, "y_m": y, "radius_m": _POST_M} for n, (x, y) in enumerate(posts, 1)},
        }
        devices = {
            "motors": {"type": "sim.differential_drive", "settings": {"world": _BUS}},
            "pose": {"type": "sim.pose", "rate_hz": 20.0, "settings": {"world": _BUS}},
            "ir": {"type": "sim.ir", "rate_hz": 20.0, "settings": {"world": _BUS}},
        }
        self.simulation.add("world", tasks={"World": {"type": "sim.world", "settings": room}}, role="environment")
        self.simulation.add("robot", tasks={"Pilot": Pilot}, devices=devices)
        self.simulation.reset(int(self.np_random.integers(2**31)))
        if not self.simulation.step_until(self._has_readings, 5.0):
            raise SimulationError("the robot has no readings 5 s after its start")
        self._collisions = 0
        self._distance_m = self._distance()
        return self._observe(), self._info()

    def _places(self, count: int) -> list[tuple[float, float]]:
        """Draw places that are apart from each other and from the walls."""
        places: list[tuple[float, float]] = []
        half_x_m, half_y_m = (0.5 * size_m - _APART_M for size_m in self._size_m)
        for _ in range(10_000):
            x_m, y_m = (
                float(self.np_random.uniform(-half_x_m, half_x_m)),
                float(self.np_random.uniform(-half_y_m, half_y_m)),
            )
            if all(math.hypot(x_m - other_x, y_m - other_y) >= _APART_M for other_x, other_y in places):
                places.append((x_m, y_m))
                if len(places) == count:
                    return places
        raise SimulationError(
            f"no room for {count} places in an arena of {self._size_m[0]:g} m x {self._size_m[1]:g} m"
        )

    def step(self, action: _Floats) -> tuple[_Floats, float, bool, bool, dict[str, Any]]:
        """Let the wheels run at these speeds for `step_s`; see the class.

        Raises:
            SimulationError: the action is not two finite numbers, or the environment was not reset.
        """
        speeds = np.asarray(action, np.float64)
        if speeds.shape != (2,) or not np.isfinite(speeds).all():
            raise SimulationError(f"{action!r} is no action: it must be two wheel speeds in m/s, left and right")
        left_mps, right_mps = (float(speed) for speed in np.clip(speeds, -_TOP_MPS, _TOP_MPS))
        self.simulation.agents["robot"].publish(CTRL, WheelSpeeds(left_mps, right_mps))
        self.simulation.step(self._step_s)
        before_m, self._distance_m = self._distance_m, self._distance()
        bumped = len(self.simulation.agents["world"].events("collision"))
        reached = self._distance_m <= self._goal_m
        reward = before_m - self._distance_m + float(reached) - self._collision_cost * (bumped - self._collisions)
        self._collisions = bumped
        return self._observe(), reward, reached, False, self._info()

    def _has_readings(self) -> bool:
        pilot: Pilot = self.simulation.task("robot", "Pilot")
        return pilot.pose is not None and pilot.infrared is not None

    def _distance(self) -> float:
        robot = self.simulation.body("robot")
        return math.hypot(self._goal[0] - robot.x_m, self._goal[1] - robot.y_m)

    def _observe(self) -> _Floats:
        pilot: Pilot = self.simulation.task("robot", "Pilot")
        pose, infrared = pilot.pose, pilot.infrared
        assert pose is not None and infrared is not None
        dx_m, dy_m = self._goal[0] - pose.x_m, self._goal[1] - pose.y_m
        cos, sin = math.cos(pose.theta_rad), math.sin(pose.theta_rad)
        goal = (cos * dx_m + sin * dy_m, cos * dy_m - sin * dx_m)
        seen = np.array([*goal, *infrared.ranges_m], np.float32)
        return np.clip(seen, self.observation_space.low, self.observation_space.high)

    def _info(self) -> dict[str, Any]:
        return {
            "time_s": self.simulation.now_s,
            "distance_m": self._distance_m,
            "collisions": self._collisions,
        }

    def render(self) -> npt.NDArray[np.uint8] | None:
        """Return the arena from above, x to the right and y up: `uint8[height, width, 3]`.

        None without the render mode `rgb_array`.
        """
        if self.render_mode is None:
            return None
        width, height = (round(size_m * _PIXELS_PER_M) for size_m in self._size_m)
        picture = np.empty((height, width, 3), np.uint8)
        picture[:] = _FLOOR
        x_m = (np.arange(width) + 0.5) / _PIXELS_PER_M - 0.5 * self._size_m[0]
        y_m = 0.5 * self._size_m[1] - (np.arange(height) + 0.5) / _PIXELS_PER_M

        def disc(at_x_m: float, at_y_m: float, radius_m: float, colour: npt.NDArray[np.uint8]) -> None:
            picture[(x_m[None, :] - at_x_m) ** 2 + (y_m[:, None] - at_y_m) ** 2 <= radius_m**2] = colour

        disc(*self._goal, self._goal_m, _GOAL)
        for body in self.simulation.world().bodies:
            if body.kind == "sensor":
                disc(body.x_m, body.y_m, _POST_M, _POST)
            else:
                self._draw_robot(body, disc)
        return picture

    def _draw_robot(self, body: BodyState, disc: Any) -> None:
        radius_m = KHEPERA_III.radius_m
        disc(body.x_m, body.y_m, radius_m, _ROBOT)
        nose_m = 0.6 * radius_m
        ahead_x_m, ahead_y_m = nose_m * math.cos(body.theta_rad), nose_m * math.sin(body.theta_rad)
        disc(body.x_m + ahead_x_m, body.y_m + ahead_y_m, 0.3 * radius_m, _NOSE)

    def close(self) -> None:
        """End the simulation."""
        self.simulation.close()


with needing_extra("no learning environment can be made"):
    from gymnasium import register

register("pancakes/DriveToGoal-v0", entry_point="pancakes.gym:DriveToGoal", max_episode_steps=600)
