"""The state directory of an agent was copied to another disk: what becomes of its unguarded tasks."""

from collections.abc import Iterator

import pytest
from services.counting import Count

from pancakes.control import Describe, Migrate, Start, Stop
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Standing
from pancakes.journal.journal import MARK
from pancakes.testing import AgentHandle, Fleet

COUNT = TaskId("a", "Count")


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet(seed=5, classes={"test.Count": Count}) as made:
        made.start("a", tasks={"Count": {"type": Count}})
        made.start("b")
        made.connect()
        made.run_for(1.0)
        yield made


def record(fleet: Fleet) -> Record:
    found = fleet.agents["a"].agent.records.get(COUNT)
    assert found is not None
    return found


def copied(fleet: Fleet) -> AgentHandle:
    """Start a again, on a copy of its disk."""
    if "a" in fleet.agents:
        fleet.crash("a")
    fleet.disk("a").pop(MARK)
    a = fleet.restart("a")
    fleet.run_for(5.0)
    return a


def test_task_continues_on_a_copied_disk_under_a_new_epoch(fleet: Fleet):
    before = record(fleet).epoch
    a = copied(fleet)
    assert a.running() == ["Count"] and record(fleet).epoch > before
    assert not [line for line in a.lines("warning") if "does not start" in line]


def test_task_that_was_stopped_stays_stopped_on_a_copied_disk(fleet: Fleet):
    assert fleet.agents["a"].ask(Stop("Count")).ok
    a = copied(fleet)
    assert a.running() == []
    assert a.ask(Start("Count")).ok and a.running() == ["Count"]


def test_task_that_was_given_away_starts_on_no_copied_disk(fleet: Fleet):
    """It was promised to b, which is off and has it on its disk."""
    a = fleet.agents["a"]
    a.publish("sysctrl", Migrate("Count", to="b"))
    assert fleet.run_until(lambda: record(fleet).standing is Standing.YIELDED, 5.0)
    fleet.crash("a")
    fleet.run_for(1.0)
    assert fleet.agents["b"].running() == ["Count"]
    fleet.crash("b")
    a = copied(fleet)
    assert not a.ask(Start("Count")).ok and a.running() == []
    assert a.ask(Describe(target="Count")).result["rest"] == "moved → b"


def test_task_that_went_on_after_the_copy_was_made_starts_nowhere_else(fleet: Fleet):
    """A backup of the files is restored; b, which has the task by now, is asked before it starts."""
    fleet.stop("a")
    a = fleet.start("a", tasks={"Count": {"type": Count}}, peers=("tcp://b:7400",), birth_wait_s=10.0)
    fleet.connect()
    fleet.run_for(1.0)
    backup = dict(fleet.disk("a"))
    assert a.ask(Migrate("Count", to="b")).ok
    fleet.run_for(1.0)
    fleet.crash("a")
    disk = fleet.disk("a")
    disk.clear()
    disk.update(backup)
    disk.pop(MARK)
    disk.pop("lock")
    a = fleet.restart("a")
    assert a.running() == [] and "waits" in a.ask(Describe(target="Count")).result["rest"]
    fleet.connect()
    fleet.run_for(5.0)
    assert a.running() == [] and fleet.agents["b"].running() == ["Count"]
    assert a.ask(Describe(target="Count")).result["rest"] == "old copy"
    assert record(fleet).owned is False


def test_task_born_elsewhere_continues_on_a_copied_disk(fleet: Fleet):
    assert fleet.agents["a"].ask(Migrate("Count", to="b")).ok
    fleet.run_for(3.0)
    fleet.crash("b")
    fleet.disk("b").pop(MARK)
    b = fleet.restart("b")
    fleet.connect()
    assert fleet.run_until(lambda: b.running() == ["Count"], 10.0)
    found = b.agent.records.get(COUNT)
    assert found is not None and found.owned and b.task("Count").state.n > 10
    assert b.ask(Migrate("Count", to="a")).ok
    assert fleet.run_until(lambda: fleet.agents["a"].running() == ["Count"], 5.0)
