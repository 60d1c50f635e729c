"""A talker and a listener on two robots, as in the first tutorial of ROS 2.

The talker publishes a packet of a type of our own to its neighbours; the listener hears it.

$ python examples/talker_and_listener.py
robot2 heard 'hello 1' from robot1/client/Talker
robot2 heard 'hello 2' from robot1/client/Talker
robot2 heard 'hello 3' from robot1/client/Talker
"""

from dataclasses import dataclass

from msgspec import Struct

from pancakes import NEIGHBOURS, SYSTEM, Packet, Simulation, Task, Tick, every, on, packet_type


@packet_type("example.greeting")
class Greeting(Struct, frozen=True):
    """What the talker says."""

    text: str


@dataclass
class TalkerState:
    said: int = 0


class Talker(Task[None, TalkerState]):
    @every(hz=1)
    def talk(self, tick: Tick) -> None:
        self.state.said += 1
        self.publish(SYSTEM, Greeting(f"hello {self.state.said}"), to=NEIGHBOURS)


class Listener(Task):
    @on(SYSTEM)
    def heard(self, greeting: Greeting, packet: Packet[Greeting]) -> None:
        print(f"{self.agent} heard {greeting.text!r} from {packet.source}")


with Simulation() as simulation:
    simulation.add("robot1", tasks={"Talker": Talker})
    simulation.add("robot2", tasks={"Listener": Listener})
    simulation.reset(seed=1)
    simulation.step(3.5)
