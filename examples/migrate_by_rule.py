"""Let a task leave a robot whose battery runs low.

The rule `migrate` in the task's table watches the battery. All neighbours are asked for their cost; the cheapest gets
the task. Here the cost is the used share of the battery, so the full robot wins.

$ python examples/migrate_by_rule.py
robot1: level 0.40
robot1: level 0.30
robot1: level 0.20
moved to robot3
robot2 asked for 0.50, robot3 asked for 0.10
"""

from dataclasses import dataclass

from pancakes import SYSTEM, Packet, Sensor, Simulation, Task, agent_of, on
from pancakes.control import Migrations
from pancakes.devices import Battery


class Cell(Sensor):
    """Stands for a battery that loses a tenth of its charge each second, if it has work."""

    type = "battery"

    @dataclass
    class Settings:
        level: float
        falls: bool = False

    settings: Settings

    def open(self) -> None:
        self.level = self.settings.level

    def read(self) -> Battery:
        self.level -= 0.1 if self.settings.falls else 0.0
        return Battery(voltage_v=12.0, level=round(self.level, 3))


class Patrol(Task):
    requires = ("battery",)

    @on(SYSTEM)
    def measured(self, battery: Battery, packet: Packet[Battery]) -> None:
        if agent_of(packet.source) == "robot1":
            print(f"{self.agent}: level {battery.level:.2f}")


def battery(level: float, falls: bool = False) -> dict[str, object]:
    return {"battery": {"type": Cell, "rate_hz": 1, "settings": {"level": level, "falls": falls}}}


RULE = {"when": "battery", "below": 0.25, "cost": "battery"}

with Simulation() as simulation:
    simulation.add("robot1", tasks={"Patrol": {"type": Patrol, "migrate": RULE}}, devices=battery(0.5, falls=True))
    simulation.add("robot2", devices=battery(0.5))
    simulation.add("robot3", devices=battery(0.9))
    simulation.reset(seed=1)
    simulation.step(4.5)
    print("moved to", *simulation.where("Patrol"))
    (report,) = simulation.agents["robot1"].ask(Migrations()).result
    print(", ".join(f"{line['peer']} asked for {line['cost']:.2f}" for line in report["lines"]))
