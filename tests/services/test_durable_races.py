"""Durable tasks where two things happen at once: a busy disk, a start that was refused, a task that stands frozen."""

from dataclasses import dataclass

import pytest
from services.counting import Count
from services.strangers import identity, say

from pancakes.control import Migrate, Restart, Start, Stop
from pancakes.devices import Load, Twist
from pancakes.devices.driver import Actuator
from pancakes.durable.messages import Accept
from pancakes.durable.record import TaskId
from pancakes.durable.register import Epoch, Register, Standing, Wanted
from pancakes.mesh.memory_network import Quality
from pancakes.task import Task, every, on
from pancakes.testing import Fleet


class Odd(Task):
    """Keeps in its state what nobody can write down."""

    @dataclass
    class State:
        thing: float | None = None

    @every(hz=1)
    def tick(self, tick):
        self.state.thing = object()
        self.publish("system", Load(1.0))


class Drives(Task):
    """Holds the wheels while it runs."""

    requires = ("motors",)

    @on("system", Load)
    def seen(self, packet):
        self.publish("ctrl", Twist(0.1, 0.0))


class Wheels(Actuator):
    """Wheels that turn nothing."""

    type = "motors"

    def write(self, command, ttl_s, source):
        pass

    def safe_stop(self):
        pass


@pytest.fixture
def fleet():
    with Fleet(seed=5, classes={"test.wheels": Wheels}) as made:
        yield made


def place(agent, name, birthplace=""):
    return agent.component("client").places[TaskId(birthplace or agent.name, name)]


def test_a_restart_while_a_checkpoint_is_being_written_starts_the_task_again(fleet):
    agent = fleet.start("a", tasks={"Count": Count})
    found = place(agent, "Count")
    fleet.run_for(0.5)
    assert fleet.run_until(lambda: not found.course.settled)
    n = agent.task("Count").state.n
    reply = agent.ask(Restart("Count"))
    assert reply.ok, reply.reason
    assert agent.task("Count").state.n >= n
    assert found.record.wanted is Wanted.RUNNING


def test_a_state_that_cannot_be_written_down_is_told_and_does_not_end_the_task(fleet):
    agent = fleet.start("a", tasks={"Odd": Odd})
    fleet.run_for(3.5)
    assert any("what a/client/Odd carries cannot be written down" in line for line in agent.lines("error"))
    assert not agent.events("task_failed")
    assert len(agent.probe.packets(Load, source="a/client/Odd")) == 3


def test_a_task_whose_start_was_refused_can_be_started_once_its_actuator_is_free(fleet):
    # Both are admitted, both are written down; then the first one gets the wheels.
    agent = fleet.start("a", devices={"motors": "test.wheels"}, tasks={"Other": Drives, "Drives": Drives})
    fleet.run_for(1.0)
    assert agent.running() == ["Other"]
    assert any("was not started: motors is held by a/client/Other" in line for line in agent.lines("error"))
    assert agent.ask(Stop("Other")).ok
    reply = agent.ask(Start("Drives"))
    assert reply.ok, reply.reason
    assert agent.running() == ["Drives"]


def test_a_task_whose_start_was_refused_starts_by_itself_once_its_actuator_is_free(fleet):
    agent = fleet.start("a", devices={"motors": "test.wheels"}, tasks={"Other": Drives, "Drives": Drives})
    fleet.run_for(1.0)
    assert agent.ask(Stop("Other")).ok
    fleet.run_for(1.5)
    assert agent.running() == ["Drives"]


def test_a_task_whose_start_was_refused_can_be_stopped_for_good(fleet):
    agent = fleet.start("a", devices={"motors": "test.wheels"}, tasks={"Other": Drives, "Drives": Drives})
    fleet.run_for(1.0)
    assert agent.ask(Stop("Drives")).ok
    assert agent.ask(Stop("Other")).ok
    fleet.run_for(3.0)
    assert agent.running() == []
    assert place(agent, "Drives").record.wanted is Wanted.STOPPED


def _move(fleet, task="Count", to="b"):
    return fleet.agents["a"].publish("sysctrl", Migrate(task, to=to))


def test_a_stop_during_a_migration_takes_the_offer_back(fleet):
    a = fleet.start("a", tasks={"Count": Count})
    b = fleet.start("b")
    fleet.connect()
    fleet.network.set_quality("a", "b", Quality(latency_s=0.05))
    found = place(a, "Count")
    asked = _move(fleet)
    assert fleet.run_until(lambda: found.record.standing is Standing.OFFERED)
    assert a.ask(Stop("Count")).ok
    refused = a.reply_to(asked)
    assert not refused.ok and "the task was stopped" in refused.reason
    fleet.run_for(5.0)
    assert a.running() == b.running() == []
    assert found.record.standing is Standing.OWNER and found.record.wanted is Wanted.STOPPED


def test_a_task_that_comes_back_before_its_old_actor_has_ended_runs_once(fleet):
    a = fleet.start("a", tasks={"Count": {"type": Count, "restart": {"policy": "no"}}})
    fleet.start("b")
    fleet.connect()
    late = []
    # Its actor on `a` takes long to end: the stop that belongs to the hand-off is held back.
    before = a.component("client/Count")
    stop = before.stop
    before.stop = lambda: late.append(stop)
    assert a.reply_to(_move(fleet)).ok
    fleet.run_for(0.1)
    assert late and a.running() == ["Count"]
    back = fleet.agents["b"].publish("sysctrl", Migrate("Count", to="a"))
    fleet.run_for(1.5)
    late[0]()
    assert fleet.agents["b"].reply_to(back).ok
    fleet.run_for(0.5)
    assert a.running() == ["Count"] and fleet.agents["b"].running() == []
    assert a.component("client/Count") is not before
    assert place(a, "Count").record.standing is Standing.OWNER
    assert not a.events("task_failed")
    n = a.task("Count").state.n
    fleet.run_for(1.0)
    assert a.task("Count").state.n == n + 10


def test_what_moves_names_every_setting_and_the_whole_state_defaults_too(fleet):
    a = fleet.start("a", tasks={"Count": Count})
    b = fleet.start("b")
    fleet.connect()
    assert a.task("Count").state.n == 0
    assert a.reply_to(_move(fleet)).ok
    assert b.wait_for_event("task_arrived")["state"] == {"n": 0}


def test_a_transfer_that_comes_late_brings_no_second_arrival(fleet):
    a = fleet.start("a", tasks={"Count": Count})
    b = fleet.start("b")
    fleet.connect()
    assert a.reply_to(_move(fleet)).ok
    record, me = place(b, "Count", "a").record, identity(fleet, "a")
    offer = Register(Epoch(0, me), 5, ((me,),), heir=identity(fleet, "b"))
    late = Accept(record.task_id, record.type, "client", offer, to=offer.heir, state=record.snapshot)
    say(fleet, "a", late, "b")
    fleet.run_for(0.1)
    assert b.ask(Restart("Count")).ok
    assert len(b.events("task_arrived")) == 1


def test_a_service_that_fails_in_the_middle_of_a_move_leaves_the_network_free_to_sleep(fleet):
    a = fleet.start("a", tasks={"Count": Count})
    fleet.start("b")
    fleet.connect()
    fleet.network.set_quality("a", "b", Quality(latency_s=0.1))
    service = a.component("client")
    _move(fleet)
    assert fleet.run_until(lambda: not a.ask(Stop("network", dry_run=True)).ok)

    def fails():
        raise RuntimeError("no luck")

    a.may_fail.add("client")
    service.call(fails)
    fleet.run_for(5.0)
    assert a.component("client") is not service
    assert a.ask(Stop("network", for_s=1.0)).ok
