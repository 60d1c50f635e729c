"""Define a packet type of your own, with bounds that are checked where it arrives.

A command with a number out of bounds is dropped by the agent that gets it, which warns of it.

$ python examples/packet_type.py
robot1: at 0.4 of full speed along [(0.0, 0.0), (1.0, 0.5)]
dropped: Expected `float` <= 1.0 - at `$.speed` (from desk/test/Probe)
"""

from typing import Annotated

from msgspec import Meta, Struct

from pancakes import SYSTEM, Simulation, Task, on, packet_type

Share = Annotated[float, Meta(ge=0, le=1)]


@packet_type("example.route")
class Route(Struct, frozen=True):
    """Where to go.

    Attributes:
        points_m: the corners, as (x, y).
        speed: the share of the full speed.
    """

    points_m: list[tuple[float, float]]
    speed: Share = 1.0


class Follow(Task):
    @on(SYSTEM)
    def told(self, route: Route) -> None:
        print(f"{self.agent}: at {route.speed:g} of full speed along {route.points_m}")


with Simulation() as simulation:
    simulation.add("robot1", tasks={"Follow": Follow})
    simulation.add("desk")
    simulation.reset(seed=1)
    desk = simulation.agents["desk"]
    desk.publish(SYSTEM, Route([(0.0, 0.0), (1.0, 0.5)], speed=0.4), to="robot1")
    desk.publish(SYSTEM, Route([(0.0, 0.0)], speed=40.0), to="robot1")
    simulation.step(1.0)
    (line,) = simulation.agents["robot1"].lines("warning")
    print("dropped:", line.partition("bad body: ")[2])
