"""Let the team decide which robot has which task: each bids, and no robot leads.

Three places must be watched. The robots bid for the tasks by their distance to the place, and each takes two tasks at
most. A robot that is moved, or that is switched off, changes the allocation.

$ python examples/allocate_tasks.py
Gate is on robot1, the team would have it on robot1
Pond is on robot1, the team would have it on robot2
Wood is on robot1, the team would have it on robot3
worth 296.0 instead of 273.0
after some seconds: Gate on robot1, Pond on robot2, Wood on robot3
without robot3: Gate on robot1, Pond on robot2, Wood on robot2
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from pancakes import Cost, CostFacts, Simulation, Task
from pancakes.control import Allocate


class Distance(Cost):
    name = "example.distance"
    reads = ("pose",)

    def terms(self, facts: CostFacts) -> Mapping[str, float]:
        pose, place = facts.reading("pose"), facts.settings
        return {"metres": math.hypot(pose.x_m - place["x_m"], pose.y_m - place["y_m"])}


@dataclass
class WatchSettings:
    x_m: float = 0.0
    y_m: float = 0.0


class Watch(Task[WatchSettings, None]):
    requires = ("pose",)


PART = {"network": {"settings": {"allocation": {"at_most": 2, "crowding": 1.0}}}}
RULE = {"when": "allocation", "cost": "example.distance", "value": 100.0, "move_price": 1.0}
GUARD = {"copies": 3, "lease_s": 2.0}


def pose(x_m: float) -> dict[str, object]:
    return {"pose": {"type": "static.pose", "rate_hz": 2, "settings": {"x_m": x_m, "y_m": 0.0}}}


def watch(x_m: float) -> dict[str, object]:
    return {"type": Watch, "migrate": RULE, "guard": GUARD, "settings": {"x_m": x_m, "y_m": 0.0}}


with Simulation() as simulation:
    places = {"Gate": watch(0.0), "Pond": watch(9.0), "Wood": watch(15.0)}
    for name, x_m in (("robot1", 0.0), ("robot2", 8.0), ("robot3", 14.0)):
        tasks = places if name == "robot1" else {}
        simulation.add(
            name, tasks=tasks, devices=pose(x_m), services=PART, classes={"example.distance": Distance, "w": Watch}
        )
    simulation.reset(seed=1)
    simulation.step(0.6)
    report = simulation.agents["robot1"].ask(Allocate(dry_run=True)).result
    for line in report["lines"]:
        name = line["task"].partition("/")[2]
        print(f"{name} is on {line['owner']}, the team would have it on {line['winner']}")
    print(f"worth {report['value']:.1f} instead of {report['present']:.1f}")

    def where() -> str:
        return ", ".join(f"{name} on {' and '.join(simulation.where(name))}" for name in places)

    simulation.step(20.0)
    print("after some seconds:", where())
    simulation.crash("robot3")
    simulation.step(30.0)
    print("without robot3:", where())
