"""A fleet whose agents keep a few links each: tasks move, letters follow, agents die, and each task runs once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

from msgspec import Struct

from pancakes.control import Migrate
from pancakes.packet import SYSTEM, Packet, packet_type
from pancakes.simulation import Simulation
from pancakes.task import Task, Tick, every, on

LINKS = 4
GUARDED = 3
GUARD = {"guard": {"copies": 3, "lease_s": 2.0}}
LOOK_S = 0.5


@packet_type("large.order")
class Order(Struct, frozen=True):
    number: int


class Worker(Task):
    """Counts, and keeps the numbers of the orders that it hears."""

    @dataclass
    class State:
        n: int = 0
        heard: list[int] = field(default_factory=list)

    state: State

    @every(hz=1)
    def work(self, tick: Tick) -> None:
        self.state.n += 1

    @on(SYSTEM, Order)
    def order(self, packet: Packet) -> None:
        self.state.heard.append(packet.body.number)


class Fleet:
    """The fleet, the tasks in it, and the orders that each was given."""

    def __init__(self, simulation: Simulation, agents: int) -> None:
        self.simulation = simulation
        self.names = [f"a{number:04d}" for number in range(agents)]
        self.births = {f"W{number}": self.names[8 * number + 1] for number in range(agents // 8)}
        self.given = dict.fromkeys(self.births, 0)
        self.guarded = list(self.births)[:GUARDED]
        for name in self.names:
            tasks = {
                task: {"type": Worker, "durability": "each", **(GUARD if task in self.guarded else {})}
                for task, birth in self.births.items()
                if birth == name
            }
            # It must be able to run elsewhere than where it is born.
            simulation.add(name, tasks=tasks, classes={"Worker": Worker}, links=LINKS)
        simulation.reset(seed=7)

    def hosts(self) -> dict[str, list[str]]:
        found: dict[str, list[str]] = {task: [] for task in self.births}
        for name, handle in self.simulation.agents.items():  # each once: `where` looks at all of them for each task
            for task in handle.running():
                found[task].append(name)
        return found

    def is_on(self, task: str, agent: str) -> bool:
        return self.simulation.where(task) == [agent]

    def runs(self, task: str) -> bool:
        return bool(self.simulation.where(task))

    def order(self, from_: str) -> None:
        """An agent gives an order to each task."""
        for task, birth in self.births.items():
            self.given[task] += 1
            self.simulation.agents[from_].publish(SYSTEM, Order(self.given[task]), to=f"task:{birth}/{task}")

    def stranger_of(self, name: str) -> str:
        """Return an agent to which another one has no link."""
        met = self.simulation.agents[name].agent.mesh.connected()
        return next(other for other in reversed(self.names) if other != name and other not in met)

    def until(self, condition: Callable[[], bool], what: str, timeout_s: float = 60.0) -> None:
        for _ in range(round(timeout_s / LOOK_S)):  # to look after each thing that happens would take longer than that
            if condition():
                return
            self.simulation.step(LOOK_S)
        raise AssertionError(f"{what}: {self.hosts()}, {self.given}")

    def all_heard(self) -> bool:
        return all(
            len(hosts) == 1
            and sorted(self.simulation.task(hosts[0], task).state.heard) == list(range(1, self.given[task] + 1))
            for task, hosts in self.hosts().items()
        )


def live_through(agents: int) -> None:
    """Run a fleet of so many agents: tasks migrate, letters follow, agents die, and each task runs once."""
    with Simulation() as simulation:
        fleet = Fleet(simulation, agents)
        simulation.step(10.0)
        linked = [len(handle.agent.mesh.connected()) for handle in simulation.agents.values()]
        assert min(linked) >= LINKS and sum(linked) < agents * (agents - 1) / 2
        fleet.order(fleet.names[-1])
        fleet.until(fleet.all_heard, "the first orders")
        for task, birth in fleet.births.items():
            target = fleet.stranger_of(birth)
            assert simulation.agents[birth].ask(Migrate(task, to=target)).ok
            fleet.until(partial(fleet.is_on, task, target), "a move")
        fleet.order(fleet.names[-1])
        fleet.order(fleet.names[0])
        fleet.until(fleet.all_heard, "orders after a move")
        for task in fleet.births:  # and from there to whom of the neighbours it costs least
            (host,) = simulation.where(task)
            assert simulation.agents[host].ask(Migrate(task)).ok
        fleet.order(fleet.names[-1])
        fleet.until(fleet.all_heard, "orders after a second move")
        for task in fleet.guarded:
            (dead,) = simulation.where(task)
            simulation.crash(dead)
            fleet.order(next(name for name in fleet.names if name in simulation.agents))
            fleet.until(partial(fleet.runs, task), "a guarded task is taken over")
            simulation.restart(dead)
            fleet.until(fleet.all_heard, "orders after a take-over", 120.0)
        hosts = sorted({simulation.where(task)[0] for task in fleet.births})
        for host in hosts:
            simulation.crash(host)
        fleet.order(next(name for name in fleet.names if name in simulation.agents))
        simulation.step(5.0)
        for host in hosts:
            simulation.restart(host)
        fleet.until(fleet.all_heard, "orders after all owners came back", 120.0)
        simulation.step(5.0)
        assert all(len(found) == 1 for found in fleet.hosts().values())
