"""Change the class of a task while it runs: it goes on in the new one, with its state.

$ python examples/reload_a_task.py
robot1 counted to 5, in steps of 1
a state that does not fit: refused
robot1 counted to 10, in steps of 1
the class is changed: ok
robot1 counted to 60, in steps of 10
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from pancakes import Simulation
from pancakes.control import Reload

SOURCE = """
from dataclasses import dataclass
from pancakes import Task, Tick, every

STEP = 1

@dataclass
class CountState:
    count: int = 0

class Count(Task[None, CountState]):
    @every(hz=1)
    def tick(self, tick: Tick) -> None:
        self.state.count += STEP
        if int(tick.time_s) % 5 == 0:
            print(f"{self.agent} counted to {self.state.count}, in steps of {STEP}")
"""


def install(folder: Path) -> None:
    """Write a distribution with one task type, as `pip install` does."""
    information = folder / "counting-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: counting\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[pancakes.tasks]\ncounting.Count = counting:Count\n")
    sys.path.insert(0, str(folder))


with TemporaryDirectory() as directory, Simulation() as simulation:
    install(Path(directory))
    module = Path(directory) / "counting.py"
    module.write_text(SOURCE)
    simulation.add("robot1", tasks={"Count": "counting.Count"})
    simulation.reset(seed=1)
    robot1 = simulation.agents["robot1"]
    simulation.step(5.5)

    module.write_text(SOURCE.replace("count: int = 0", "counted: int = 0"))
    reply = robot1.ask(Reload("counting.Count"))
    print("a state that does not fit:", "ok" if reply.ok else "refused")
    simulation.step(5.0)

    module.write_text(SOURCE.replace("STEP = 1", "STEP = 10"))
    reply = robot1.ask(Reload("counting.Count"))
    print("the class is changed:", "ok" if reply.ok else reply.reason)
    simulation.step(5.0)
