"""Write a driver for an actuator, with the safe hold that it goes to without fresh commands.

The task that requires the lamp is its only holder. When the task stops, the device calls `safe_stop` at once, and so it
does when the agent ends.

$ python examples/actuator_driver.py
lamp: 0.2
lamp: 0.4
lamp: 0.6
lamp: off
Blink is stopped
refused: robot1/test/Probe does not hold it
lamp: off
"""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta, Struct

from pancakes import CTRL, Actuator, Simulation, Task, Tick, every, packet_type
from pancakes.control import Stop


@packet_type("lamp")
class Lamp(Struct, frozen=True):
    """A command to a lamp: how bright it shines, from 0 to 1."""

    brightness: Annotated[float, Meta(ge=0, le=1)]


class PrintedLamp(Actuator):
    type = "lamp"

    def write(self, command: Lamp, ttl_s: float, source: str) -> None:
        print(f"lamp: {command.brightness:.1f}")

    def safe_stop(self) -> None:
        print("lamp: off")


@dataclass
class BlinkState:
    brightness: float = 0.0


class Blink(Task[None, BlinkState]):
    requires = ("lamp",)

    @every(hz=4)
    def blink(self, tick: Tick) -> None:
        self.state.brightness += 0.2
        self.publish(CTRL, Lamp(self.state.brightness))


with Simulation() as simulation:
    simulation.add("robot1", tasks={"Blink": Blink}, devices={"lamp": PrintedLamp})
    simulation.reset(seed=1)
    simulation.step(0.8)
    robot = simulation.agents["robot1"]
    robot.ask(Stop("Blink"))
    print("Blink is stopped")
    robot.publish(CTRL, Lamp(1.0))
    simulation.step(1.0)
    (refused,) = robot.events("command_refused")
    print("refused:", refused["reason"])
