"""Read a laser scanner and wheel encoders: stop before what is ahead, and reckon the way from the wheels.

The robot is a Pioneer 3-DX in a simulated world; a wall is 2 m ahead of it.

$ python examples/scan_and_odometry.py
stops with 0.49 m ahead
it reckons 1.48 m, and has come 1.48 m
"""

import math
from dataclasses import dataclass

from pancakes import CTRL, SYSTEM, Simulation, Task, on
from pancakes.devices import Encoders, LaserScan, Twist

BUS = "tcp://world:7499"
WHEEL_M = 0.0975


@dataclass
class CruiseState:
    way_m: float = 0.0
    ahead_m: float = math.inf


class Cruise(Task[None, CruiseState]):
    """Drives until something is half a metre ahead."""

    requires = ("laser_scan", "encoders", "motors")

    @on(SYSTEM, queue="latest")
    def scanned(self, scan: LaserScan) -> None:
        ahead = abs(scan.bearings_rad()) < math.radians(10)
        self.state.ahead_m = float(scan.ranges_m()[ahead].min())
        self.publish(CTRL, Twist(0.3 if self.state.ahead_m > 0.6 else 0.1 if self.state.ahead_m > 0.5 else 0.0, 0.0))

    @on(SYSTEM, queue="latest")
    def counted(self, encoders: Encoders) -> None:
        self.state.way_m = WHEEL_M * sum(encoders.angles_rad) / 2


with Simulation() as simulation:
    robot = {"x_m": 0.0, "y_m": 0.0, "model": "pioneer3dx", "spread_m": 0.0, "spread_rad": 0.0}
    room = {
        "bus": BUS,
        "arena": {"width_m": 4.0, "height_m": 4.0},
        "robots": {"robot1": robot},
        "noise": {"wheel": 0.0, "laser_m": 0.0},
    }
    simulation.add("world", tasks={"World": {"type": "sim.world", "settings": room}})
    devices = {
        "laser": {"type": "sim.laser_scan", "rate_hz": 20, "settings": {"world": BUS}},
        "wheels": {"type": "sim.encoders", "rate_hz": 10, "settings": {"world": BUS}},
        "motors": {"type": "sim.differential_drive", "settings": {"world": BUS, "model": "pioneer3dx"}},
    }
    simulation.add("robot1", tasks={"Cruise": Cruise}, devices=devices)
    simulation.reset(seed=1)
    simulation.step(15.0)
    state = simulation.agents["robot1"].task("Cruise").state
    print(f"stops with {state.ahead_m:.2f} m ahead")
    print(f"it reckons {state.way_m:.2f} m, and has come {simulation.body('robot1').x_m:.2f} m")
