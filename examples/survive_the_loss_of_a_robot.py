"""Let a task survive the loss of its robot.

Three agents guard the task: they keep its checkpoints, and let one agent at a time run it. Robot 1 loses its power;
another robot goes on with the count.

$ python examples/survive_the_loss_of_a_robot.py
it runs on ['robot1']
robot1 is gone
it runs on robot2, and at most a second of it was lost: True
after robot1 is back, it runs on ['robot2']
"""

from dataclasses import dataclass

from pancakes import Simulation, Task, Tick, every


@dataclass
class CountState:
    count: int = 0


class Count(Task[None, CountState]):
    @every(hz=2)
    def tick(self, tick: Tick) -> None:
        self.state.count += 1


GUARD = {"copies": 3, "lease_s": 2.0, "checkpoint_s": 0.5}

with Simulation() as simulation:
    simulation.add("robot1", tasks={"Count": {"type": Count, "guard": GUARD}})
    simulation.add("robot2")
    simulation.add("robot3")
    simulation.reset(seed=1)
    simulation.step(20.0)
    print("it runs on", simulation.where("Count"))
    before = simulation.task("robot1", "Count").state.count
    simulation.crash("robot1")
    print("robot1 is gone")
    simulation.step_until(lambda: bool(simulation.where("Count")), 10.0)
    (robot,) = simulation.where("Count")
    count = simulation.task(robot, "Count").state.count
    print(f"it runs on {robot}, and at most a second of it was lost: {before - count <= 2}")
    simulation.restart("robot1")
    simulation.step(5.0)
    print("after robot1 is back, it runs on", simulation.where("Count"))
