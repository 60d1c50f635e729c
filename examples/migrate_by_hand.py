"""Hand a task to another robot, with its state.

$ python examples/migrate_by_hand.py
robot1 counted to 5
moved to robot2: ok
robot2 counted to 10
it runs on ['robot2']
"""

from dataclasses import dataclass

from pancakes import Simulation, Task, Tick, every
from pancakes.control import Migrate


@dataclass
class CountState:
    count: int = 0


class Count(Task[None, CountState]):
    @every(hz=1)
    def tick(self, tick: Tick) -> None:
        self.state.count += 1
        if self.state.count % 5 == 0:
            print(f"{self.agent} counted to {self.state.count}")


with Simulation() as simulation:
    simulation.add("robot1", tasks={"Count": Count})
    simulation.add("robot2")
    simulation.reset(seed=1)
    simulation.step(5.5)
    reply = simulation.agents["robot1"].ask(Migrate("Count", to="robot2"))
    print("moved to robot2:", "ok" if reply.ok else reply.reason)
    simulation.step(5.0)
    print("it runs on", simulation.where("Count"))
