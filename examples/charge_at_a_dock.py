"""Keep a task served while robots charge: it leaves a robot that has just enough energy to get to a dock.

Two robots share one dock. `energy.reserve` measures how long a robot can go on and still reach the dock. The rule of
`Patrol` watches that. The robot that gives the task away starts `Charge`: it asks for the dock, drives there, and goes
back home once it is charged.

$ python examples/charge_at_a_dock.py
0 s: robot1 patrols
99 s: robot2 patrols
102 s: robot1 takes dock1, with a reserve of 28 s
123 s: robot1 is docked, its battery is at 18%
138 s: robot1 is charged, its battery is at 95%
151 s: robot1 patrols
154 s: robot2 takes dock1, with a reserve of 29 s
176 s: robot2 is docked, its battery is at 22%
192 s: robot2 is charged, its battery is at 99%
"""

import math
from dataclasses import dataclass
from typing import Any

from pancakes import CTRL, SYSTEM, Simulation, Task, on
from pancakes.devices import Pose, Twist
from pancakes.events import Event

BUS = "tcp://world:7499"
HOMES = {"robot1": (-0.6, -0.8), "robot2": (0.6, -0.8)}
RULE = {"when": "reserve", "below": 30, "cost": "reserve", "then": "Charge", "otherwise": "Charge"}


@dataclass
class PatrolState:
    goal_m: float = 1.0


class Patrol(Task[None, PatrolState]):
    """Drives to and fro between two places."""

    requires = ("pose", "motors")

    @on(SYSTEM, queue="latest")
    def located(self, pose: Pose) -> None:
        if abs(self.state.goal_m - pose.x_m) < 0.05:
            self.state.goal_m = -self.state.goal_m
        ahead_m, left_m = self.state.goal_m - pose.x_m, 0.5 - pose.y_m
        turn_rad = math.remainder(math.atan2(left_m, ahead_m) - pose.theta_rad, math.tau)
        self.publish(CTRL, Twist(0.1 * max(0.0, math.cos(turn_rad)), turn_rad))


there = {"world": BUS}
devices = {
    "pose": {"type": "sim.pose", "rate_hz": 10, "settings": there},
    "motors": {"type": "sim.differential_drive", "settings": there},
    "battery": {"type": "sim.battery", "rate_hz": 1, "settings": there},
    "docks": {"type": "network.dock"},
}
battery = {"capacity_j": 400.0, "level": 0.6}
robots = {name: {"x_m": x_m, "y_m": y_m, "battery": battery} for name, (x_m, y_m) in HOMES.items()}
world = {"bus": BUS, "robots": robots, "docks": {"dock1": {"x_m": 0.0, "y_m": -1.2}}}
dock = {"type": "sim.dock", "rate_hz": 2, "hold_after_mission_s": 2, "settings": there}

with Simulation() as simulation:
    simulation.add("world", tasks={"World": {"type": "sim.world", "settings": world}}, role="environment")
    simulation.add("dock1", devices={"dock": dock})
    for name, home_m in HOMES.items():
        tasks: dict[str, Any] = {
            "Reserve": {"type": "energy.reserve", "settings": {"level_per_m": 0.04, "window_s": 20}},
            "Charge": {"type": "energy.charge", "start": False, "settings": {"home_m": home_m}},
        }
        if name == "robot1":
            tasks["Patrol"] = {"type": Patrol, "migrate": RULE}
        simulation.add(name, tasks=tasks, devices=devices, classes={"Patrol": Patrol})
    simulation.reset(seed=1)
    simulation.step(200.0)
    story: list[tuple[float, str]] = []
    for name in HOMES:
        for packet in simulation.agents[name].probe.packets(Event):
            told = packet.body.fields
            match packet.body.kind:
                case "task_started" if told["task"] == "Patrol":
                    story.append((packet.stamp_s, f"{name} patrols"))
                case "dock_chosen":
                    reserve_s = told["bids"][name]
                    story.append((packet.stamp_s, f"{name} takes {told['dock']}, with a reserve of {reserve_s:.0f} s"))
                case "docked" | "charged" as kind:
                    story.append((packet.stamp_s, f"{name} is {kind}, its battery is at {told['level']:.0%}"))
                case _:
                    pass
    for time_s, line in sorted(story):
        print(f"{time_s:.0f} s: {line}")
