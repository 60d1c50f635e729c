"""Ask another task, and wait for its answer, also if it moves to another robot meanwhile.

Errand asks Map, which answers at once, and Drive, which answers later. Drive migrates while it works: the request
follows it, and it goes on from its state.

$ python examples/ask_another_task.py
Drive on robot1: 1 m of 3
Drive on robot1: 2 m of 3
Drive on robot2: 3 m of 3
Errand: Arrived(agent='robot2', metres=3)
Errand: the map has no 'moon' (not_found)
"""

from dataclasses import dataclass

from msgspec import Struct

from pancakes import (
    SYSTEM,
    Pending,
    Request,
    RequestError,
    Simulation,
    Task,
    Tick,
    answers,
    every,
    on,
    packet_type,
    task_address,
)
from pancakes.control import Migrate


@packet_type("example.distance_to")
class DistanceTo(Request[int], frozen=True):
    """How far away is it, in metres?"""

    name: str


class Arrived(Struct, frozen=True):
    """The result of `DriveFor`."""

    agent: str
    metres: int


@packet_type("example.drive_for")
class DriveFor(Request[Arrived, int], frozen=True):
    """Drive so far; the feedback is how far it has come, in metres."""

    metres: int


@packet_type("example.order")
class Order(Struct, frozen=True):
    """Go there."""

    name: str


class Map(Task):
    @answers(DistanceTo)
    def distance_to(self, request: DistanceTo) -> int:
        if request.name != "cup":
            raise RequestError(f"the map has no {request.name!r}", "not_found")
        return 3


@dataclass
class DriveState:
    goal: Pending[Arrived, int] | None = None
    metres: int = 0
    driven: int = 0


class Drive(Task[None, DriveState]):
    @answers(DriveFor)
    def drive_for(self, request: DriveFor, pending: Pending[Arrived, int]) -> None:
        if self.state.goal is not None:
            raise RequestError("it drives already", "busy")
        self.state = DriveState(pending, request.metres)

    @every(hz=1)
    def drive(self, tick: Tick) -> None:
        state = self.state
        if state.goal is None:
            return
        state.driven += 1
        print(f"Drive on {self.agent}: {state.driven} m of {state.metres}")
        state.goal.feedback(state.driven)
        if state.driven == state.metres:
            state.goal.answer(Arrived(self.agent, state.driven))
            state.goal = None

    def on_cancel(self, pending: Pending[Arrived, int]) -> None:
        self.state.goal = None


class Errand(Task):
    @on(SYSTEM)
    async def go(self, order: Order) -> None:
        try:
            metres = await self.ask("base/client/Map", DistanceTo(order.name))
            arrived = await self.ask(task_address("robot1/Drive"), DriveFor(metres), timeout_s=60.0)
            print(f"Errand: {arrived}")
        except RequestError as error:
            print(f"Errand: {error} ({error.code})")


with Simulation() as simulation:
    simulation.add("base", tasks={"Map": Map, "Errand": Errand})
    simulation.add("robot1", tasks={"Drive": Drive})
    simulation.add("robot2", classes={"Drive": Drive})
    simulation.reset(seed=1)
    simulation.agents["base"].publish(SYSTEM, Order("cup"))
    simulation.step(2.5)
    simulation.agents["robot1"].ask(Migrate("Drive", to="robot2"))
    simulation.step(2.0)
    simulation.agents["base"].publish(SYSTEM, Order("moon"))
    simulation.step(1.0)
