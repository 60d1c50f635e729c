"""The tracker of a simulated world, and robots in it that are commanded at what it tells of."""

from __future__ import annotations

import math
from typing import Any

from pancakes.devices import Pose, RobotPose, Twist
from pancakes.simulation import Simulation
from pancakes.task import Task, on
from pancakes.testing import Fleet

BUS = "tcp://world:7499"
BARRIER = {"radius_m": 0.065, "max_mps": 0.3, "max_radps": 2.2}
REACH_M = 0.065 + 0.1


class Chase(Task):
    """Drives at the mover, as fast as it can."""

    requires = ("pose", "motors")

    def on_start(self) -> None:
        self.goal = (0.0, 0.0)

    @on("system")
    def told(self, other: RobotPose) -> None:
        if other.robot == "mover":
            self.goal = (other.x_m, other.y_m)

    @on("system", queue="latest")
    def located(self, pose: Pose) -> None:
        ahead_m, left_m = self.goal[0] - pose.x_m, self.goal[1] - pose.y_m
        turn_rad = math.remainder(math.atan2(left_m, ahead_m) - pose.theta_rad, math.tau)
        self.publish("ctrl", Twist(0.3 * max(0.0, math.cos(turn_rad)), 2.0 * turn_rad))


def nearest_m(filters: dict[str, Any], tracked: dict[str, Any]) -> tuple[float, Simulation]:
    simulation = Simulation()
    robots = {"robot1": {"x_m": -0.9, "y_m": 0.0}, "robot2": {"x_m": 0.9, "y_m": 0.3}}
    world = {"bus": BUS, "robots": robots, "movers": {"mover": {"x_m": 0.0, "y_m": 0.9, "radius_m": 0.1}}}
    tasks = {
        "World": {"type": "sim.world", "settings": world},
        "Tracker": {"type": "sim.tracker", "settings": {"bodies": tracked}},
    }
    simulation.add("world", tasks=tasks)
    devices = {
        "pose": {"type": "sim.pose", "rate_hz": 15, "settings": {"world": BUS}},
        "motors": {"type": "sim.differential_drive", "settings": {"world": BUS}},
    }
    for name in robots:
        simulation.add(name, tasks={"Chase": Chase}, devices=devices, filters=filters)
    simulation.reset(seed=2)
    least_m = math.inf
    for _ in range(200):
        simulation.step(0.1)
        bodies = [simulation.body(name) for name in (*robots, "mover")]
        for index, one in enumerate(bodies):
            for other in bodies[:index]:
                gap_m = math.hypot(one.x_m - other.x_m, one.y_m - other.y_m)
                least_m = min(least_m, gap_m - (REACH_M if "mover" in (one.name, other.name) else 0.13))
    return least_m, simulation


def test_robots_keep_clear_of_what_the_tracker_tells():
    tracked = {"mover": {"radius_m": 0.1, "max_mps": 0.3}}
    apart = {"apart": {"type": "barrier", "device": "motors", "settings": BARRIER}}
    least_m, simulation = nearest_m(apart, tracked)
    told = {it["reason"] for it in simulation.agents["robot1"].events("command_filtered")}
    simulation.close()
    assert least_m > 0.02 and "keeps clear of mover" in told
    least_m, simulation = nearest_m({}, tracked)
    simulation.close()
    assert least_m < 0.005, "without the barrier they touch"


def test_tracker_names_what_the_world_has_not():
    _, simulation = nearest_m({}, {"walker": {"radius_m": 0.1, "max_mps": 0.3}})
    (line,) = simulation.agents["world"].lines("error")
    simulation.close()
    assert line == "the tracker is to tell of walker, which the world has not"


def test_tracker_tells_only_of_robots_that_have_died_if_it_shall() -> None:
    with Fleet(1) as fleet:
        bodies = {name: {"radius_m": 0.07, "max_mps": 0.0} for name in ("robot1", "robot2")}
        robots = {"robot1": {"x_m": -0.9, "y_m": 0.0}, "robot2": {"x_m": 0.9, "y_m": 0.0}}
        tasks = {
            "World": {"type": "sim.world", "settings": {"bus": BUS, "robots": robots}},
            "Tracker": {"type": "sim.tracker", "settings": {"bodies": bodies, "only_unlinked": True}},
        }
        fleet.start("world", tasks=tasks, role="environment")
        robot = fleet.start("robot1")
        fleet.start("robot2")
        fleet.connect()
        fleet.run_for(1.0)
        before = len(robot.probe.packets(RobotPose))
        fleet.run_for(1.0)
        assert len(robot.probe.packets(RobotPose)) == before, "all are there"
        fleet.crash("robot2")
        fleet.run_for(1.0)
        told = robot.probe.packets(RobotPose)[before:]
        assert len(told) >= 8 and {it.body.robot for it in told} == {"robot2"}
        fleet.restart("robot2")
        fleet.run_for(2.0)
        before = len(robot.probe.packets(RobotPose))
        fleet.run_for(1.0)
        assert len(robot.probe.packets(RobotPose)) == before, "it is back"
