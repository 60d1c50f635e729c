"""Say what other agents may do at a robot.

The table `[access]` has the rules. Here every agent may look and publish; only the agent `desk` may change settings,
and no agent may end the robot.

$ python examples/rights.py
robot1 drives at 0.3 m/s
desk: ok
robot2: robot1 does not let robot2 (agent) do this: it lacks the right 'change'
desk: robot1 lets no peer do this: its own file refuses the right 'end'
"""

from dataclasses import dataclass

from pancakes import Simulation, Task
from pancakes.control import Configure, Shutdown

ACCESS = """
[access]
refuse = ["end"]

[[access.allow]]
who = ["role:agent"]
may = ["look", "publish"]

[[access.allow]]
who = ["desk"]
may = ["change"]
on = ["robot1/client/*"]
"""


@dataclass
class DriveSettings:
    speed_mps: float = 0.1


class Drive(Task[DriveSettings]):
    def on_settings(self) -> None:
        print(f"{self.agent} drives at {self.settings.speed_mps} m/s")


with Simulation() as simulation:
    simulation.add("robot1", ACCESS, tasks={"Drive": Drive})
    simulation.add("robot2")
    simulation.add("desk")
    simulation.reset(seed=1)
    for name in ("desk", "robot2"):
        reply = simulation.agents[name].ask(Configure("Drive", {"speed_mps": 0.3}), to="robot1")
        print(f"{name}:", "ok" if reply.ok else reply.reason.partition(" on ")[0])
    print("desk:", simulation.agents["desk"].ask(Shutdown(), to="robot1").reason)
