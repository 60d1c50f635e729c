"""Adopting: what a person may do with a task whose migration is in doubt, because the other agent is gone."""

import pytest
from services.counting import Count

from pancakes.control import Adopt, Describe, Migrate, Migrations, Stop
from pancakes.durable.record import TaskId
from pancakes.durable.register import Standing
from pancakes.mesh.memory_network import Quality
from pancakes.packet import SYSCTRL
from pancakes.simulation.fleet import DISK_FULL
from pancakes.testing import Fleet


@pytest.fixture
def fleet():
    with Fleet(5, classes={"test.Count": Count}) as made:
        made.start("a", tasks={"Count": Count}, services={"network": {"restart": {"policy": "no"}}})
        made.start("b")
        made.connect()
        made.network.set_quality("a", "b", Quality(latency_s=0.02))
        yield made


def phase(fleet, agent):
    place = fleet.agents[agent].component("client").places.get(TaskId("a", "Count"))
    return place.record.standing if place is not None else Standing.NONE


def until(fleet, condition):
    """Runs step by step, so that the moment is caught as it comes."""
    begin_s = fleet.now()
    while not condition():
        assert fleet.dispatcher.step() and fleet.now() < begin_s + 20.0


def committed_and_alone(fleet):
    """a has given Count to b, which dies before it hears so; returns a, and the packet that asked for the move."""
    a = fleet.agents["a"]
    fleet.run_for(2.0)
    moving = a.publish(SYSCTRL, Migrate("Count"))
    until(fleet, lambda: phase(fleet, "a") is Standing.YIELDED)
    fleet.crash("b")
    fleet.run_for(6.0)
    assert a.running() == []
    return a, moving


def prepared_and_alone(fleet):
    """b has the snapshot of Count, and a dies before it has decided."""
    fleet.run_for(2.0)
    fleet.agents["a"].publish(SYSCTRL, Migrate("Count"))
    until(fleet, lambda: phase(fleet, "b") is Standing.HEIR)
    fleet.crash("a")
    fleet.run_for(6.0)
    return fleet.agents["b"]


def test_who_gave_it_away_takes_it_back_with_its_state(fleet):
    a, moving = committed_and_alone(fleet)

    reply = a.ask(Adopt("Count"))

    assert reply.ok and reply.result == {"task_id": "a/Count", "peer": "b"}
    assert a.running() == ["Count"]
    assert a.task("Count").state.n >= 20
    record = a.component("client").places[TaskId("a", "Count")].record
    assert (record.standing, record.epoch.n > 1_000_000, record.epoch.minter.agent) == (Standing.OWNER, True, "a")
    assert a.events("task_adopted") == [{"kind": "task_adopted", "task": "Count", "peer": "b", "epoch": 1_000_001}]
    # Whoever had asked for the move hears what became of it, and so does the account.
    assert "a/Count was adopted on a" in a.reply_to(moving).reason
    (account,) = a.ask(Migrations()).result
    assert account["outcome"] == "undecided" and "was adopted on a" in account["reason"]
    # It is a task like any other: it outlives a crash, and may be stopped.
    fleet.crash("a")
    a = fleet.restart("a")
    assert a.running() == ["Count"]
    assert a.ask(Stop("Count")).ok


def test_who_was_to_get_it_takes_it(fleet):
    b = prepared_and_alone(fleet)
    assert [row["task"] for row in b.ask(Describe()).result["tasks"] if row["service"] == "client"] == []

    assert b.ask(Adopt("client/Count")).ok

    assert b.running() == ["Count"]
    assert b.task("Count").state.n >= 20


def test_it_can_be_adopted_after_the_agent_in_doubt_was_started_anew(fleet):
    prepared_and_alone(fleet)
    fleet.crash("b")
    b = fleet.restart("b")

    assert b.ask(Adopt("Count")).ok
    assert b.task("Count").state.n >= 20


def test_the_one_that_is_gone_may_be_set_up_anew_with_an_empty_disk_afterwards(fleet):
    b = prepared_and_alone(fleet)
    assert b.ask(Adopt("Count")).ok
    fleet.disk("a").clear()
    fleet.start("a")
    fleet.connect()

    fleet.run_for(30.0)

    assert fleet.agents["a"].running() == [] and b.running() == ["Count"]
    assert b.ask(Migrate("Count")).ok
    assert fleet.agents["a"].running() == ["Count"]


def test_while_the_other_is_connected_it_is_refused(fleet):
    a = fleet.agents["a"]
    fleet.network.set_quality("a", "b", Quality(latency_s=0.2))
    a.publish(SYSCTRL, Migrate("Count"))
    until(fleet, lambda: phase(fleet, "a") is Standing.YIELDED)

    reply = a.ask(Adopt("Count"))

    assert not reply.ok and reply.reason.startswith("a/Count is not adopted: b is connected, so it is not gone")
    fleet.run_for(3.0)
    assert a.running() == [] and fleet.agents["b"].running() == ["Count"]


def test_while_the_network_sleeps_nobody_knows_who_is_there(fleet):
    a, _ = committed_and_alone(fleet)
    a.component("network/TaskMigrator").stop()
    a.component("network").close()
    fleet.run_for(1.0)

    assert "it is unknown whether b is there" in a.ask(Adopt("Count")).reason


def test_there_must_be_a_doubt(fleet):
    a, b = fleet.agents["a"], fleet.agents["b"]
    assert a.ask(Adopt("Count")).reason == "there is nothing to adopt: a/Count is here already"
    assert a.ask(Migrate("Count")).ok
    fleet.run_for(1.0)
    assert a.ask(Adopt("Count")).reason == "a/Count is not adopted: b is connected, and owns it (epoch 1@b)"
    assert a.ask(Adopt("client/Other")).reason == "a/client knows of no task 'Other'"
    assert a.ask(Adopt("Count", birthplace="c")).reason == "a/client knows of no task 'Count' of c"
    assert a.ask(Adopt("client/")).reason == "a/client is a service: name one of its tasks"
    assert a.ask(Adopt("Other")).reason == "a has no task or service 'Other'"
    assert b.running() == ["Count"]


def test_where_it_cannot_run_it_is_said_that_it_was_adopted_all_the_same():
    class Drive(Count):
        requires = ("motors",)

    with Fleet(5, classes={"test.Drive": Drive}) as fleet:
        fleet.start("a", devices={"wheels": "null.motors"}, tasks={"Count": Drive})
        fleet.start("b", devices={"wheels": "null.motors"})
        fleet.connect()
        b = prepared_and_alone(fleet)
        assert b.ask(Stop("wheels")).ok

        reply = b.ask(Adopt("Count"))

        assert not reply.ok
        assert reply.reason.startswith("a/Count belongs to b now, but does not run: b lacks the device types motors")
        assert phase(fleet, "b") is Standing.OWNER


def test_a_disk_that_is_full_leaves_everything_as_it_was(fleet):
    a, _ = committed_and_alone(fleet)
    end = fleet.faults.fill_disk("a")

    reply = a.ask(Adopt("Count"))

    assert reply.reason == f"a/Count is not adopted: {DISK_FULL}"
    assert phase(fleet, "a") is Standing.YIELDED and a.running() == []
    end()
    assert a.ask(Adopt("Count")).ok
