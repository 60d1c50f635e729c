"""A task that moves away from an agent on which another task is to follow it."""

from dataclasses import dataclass

from pancakes.control import Migrate, Migrations, Stop
from pancakes.durable.record import TaskId
from pancakes.durable.register import Standing
from pancakes.mesh.memory_network import Quality
from pancakes.packet import SYSCTRL
from pancakes.task import Task, every
from pancakes.testing import Fleet


class Circle(Task):
    @dataclass
    class State:
        n: int = 0

    @every(hz=10)
    def tick(self, tick):
        self.state.n += 1


class Home(Circle):
    pass


def two(seed=3):
    fleet = Fleet(seed, classes={"test.Circle": Circle, "test.Home": Home})
    fleet.start("a", tasks={"Circle": Circle, "Home": {"type": Home, "start": False}})
    fleet.start("b")
    fleet.connect()
    fleet.network.set_quality("a", "b", Quality(latency_s=0.01))
    return fleet


def phase(fleet, agent, name="Circle"):
    place = fleet.agents[agent].component("client").places.get(TaskId("a", name))
    return place.record.standing if place is not None else Standing.NONE


def until(fleet, condition):
    begin_s = fleet.now()
    while not condition():
        assert fleet.dispatcher.step() and fleet.now() < begin_s + 20.0


def moving(fleet, wanted, **others):
    """a moves Circle, and is stopped at the moment when its record is so."""
    fleet.run_for(1.0)
    asked = fleet.agents["a"].publish(SYSCTRL, Migrate("Circle", **others))
    until(fleet, lambda: phase(fleet, "a") is wanted)
    return asked


def follows_after_a_death(steps):
    """Check that the task follows once if its agent dies so many steps after the point of no return."""
    with two() as fleet:
        moving(fleet, Standing.YIELDED, then="Home")
        for _ in range(steps):
            fleet.dispatcher.step()
        fleet.crash("a")
        fleet.run_for(1.0)
        a = fleet.restart("a")
        fleet.run_for(20.0)
        assert fleet.agents["b"].running() == ["Circle"]
        assert a.running() == ["Home"]
        (account,) = a.ask(Migrations()).result
        assert (account["outcome"], account["winner"]) == ("moved", "b")
        # It has followed: who stops it has the last word.
        assert a.ask(Stop("Home")).ok
        fleet.crash("a")
        a = fleet.restart("a")
        fleet.run_for(1.0)
        assert a.running() == []
