"""A simulator of your own as a world: drivers, the truth and virtual time work with it as with the built-in one.

$ python examples/own_simulator.py
2 s: at 0.78 m, 0.4 m/s
4 s: at 1.58 m, 0.4 m/s
6 s: at 2.00 m, 0.0 m/s
"""

import math

from pancakes import CTRL, SYSTEM, PancakesError, Simulation, Task, Tick, every, on
from pancakes.devices import Pose, Twist
from pancakes.worlds import BodyState, SimulatedWorld, Wheels, WorldState

BUS = "tcp://world:7499"


class Rail(SimulatedWorld):
    """Robots on a straight rail; here stands the simulator, or the calls of yours."""

    def on_start(self) -> None:
        self.x_m = {name: robot.x_m for name, robot in self.settings.robots.items()}
        self.v_mps = dict.fromkeys(self.x_m, 0.0)
        self.until_s = dict.fromkeys(self.x_m, math.inf)
        self.at_s = 0.0
        super().on_start()

    @every(hz=20)
    def tell(self, tick: Tick) -> None:
        self.advance()
        self.publish_truth()

    def advance(self) -> None:
        now_s = self.now()
        for name in self.x_m:
            self.x_m[name] += self.v_mps[name] * max(0.0, min(now_s, self.until_s[name]) - self.at_s)
            if self.until_s[name] <= now_s:  # the command is too old: stop
                self.v_mps[name] = 0.0
        self.at_s = now_s

    def truth(self) -> WorldState:
        bodies = [BodyState(name, "robot", x_m, 0.0, 0.0, self.v_mps[name], 0.0) for name, x_m in self.x_m.items()]
        return WorldState(self.at_s, tuple(bodies))

    def check(self, body: str, device_type: str, model: str) -> None:
        if body not in self.x_m or device_type not in ("pose", "motors"):
            raise PancakesError(f"the rail has no {device_type} of a robot {body!r}, only of {', '.join(self.x_m)}")

    def sample(self, body: str, device_type: str) -> Pose:
        self.check(body, device_type, "")
        return Pose(self.x_m[body], 0.0, 0.0)

    def drive(self, body: str, wheels: Wheels, ttl_s: float, source: str) -> None:
        if not math.isfinite(wheels.left_mps + wheels.right_mps + ttl_s):
            raise PancakesError(f"the wheels of {body} cannot run at {wheels.left_mps:g} and {wheels.right_mps:g} m/s")
        self.v_mps[body] = 0.5 * (wheels.left_mps + wheels.right_mps)
        self.until_s[body] = self.now() + ttl_s

    def hold(self, body: str, device: str) -> None:
        self.v_mps[body] = 0.0


class GoTo(Task):
    """Go two metres along the rail."""

    requires = ("pose", "motors")

    @on(SYSTEM)
    def measured(self, pose: Pose) -> None:
        self.publish(CTRL, Twist(max(-0.4, min(0.4, 4.0 * (2.0 - pose.x_m))), 0.0))


with Simulation() as simulation:
    rail = {"type": Rail, "settings": {"bus": BUS, "robots": {"robot": {"x_m": 0.0, "y_m": 0.0}}}}
    simulation.add("world", tasks={"Rail": rail}, role="environment")
    simulation.add(
        "robot",
        tasks={"GoTo": GoTo},
        devices={
            "pose": {"type": "sim.pose", "rate_hz": 20, "settings": {"world": BUS}},
            "motors": {"type": "sim.differential_drive", "settings": {"world": BUS, "model": "pioneer3dx"}},
        },
    )
    simulation.reset(seed=1)
    for _ in range(3):
        simulation.step(2.0)
        robot = simulation.body("robot")
        print(f"{simulation.now_s:g} s: at {robot.x_m:.2f} m, {robot.v_mps:.1f} m/s")
