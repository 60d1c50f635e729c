"""Run a task at a rate.

A time-driven task counts twice a second. The simulation runs it in virtual time, so the three seconds take no time.

$ python examples/run_at_a_rate.py
0.5 s: 1
1.0 s: 2
1.5 s: 3
now once a second
2.0 s: 4
3.0 s: 5
4.0 s: 6
"""

from dataclasses import dataclass

from pancakes import Simulation, Task, Tick, every
from pancakes.control import Reschedule


@dataclass
class CountState:
    count: int = 0


class Count(Task[None, CountState]):
    @every(hz=2)
    def count(self, tick: Tick) -> None:
        self.state.count += 1
        print(f"{tick.time_s:.1f} s: {self.state.count}")


with Simulation() as simulation:
    simulation.add("robot1", tasks={"Count": Count})
    simulation.reset(seed=1)
    simulation.step(1.5)
    print("now once a second")
    simulation.agents["robot1"].ask(Reschedule("Count", rate_hz=1.0))
    simulation.step(2.5)
