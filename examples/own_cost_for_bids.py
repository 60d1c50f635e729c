"""Choose the robot for a task by a cost of your own: here the distance to the place of the work.

A cost function is computed by each robot that is asked. It may use newest readings there, and what the task offers of
its state.

$ python examples/own_cost_for_bids.py
robot2 would have 4.0 m to go, robot3 would have 1.0 m to go
it runs on ['robot3']
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from pancakes import Cost, CostFacts, Simulation, Task
from pancakes.control import Migrate, Migrations


class Nearest(Cost):
    name = "example.nearest"
    reads = ("pose",)

    def terms(self, facts: CostFacts) -> Mapping[str, float]:
        pose, (x_m, y_m) = facts.reading("pose"), facts.offered("place_m")
        return {"metres": math.hypot(pose.x_m - x_m, pose.y_m - y_m)}


@dataclass
class InspectState:
    place_m: tuple[float, float] = (5.0, 0.0)


class Inspect(Task[None, InspectState]):
    requires = ("pose",)
    offers = ("place_m",)


def pose(x_m: float) -> dict[str, object]:
    return {"pose": {"type": "static.pose", "rate_hz": 2, "settings": {"x_m": x_m, "y_m": 0.0}}}


with Simulation() as simulation:
    costs = {"example.nearest": Nearest}
    simulation.add("robot1", tasks={"Inspect": Inspect}, devices=pose(0.0), classes=costs)
    simulation.add("robot2", devices=pose(1.0), classes=costs)
    simulation.add("robot3", devices=pose(4.0), classes=costs)
    simulation.reset(seed=1)
    simulation.step(2.0)
    robot1 = simulation.agents["robot1"]
    robot1.ask(Migrate("Inspect", cost="example.nearest"))
    (report,) = robot1.ask(Migrations()).result
    print(", ".join(f"{line['peer']} would have {line['cost']} m to go" for line in report["lines"]))
    print("it runs on", simulation.where("Inspect"))
