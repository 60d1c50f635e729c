"""React to what a sensor reads.

An event-driven task hears each reading of a thermometer, and logs an event when it becomes too hot.

$ python examples/react_to_a_reading.py
23 degrees
27 degrees
31 degrees
35 degrees
too hot: ['31 degrees at 3.0 s']
"""

from dataclasses import dataclass

from pancakes import SYSTEM, Packet, Sensor, Simulation, Task, on
from pancakes.devices import Temperature


class Oven(Sensor):
    """Stands for a thermometer: each reading is 4 degrees more."""

    type = "temperature"
    celsius = 19.0

    def read(self) -> Temperature:
        self.celsius += 4.0
        return Temperature(self.celsius)


@dataclass
class WatchSettings:
    limit_c: float = 30.0


@dataclass
class WatchState:
    is_hot: bool = False


class Watch(Task[WatchSettings, WatchState]):
    requires = ("temperature",)

    @on(SYSTEM)
    def measured(self, reading: Temperature, packet: Packet[Temperature]) -> None:
        print(f"{reading.celsius:.0f} degrees")
        is_hot = reading.celsius > self.settings.limit_c
        if is_hot and not self.state.is_hot:
            self.event("too_hot", celsius=reading.celsius, at_s=packet.stamp_s)
        self.state.is_hot = is_hot


with Simulation() as simulation:
    simulation.add("robot1", tasks={"Watch": Watch}, devices={"thermometer": {"type": Oven, "rate_hz": 1}})
    simulation.reset(seed=1)
    simulation.step(4.0)
    events = simulation.agents["robot1"].events("too_hot")
    print("too hot:", [f"{it['celsius']:.0f} degrees at {it['at_s']:.1f} s" for it in events])
