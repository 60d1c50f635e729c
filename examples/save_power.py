"""Save power: let a governor turn down what a robot does as its battery runs low.

The governor is a task of the core. Its settings name thresholds of the battery, and the rates that it turns.

$ python examples/save_power.py
level 0.7: effort 1.0, the camera takes 10.0 pictures a second
level 0.5: effort 0.5, the camera takes 6.0 pictures a second
level 0.3: effort 0.0, the camera takes 2.0 pictures a second
"""

from dataclasses import dataclass

from pancakes import Sensor, Simulation, Task, Tick, every
from pancakes.devices import Battery

GOVERNOR = """
[task.EnergyGovernor]
type = "energy.governor"

[task.EnergyGovernor.settings]
policy = "thresholds"
thresholds = [{ below = 0.6, effort = 0.5 }, { below = 0.4, effort = 0.0 }]
hysteresis = 0.03

[task.EnergyGovernor.settings.rates]
"client/Camera" = { full = 10, least = 2 }
"""


class Cell(Sensor):
    """Stands for a battery."""

    type = "battery"
    level = 0.7

    def read(self) -> Battery:
        return Battery(voltage_v=12.0, level=Cell.level)


@dataclass
class CameraState:
    pictures: int = 0


class Camera(Task[None, CameraState]):
    @every(hz=10)
    def take(self, tick: Tick) -> None:
        self.state.pictures += 1


with Simulation() as simulation:
    cell = {"type": Cell, "rate_hz": 1}
    simulation.add("robot1", GOVERNOR, tasks={"Camera": Camera}, devices={"battery": cell})
    simulation.reset(seed=1)
    robot = simulation.agents["robot1"]
    for level in (0.7, 0.5, 0.3):
        Cell.level = level
        simulation.step(5.0)
        before = simulation.task("robot1", "Camera").state.pictures
        simulation.step(10.0)
        rate_hz = (simulation.task("robot1", "Camera").state.pictures - before) / 10.0
        efforts = [it["effort"] for it in robot.events("effort_changed")]
        print(f"level {level}: effort {efforts[-1] if efforts else 1.0}, the camera takes {rate_hz} pictures a second")
