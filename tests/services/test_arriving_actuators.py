"""While a task rests on an agent, dormant and in doubt, nobody takes the actuators that it will need."""

from typing import ClassVar

import pytest

from pancakes.control import Migrate, Start, Stop
from pancakes.devices import Twist
from pancakes.devices.driver import Actuator
from pancakes.durable.record import TaskId
from pancakes.durable.register import Standing
from pancakes.mesh.memory_network import Quality
from pancakes.packet import SYSCTRL
from pancakes.task import Task, every
from pancakes.testing import Fleet


class Circle(Task):
    requires = ("motors",)

    @every(hz=10)
    def drive(self, tick):
        self.publish("ctrl", Twist(0.1, 0.0))


class Home(Circle):
    pass


WHEELS = {"wheels": "null.motors"}
KEPT = "wheels is kept for b/client/Circle, which is about to start"


@pytest.fixture
def fleet():
    with Fleet(7, classes={"test.Circle": Circle}) as made:
        made.start("a", devices=WHEELS, tasks={"Circle": Circle})
        made.start("b", devices=WHEELS, tasks={"Home": {"type": Home, "start": False}})
        made.connect()
        made.network.set_quality("a", "b", Quality(latency_s=0.05))
        yield made


def phase(fleet, agent):
    return fleet.agents[agent].component("client").places[TaskId("a", "Circle")].record.standing


def until_prepared(fleet):
    """Runs until `b` has the snapshot on disk, and parts the two before `a` can hear of it."""
    fleet.agents["a"].publish(SYSCTRL, Migrate("Circle"))
    assert fleet.run_until(
        lambda: (
            fleet.agents["b"].component("client").places.get(TaskId("a", "Circle")) is not None
            and phase(fleet, "b") is Standing.HEIR
        )
    )
    fleet.network.partition(["a"], ["b"])


def test_a_local_start_does_not_take_them(fleet):
    until_prepared(fleet)
    b = fleet.agents["b"]
    assert b.ask(Start("Home")).reason == KEPT
    assert b.kernel.registry.holder("wheels") == ""


def test_on_abort_they_are_given_back(fleet):
    until_prepared(fleet)
    fleet.run_for(5.0)
    assert phase(fleet, "a") is Standing.OWNER  # it took the task back, and `b` cannot know
    assert fleet.agents["b"].ask(Start("Home")).reason == KEPT
    fleet.network.heal()
    assert fleet.run_until(lambda: phase(fleet, "b") is Standing.RELEASED, 30.0)
    fleet.run_for(0.1)
    assert fleet.agents["b"].ask(Start("Home")).ok


def test_they_stay_kept_over_a_restart_of_the_agent(fleet):
    until_prepared(fleet)
    fleet.crash("b")
    b = fleet.restart("b")
    assert phase(fleet, "b") is Standing.HEIR
    assert b.ask(Start("Home")).reason == KEPT


def test_the_task_has_them_once_it_runs(fleet):
    b = fleet.agents["b"]
    assert fleet.agents["a"].ask(Migrate("Circle")).ok
    fleet.run_for(1.0)
    assert b.kernel.registry.holder("wheels") == "b/client/Circle"
    assert b.ask(Start("Home")).reason == "wheels is held by b/client/Circle"


def test_a_task_whose_actuators_were_taken_after_the_bid_stays_where_it_is(fleet):
    a, b = fleet.agents["a"], fleet.agents["b"]
    moving = a.publish(SYSCTRL, Migrate("Circle"))
    assert fleet.run_until(lambda: phase(fleet, "a") is Standing.OFFERED)
    assert b.ask(Start("Home"), timeout_s=0.02).ok
    assert "wheels is held by b/client/Home" in a.reply_to(moving).reason
    assert a.running() == ["Circle"]
    assert b.running() == ["Home"]


def test_a_remote_claim_does_not_take_them(fleet):
    """Another agent's virtual actuator may hold wheels that nobody holds, but not those."""
    remote = {"type": "network.motors", "settings": {"target": "b/device/wheels"}}
    fleet.start("c", devices={"wheels": remote}, tasks={"Far": {"type": Circle, "start": False}})
    fleet.connect()
    fleet.network.set_quality("a", "b", Quality(latency_s=0.05))
    until_prepared(fleet)
    assert fleet.agents["c"].ask(Start("Far")).ok
    fleet.run_for(1.0)
    b = fleet.agents["b"]
    assert b.kernel.registry.holder("wheels") == ""
    assert b.events("command_refused", by="c/device/wheels")[0]["reason"] == "it is held by b/client/Circle"


class Look(Task):
    """Needs no actuator."""


def test_a_task_that_needs_no_actuator_may_start_whatever_others_hold():
    with Fleet(7) as fleet:
        a = fleet.start("a", devices=WHEELS, tasks={"Circle": Circle, "Look": {"type": Look, "start": False}})
        fleet.run_for(0.5)
        assert a.kernel.registry.holder("wheels") == "a/client/Circle"
        assert a.ask(Start("Look", dry_run=True)).ok and a.ask(Start("Look")).ok


class Wheels(Actuator):
    """Wheels that remember how fast they were told to go."""

    type = "motors"
    told: ClassVar[list[float]] = []

    def write(self, command, valid_s, source):
        Wheels.told.append(command.v_mps)

    def safe_stop(self):
        pass


class LastWord(Circle):
    """Commands once more as it ends."""

    def on_stop(self):
        self.publish("ctrl", Twist(0.9, 0.0))


@pytest.mark.parametrize(("moves", "told"), [(True, False), (False, True)])
def test_what_a_task_commands_as_it_ends_reaches_no_wheel_where_it_was_handed_over(moves, told):
    Wheels.told.clear()
    with Fleet(2, classes={"test.LastWord": LastWord}) as fleet:
        a = fleet.start("a", devices={"wheels": Wheels}, tasks={"LastWord": LastWord})
        fleet.start("b", devices=WHEELS)
        fleet.connect()
        fleet.run_for(1.0)
        assert a.ask(Migrate("LastWord") if moves else Stop("LastWord")).ok
        fleet.run_for(1.0)
        assert 0.1 in Wheels.told and (0.9 in Wheels.told) is told
