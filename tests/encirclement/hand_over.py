"""The dangerous minute: the robot that was relieved drives home while the other comes to the circle.

Where on the circle the hand-over happens is chance. By the laws only, one robot or the other runs into something
in every seventh phase or so; with `Steering`, in none of hundreds.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable
from dataclasses import dataclass

from pancakes.devices import Pose, Twist
from pancakes.sim.bodies import ArenaSettings, ContentSettings, RobotSettings, SensorSettings
from pancakes.sim.pedestrian import MoverSettings
from pancakes.sim.robot_models import robot_model
from pancakes.sim.world import Physics
from pancakes_encirclement.angles import wrap
from pancakes_encirclement.avoidance import Avoidance
from pancakes_encirclement.circle import curvature
from pancakes_encirclement.homing import Homing
from pancakes_encirclement.steering import Steering


@dataclass(frozen=True)
class Stage:
    """Robots of one kind, and the arena that suits them."""

    model: str
    radius_m: float
    speed_mps: float
    alpha_per_m: float
    homes: tuple[tuple[float, float], tuple[float, float]]
    arena_m: tuple[float, float]
    mover: MoverSettings
    avoidance: Avoidance
    homing: Homing


KHEPERA = Stage(
    model="khepera3",
    radius_m=0.55,
    speed_mps=0.1,
    alpha_per_m=4.0,
    homes=((1.4, 1.0), (1.4, -1.0)),
    arena_m=(4.0, 3.0),
    mover=MoverSettings(x_m=-1.6, y_m=0.9, keep_out_m=0.95),
    avoidance=Avoidance(),
    homing=Homing(),
)
PIONEER = Stage(
    model="pioneer3dx",
    radius_m=1.2,
    speed_mps=0.3,
    alpha_per_m=2.0,
    homes=((3.0, 2.2), (3.0, -2.2)),
    arena_m=(9.0, 7.0),
    mover=MoverSettings(x_m=-3.8, y_m=2.8, radius_m=0.2, clearance_m=0.8, keep_out_m=2.4),
    avoidance=Avoidance(body_radius_m=0.2275, clearance_m=0.15, look_ahead_m=0.6),
    homing=Homing(speed_mps=0.3, turn_radps=0.5),
)
PERIOD_S = 0.1
LONGEST_S = 150.0


class HandOver:
    """One hand-over: `agent1` leaves a circle that `agent2` comes to."""

    def __init__(self, stage: Stage, seed: int, looks: bool) -> None:
        self.stage = stage
        self.looks = looks
        self.random = random.Random(seed)
        phase = self.random.uniform(0.0, 2.0 * math.pi)
        x_m, y_m = stage.radius_m * math.cos(phase), stage.radius_m * math.sin(phase)
        on_circle = RobotSettings(x_m, y_m, wrap(phase - math.pi / 2), stage.model)
        (_, (home_x_m, home_y_m)) = stage.homes
        waiting = RobotSettings(home_x_m, home_y_m, math.atan2(-home_y_m, -home_x_m), stage.model)
        self.world = Physics(
            ContentSettings(
                arena=ArenaSettings(*stage.arena_m),
                robots={"agent1": on_circle, "agent2": waiting},
                sensors={"sensor": SensorSettings()},
                movers={"mover": stage.mover},
            ),
            self.random,
        )
        self.model = robot_model(stage.model)
        self.steering = {name: Steering(stage.avoidance) for name in ("agent1", "agent2")}
        self.parked = False

    def run(self) -> list[str]:
        """Runs until one robot is home and the other has been on the circle for a while; returns what went wrong."""
        trouble: list[str] = []
        on_circle_s = 0.0
        for step in range(round(LONGEST_S / PERIOD_S)):
            now_s = step * PERIOD_S
            self.world.advance(now_s)
            for name, steering in self.steering.items():
                pose = self.pose(name)
                steering.moved(pose)
                if self.looks:
                    self.look(name, step, now_s)
                twist = self.home(pose, now_s) if name == "agent1" else self.circle(pose, now_s)
                self.world.drive(name, self.model.drive.wheels(twist), 0.5, f"{name}/client/Test")
            trouble += [" with ".join(happening.names) for happening in self.world.take_incidents()]
            pose = self.world.sample("agent2", "pose")
            near = abs(math.hypot(pose.x_m, pose.y_m) - self.stage.radius_m) < 0.1 * self.stage.radius_m
            on_circle_s = on_circle_s + PERIOD_S if near else 0.0
            if self.parked and on_circle_s > 3.0:
                return trouble
        return [*trouble, "one of them never came to where it should"]

    def pose(self, name: str) -> Pose:
        true = self.world.sample(name, "pose")
        noise = self.random.gauss
        return Pose(true.x_m + noise(0, 0.002), true.y_m + noise(0, 0.002), wrap(true.theta_rad + noise(0, 0.009)))

    def look(self, name: str, step: int, now_s: float) -> None:
        for kind, every in (("ir", 1), ("sonar", 2)):
            if step % every == 0 and getattr(self.model, kind) is not None:
                ring = self.world.sample(name, kind)
                self.steering[name].sweep(ring.bearings_rad, ring.ranges_m, ring.max_range_m, now_s)

    def home(self, pose: Pose, now_s: float) -> Twist:
        dx_m, dy_m = self.stage.homes[0][0] - pose.x_m, self.stage.homes[0][1] - pose.y_m
        distance = math.hypot(dx_m, dy_m)
        self.parked = self.parked or distance < 0.02
        if self.parked:
            return Twist(0.0, 0.0)
        bearing = wrap(math.atan2(dy_m, dx_m) - pose.theta_rad)
        return self.steering["agent1"].drive_to(bearing, distance, self.stage.homing, now_s)

    def circle(self, pose: Pose, now_s: float) -> Twist:
        stage = self.stage
        kappa = curvature((pose.x_m, pose.y_m), pose.theta_rad, (0.0, 0.0), stage.radius_m, stage.alpha_per_m)
        return self.steering["agent2"].follow(Twist(stage.speed_mps, stage.speed_mps * kappa), now_s)


def trouble_of(stage: Stage, seeds: Iterable[int]) -> dict[int, list[str]]:
    """Runs a hand-over for each seed; returns what went wrong, by seed."""
    return {seed: found for seed in seeds if (found := HandOver(stage, seed, looks=True).run())}
