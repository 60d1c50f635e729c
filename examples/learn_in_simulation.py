"""Use the simulation as a library: learn a gain by trying it on a simulated robot.

Each try is a mission of a Khepera III in a simulated world. The gain is doubled as long as the robot reaches its goal
sooner.

$ python examples/learn_in_simulation.py
gain 0.1: 60.00 s
gain 0.2: 28.05 s
gain 0.4: 15.40 s
gain 0.8: 13.55 s
gain 1.6: 13.05 s
gain 3.2: 13.10 s
learned the gain 1.6
"""

import math
from dataclasses import dataclass

from pancakes import CTRL, SYSTEM, Simulation, Task, on
from pancakes.devices import Pose, Twist

GOAL_M = (1.0, 0.8)
BUS = "tcp://world:7499"
PATIENCE_S = 60.0


@dataclass
class DriveSettings:
    gain: float = 0.1


class Drive(Task[DriveSettings]):
    """Turns to the goal, and drives there."""

    requires = ("pose", "motors")

    @on(SYSTEM, queue="latest")
    def located(self, pose: Pose) -> None:
        ahead_m, left_m = GOAL_M[0] - pose.x_m, GOAL_M[1] - pose.y_m
        turn_rad = math.remainder(math.atan2(left_m, ahead_m) - pose.theta_rad, math.tau)
        speed_mps = 0.2 * max(0.0, math.cos(turn_rad))
        self.publish(CTRL, Twist(speed_mps, self.settings.gain * turn_rad))


def time_s(gain: float) -> float:
    """Return how long the robot takes to its goal with this gain."""
    with Simulation() as simulation:
        room = {"bus": BUS, "robots": {"robot1": {"x_m": -1.0, "y_m": -0.5, "theta_rad": -2.0}}}
        simulation.add("world", tasks={"World": {"type": "sim.world", "settings": room}})
        devices = {
            "pose": {"type": "sim.pose", "rate_hz": 2, "settings": {"world": BUS}},
            "motors": {"type": "sim.differential_drive", "settings": {"world": BUS, "model": "khepera3"}},
        }
        simulation.add("robot1", tasks={"Drive": {"type": Drive, "settings": {"gain": gain}}}, devices=devices)
        simulation.reset(seed=3)

        def is_there() -> bool:
            body = simulation.body("robot1")
            return math.hypot(GOAL_M[0] - body.x_m, GOAL_M[1] - body.y_m) < 0.1

        simulation.step_until(is_there, PATIENCE_S)
        return simulation.now_s


gain, best_s = 0.1, time_s(0.1)
print(f"gain {gain}: {best_s:.2f} s")
while (found_s := time_s(2 * gain)) < best_s:
    gain, best_s = 2 * gain, found_s
    print(f"gain {gain}: {best_s:.2f} s")
print(f"gain {2 * gain}: {found_s:.2f} s")
print(f"learned the gain {gain}")
