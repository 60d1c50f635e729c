"""A task whose agent is gone for good runs again on another, as a person describes it."""

from __future__ import annotations

import pytest
from services.numbered import Numbered, Sink

from pancakes.control import Checkpoints, Describe, HeldCheckpoint, Migrate, Revive, Start
from pancakes.durable.record import TaskId
from pancakes.durable.register import Standing
from pancakes.packet import SYSCTRL, task_address
from pancakes.testing import Fleet

SINK = Revive("a/Sink", "test.Sink")


@pytest.fixture
def fleet():
    with Fleet(seed=8, classes={"test.Sink": Sink}) as made:
        yield made


def lost(fleet):
    """An agent that had the task is gone; returns another, which never had to do with it."""
    fleet.start("a", tasks={"Sink": {"type": "test.Sink"}})
    b = fleet.start("b")
    fleet.connect()
    fleet.crash("a")
    fleet.run_for(3.0)
    return b


def test_it_runs_again_and_packets_reach_it_under_an_epoch_above_all(fleet):
    b = lost(fleet)
    b.publish("system", Numbered(1), to=task_address("a/Sink"))
    dry = b.ask(Revive("a/Sink", "test.Sink", dry_run=True))
    assert dry.ok and b.running("client") == []
    revived = b.ask(SINK)
    assert revived.ok, revived.reason
    fleet.run_for(5.0)
    assert b.task("Sink").state.numbers == [1]
    assert b.ask(Describe(target="Sink")).result["fence"] == {"task_id": "a/Sink", "epoch": 1_000_000}


def test_the_lost_agent_stands_still_when_it_is_back(fleet):
    b = lost(fleet)
    assert b.ask(SINK).ok
    a = fleet.restart("a")
    fleet.connect()
    fleet.run_for(1.0)
    found = a.ask(Describe(target="Sink")).result
    assert (found["state"], found["rest"]) == ("stopped", "disputed") and b.running("client") == ["Sink"]


def test_where_its_owner_is_there_it_is_not_revived(fleet):
    fleet.start("a", tasks={"Sink": {"type": "test.Sink"}})
    b = fleet.start("b")
    fleet.connect()
    fleet.run_for(1.0)
    refused = b.ask(SINK)
    assert not refused.ok and "a is connected, and owns it (epoch 0@a)" in refused.reason
    assert "is known on a" in fleet.agents["a"].ask(SINK).reason


def test_an_agent_that_gave_it_away_can_revive_it(fleet):
    a = fleet.start("a", tasks={"Sink": {"type": "test.Sink"}})
    fleet.start("b")
    fleet.connect()
    assert a.ask(Migrate("Sink")).ok
    fleet.run_for(2.0)
    fleet.crash("b")
    fleet.run_for(3.0)
    assert a.ask(SINK).ok
    fleet.run_for(1.0)
    assert a.running("client") == ["Sink"]


class Drives(Sink):
    """Needs what another may need."""

    requires = ("motors",)


def test_what_was_only_asked_for_keeps_no_actuators(fleet):
    b = fleet.start(
        "b",
        devices={"motors": "null.motors"},
        tasks={"Other": {"type": Drives, "start": False}},
        classes={"test.Drives": Drives},
    )
    asked = Revive("a/Sink", "test.Drives", dry_run=True)
    assert b.ask(asked).ok
    started = b.ask(Start("Other"))
    assert started.ok, started.reason
    assert "is held by" in b.ask(Revive("a/Sink", "test.Drives")).reason


@pytest.mark.parametrize(
    ("body", "why"),
    [
        (Revive("a/Sink", "test.Nothing"), "test.Nothing"),
        (Revive("Sink", "test.Sink"), "is no task id"),
        (Revive("a/Sink", "test.Sink", settings={"x": 1}), "cannot run on b"),
        (Revive("a/Sink", "test.Sink", service="device"), "cannot be asked for revive"),
        (Revive("a/Sink", "test.Sink", service="nothing"), "is not there"),
    ],
)
def test_what_cannot_be_is_said_and_nothing_is_left_of_it(fleet, body, why):
    b = lost(fleet)
    refused = b.ask(body)
    assert not refused.ok and why in refused.reason
    assert b.running("client") == []
    assert b.ask(SINK).ok


def test_it_goes_on_from_the_snapshot_of_a_hand_off_that_is_in_doubt(fleet):
    a = fleet.start("a", tasks={"Sink": {"type": "test.Sink"}})
    d = fleet.start("d")
    fleet.start("b")
    fleet.connect()
    a.publish("system", Numbered(7), to=task_address("a/Sink"))
    fleet.run_for(2.0)
    fleet.agents["a"].publish(SYSCTRL, Migrate("Sink", to="b"))
    record = fleet.agents["b"].agent.records.get
    while record(TaskId("a", "Sink")) is None or record(TaskId("a", "Sink")).standing is not Standing.HEIR:
        assert fleet.dispatcher.step()
    fleet.crash("a")
    fleet.run_for(3.0)
    (row,) = fleet.agents["b"].ask(Checkpoints("Sink", body=True)).result
    assert fleet.agents["b"].ask(Checkpoints("Other")).result == []
    assert (row["held"], row["epoch"], row["no"]) == ("in doubt", [0, "a"], 2)
    assert (row["age_s"], row["type"]) == (None, "test.Sink")
    held = HeldCheckpoint(row["snapshot"], (1, "a"), 0, "the snapshot that b holds")
    revived = d.ask(Revive("a/Sink", checkpoint=held, seen=row["seen"]))
    assert revived.ok, revived.reason
    assert d.task("Sink").state.numbers == [7]
    assert d.ask(Describe(target="Sink")).result["fence"]["epoch"] == 1_000_000
    assert "see `pancakes task recover b/Sink`" in fleet.agents["b"].ask(Revive("a/Sink", checkpoint=held)).reason
