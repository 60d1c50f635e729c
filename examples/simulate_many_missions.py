"""Simulate many missions, one for each seed, and look at the spread of a result.

In each mission the robot that runs a guarded task loses its power at a time that the seed draws.

$ python examples/simulate_many_missions.py
20 missions: the task ran nowhere for 1.7 to 2.1 s
median 2.0 s
"""

import random
from dataclasses import dataclass
from statistics import median

from pancakes import Simulation, Task, Tick, every


@dataclass
class CountState:
    count: int = 0


class Count(Task[None, CountState]):
    @every(hz=10)
    def tick(self, tick: Tick) -> None:
        self.state.count += 1


GUARD = {"copies": 3, "lease_s": 2.0, "checkpoint_s": 0.5}


def gap_s(seed: int) -> float:
    """Return how long the task ran nowhere."""
    with Simulation() as simulation:
        simulation.add("robot1", tasks={"Count": {"type": Count, "guard": GUARD}})
        simulation.add("robot2")
        simulation.add("robot3")
        simulation.reset(seed)
        simulation.step(random.Random(seed).uniform(10.0, 20.0))
        simulation.crash("robot1")
        lost_s = simulation.now_s
        simulation.step_until(lambda: bool(simulation.where("Count")), 20.0)
        return simulation.now_s - lost_s


gaps_s = [gap_s(seed) for seed in range(20)]
print(f"{len(gaps_s)} missions: the task ran nowhere for {min(gaps_s):.1f} to {max(gaps_s):.1f} s")
print(f"median {median(gaps_s):.1f} s")
