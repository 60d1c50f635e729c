"""Keep robots apart, whatever their tasks command, with a filter below the tasks; and write a filter of your own.

Two robots drive at each other at full speed. With a barrier on each, they stop in time and pass each other. A filter of
your own stands before the barrier: it lets the robot drive slowly while its light is on.

$ python examples/keep_robots_apart.py
without a filter: they touch
with a barrier: they pass each other, never nearer than 0.28 m
robot1: the filter apart changes commands: keeps clear of robot2
with a filter of our own as well: at most 0.11 m/s
"""

import math
from dataclasses import dataclass
from typing import Any

from pancakes import CTRL, SYSTEM, Changed, Filter, Simulation, Task, on
from pancakes.devices import Pose, Twist

BUS = "tcp://world:7499"
ROBOT = {"radius_m": 0.065, "max_mps": 0.3, "max_radps": 2.2}


class DriveAcross(Task):
    """Drives to the point on the other side, as fast as it can, and looks for nobody."""

    requires = ("pose", "motors")

    def on_start(self) -> None:
        self.goal: tuple[float, float] | None = None

    @on(SYSTEM, queue="latest")
    def located(self, pose: Pose) -> None:
        if self.goal is None:
            self.goal = (-pose.x_m, -pose.y_m)
        ahead_m, left_m = self.goal[0] - pose.x_m, self.goal[1] - pose.y_m
        turn_rad = math.remainder(math.atan2(left_m, ahead_m) - pose.theta_rad, math.tau)
        speed_mps = 0.25 * max(0.0, math.cos(turn_rad)) if math.hypot(ahead_m, left_m) > 0.05 else 0.0
        self.publish(CTRL, Twist(speed_mps, 2.0 * turn_rad))


class SlowZone(Filter):
    """Lets a drive be no faster than a speed."""

    type = "motors"

    @dataclass
    class Settings:
        max_mps: float

    settings: Settings

    def apply(self, command: Twist, ttl_s: float, source: str) -> Any:
        if abs(command.v_mps) <= self.settings.max_mps:
            return command
        return Changed(Twist(math.copysign(self.settings.max_mps, command.v_mps), command.omega_radps), "slow zone")


def drive(filters: dict[str, Any]) -> tuple[float, float, Simulation]:
    """Return the least distance of the robots' centres, and robot1's highest speed."""
    simulation = Simulation()
    places = {"robot1": (-0.8, 0.0, 0.0), "robot2": (0.8, 0.0, math.pi)}
    bodies = {name: {"x_m": x, "y_m": y, "theta_rad": theta} for name, (x, y, theta) in places.items()}
    simulation.add("world", tasks={"World": {"type": "sim.world", "settings": {"bus": BUS, "robots": bodies}}})
    devices = {
        "pose": {"type": "sim.pose", "rate_hz": 15, "settings": {"world": BUS}},
        "motors": {"type": "sim.differential_drive", "settings": {"world": BUS}},
    }
    for name in places:
        simulation.add(name, tasks={"DriveAcross": DriveAcross}, devices=devices, filters=filters)
    simulation.reset(seed=1)
    nearest_m, fastest_mps, before = math.inf, 0.0, simulation.body("robot1")
    for _ in range(400):
        simulation.step(0.05)
        one, other = simulation.body("robot1"), simulation.body("robot2")
        nearest_m = min(nearest_m, math.hypot(one.x_m - other.x_m, one.y_m - other.y_m))
        fastest_mps = max(fastest_mps, math.hypot(one.x_m - before.x_m, one.y_m - before.y_m) / 0.05)
        before = one
    return nearest_m, fastest_mps, simulation


nearest_m, _, simulation = drive({})
print("without a filter: they touch" if nearest_m < 0.131 else "?")
simulation.close()

apart = {"type": "barrier", "device": "motors", "settings": ROBOT}
nearest_m, _, simulation = drive({"apart": apart})
gone = simulation.body("robot1").x_m > 0.5
print(f"with a barrier: they {'pass each other' if gone else 'wait'}, never nearer than {nearest_m:.2f} m")
event = next(it for it in simulation.agents["robot1"].events("command_filtered") if it["reason"] != "too fast")
print(f"robot1: the filter {event['filter']} {event['doing']} commands: {event['reason']}")
simulation.close()

slow = {"type": SlowZone, "device": "motors", "settings": {"max_mps": 0.1}}
_, fastest_mps, simulation = drive({"slow": slow, "apart": apart})
print(f"with a filter of our own as well: at most {fastest_mps:.2f} m/s")
simulation.close()
