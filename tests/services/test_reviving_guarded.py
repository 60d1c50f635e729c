"""A task of a lost agent goes on from a checkpoint that another agent holds, or as it stands without its guardians."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from services.counting import Count
from services.numbered import Sink

from pancakes.control import Checkpoints, Describe, HeldCheckpoint, Revive
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Standing
from pancakes.journal.journal import MARK
from pancakes.testing import Fleet

COUNT = TaskId("a", "Count")
GUARDED = {
    "Count": {
        "type": "test.Count",
        "guard": {"copies": 3, "lease_s": 2.0, "checkpoint_s": 0.5, "guardians": ["b", "c"]},
    }
}


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet(seed=5, classes={"test.Count": Count, "test.Sink": Sink}) as made:
        made.start("a", tasks=GUARDED)
        for name in "bcd":
            made.start(name)
        made.connect()
        assert made.run_until(lambda: guards(made, "a") == [["a", "b", "c"]], 10)
        made.run_for(3.0)
        yield made


def record(fleet: Fleet, name: str) -> Record:
    found = fleet.agents[name].agent.records.get(COUNT)
    assert found is not None
    return found


def guards(fleet: Fleet, name: str) -> list[list[str]]:
    return [sorted(one.agent for one in members) for members in record(fleet, name).register.sets]


def where(fleet: Fleet) -> list[str]:
    return [name for name, agent in fleet.agents.items() if "Count" in agent.running("client")]


def held(fleet: Fleet, name: str) -> dict[str, Any]:
    (row,) = fleet.agents[name].ask(Checkpoints("Count", body=True)).result
    found: dict[str, Any] = row
    return found


def from_held(row: dict[str, Any], **others: Any) -> Revive:
    checkpoint = HeldCheckpoint(row["snapshot"], tuple(row["epoch"]), row["no"], f"what {row['agent']} holds")
    return Revive(row["task_id"], service=row["service"], checkpoint=checkpoint, seen=row["seen"], **others)


def most_are_lost(fleet: Fleet) -> tuple[dict[str, Any], int]:
    """The owner and a guardian are gone; returns what the other guardian holds, and how far the task was."""
    n: int = fleet.agents["a"].task("Count").state.n
    fleet.crash("a")
    fleet.crash("b")
    fleet.run_for(6.0)
    assert where(fleet) == []
    return held(fleet, "c"), n


def test_a_guardian_tells_what_it_holds_and_how_old_that_is(fleet: Fleet):
    row = held(fleet, "c")
    assert (row["task_id"], row["agent"], row["held"], row["epoch"]) == ("a/Count", "c", "guardian", [0, "a"])
    assert (row["type"], row["service"], row["wanted"], row["at_least"]) == ("test.Count", "client", "running", False)
    assert row["no"] > 1 and row["age_s"] < 1.5 and row["guardians"] == [["a", "b", "c"]] and row["snapshot"]
    assert fleet.agents["d"].ask(Checkpoints("Count")).result == []
    assert fleet.agents["c"].ask(Checkpoints("Count", "b")).result == []
    assert "snapshot" not in fleet.agents["c"].ask(Checkpoints("Count", "a")).result[0]
    fleet.crash("a")
    fleet.crash("b")
    fleet.run_for(60.0)
    assert 60.0 < held(fleet, "c")["age_s"] < 62.0


def test_a_guardian_that_began_anew_says_that_a_checkpoint_may_be_older(fleet: Fleet):
    most_are_lost(fleet)
    fleet.crash("c")
    fleet.restart("c")
    fleet.run_for(1.0)
    row = held(fleet, "c")
    assert row["at_least"] and row["age_s"] < 2.0


def test_it_goes_on_from_a_checkpoint_that_a_guardian_holds(fleet: Fleet):
    row, n = most_are_lost(fleet)
    d = fleet.agents["d"]
    assert d.ask(from_held(row, dry_run=True)).ok and where(fleet) == []
    revived = d.ask(from_held(row))
    assert revived.ok, revived.reason
    assert fleet.run_until(lambda: where(fleet) == ["d"], 2.0)
    assert d.task("Count").state.n >= n - 10
    assert record(fleet, "d").epoch.n == 1_000_000
    assert d.ask(Describe("client/Count")).result["fence"]["epoch"] == 1_000_000


def test_the_lost_agent_stands_still_when_it_is_back_though_half_of_its_guardians_would_follow_it(fleet: Fleet):
    row, _ = most_are_lost(fleet)
    assert fleet.agents["d"].ask(from_held(row)).ok
    fleet.run_for(1.0)
    a = fleet.restart("a")
    fleet.restart("b")
    fleet.run_for(1.0)
    fleet.connect()
    fleet.run_for(8.0)
    assert record(fleet, "a").wanted.value == "disputed" and record(fleet, "d").standing is Standing.OWNER
    assert any("it is paused here, and runs on d" in line for line in a.lines("error"))
    stood = a.ask(Describe("client/Count")).result
    assert (stood["state"], stood["rest"]) == ("stopped", "disputed")
    n = fleet.agents["d"].task("Count").state.n
    fleet.run_for(3.0)
    assert fleet.agents["d"].task("Count").state.n > n + 20
    assert "d" in guards(fleet, "d")[0] and len(guards(fleet, "d")[0]) == 3


def test_it_goes_on_as_it_stands_where_its_guardians_are_gone_for_good(fleet: Fleet):
    a = fleet.agents["a"]
    fleet.crash("b")
    fleet.crash("c")
    assert fleet.run_until(lambda: bool(a.events("permit_lost")), 5.0)
    stood = a.task("Count").state.n
    assert a.ask(Revive("a/Count", dry_run=True)).ok and record(fleet, "a").epoch.n == 0
    revived = a.ask(Revive("a/Count"))
    assert revived.ok and revived.result["task_id"] == "a/Count"
    assert record(fleet, "a").epoch.n == 1_000_000 and guards(fleet, "a") == [["a"]]
    fleet.run_for(2.0)
    assert a.task("Count").state.n > stood + 10
    assert a.component("client/Count").fence.epoch == (1_000_000, "a")
    fleet.restart("b")
    fleet.restart("c")
    fleet.connect()
    fleet.run_for(10.0)
    assert where(fleet) == ["a"] and len(guards(fleet, "a")[0]) == 3
    assert "is known on a" in a.ask(Revive("a/Count")).reason


def test_guardians_that_were_not_gone_after_all_have_their_owner_stand_still_once_they_are_linked(fleet: Fleet):
    a = fleet.agents["a"]
    fleet.faults.cut("a")
    fleet.run_for(10.0)
    assert a.ask(Revive("a/Count")).ok
    fleet.run_for(3.0)
    taker = next(name for name in where(fleet) if name != "a")
    fleet.faults.calm()
    fleet.run_for(8.0)
    assert record(fleet, taker).wanted.value == "disputed" and where(fleet) == ["a"]
    n = a.task("Count").state.n
    fleet.run_for(2.0)
    assert a.task("Count").state.n > n + 10


def test_an_owner_from_an_old_disk_does_not_go_on_without_its_guardians(fleet: Fleet):
    a, row = fleet.agents["a"], held(fleet, "c")
    fleet.crash("b")
    fleet.crash("c")
    assert fleet.run_until(lambda: bool(a.events("permit_lost")), 5.0)
    refused = a.ask(from_held({**row, "no": 10_000}))
    assert not refused.ok and "from an old copy of its disk, older than what c holds" in refused.reason


def test_where_all_disks_are_copies_a_person_has_the_task_go_on(fleet: Fleet):
    n = fleet.agents["a"].task("Count").state.n
    for name in "abcd":
        fleet.crash(name)
        del fleet.disk(name)[MARK]
    for name in "abcd":
        fleet.restart(name)
    fleet.connect()
    fleet.run_for(80.0)  # longer than after which a silent guardian is replaced
    a = fleet.agents["a"]
    assert where(fleet) == [] and not a.events("guards_chosen")
    assert any("`pancakes task recover a/Count` does" in line for line in a.lines("warning"))
    assert a.ask(Revive("a/Count")).ok
    fleet.run_for(5.0)
    assert where(fleet) == ["a"] and a.task("Count").state.n >= n - 10
    assert guards(fleet, "a") == [["a", "b", "c"]]
    fleet.crash("a")
    fleet.run_for(8.0)
    assert where(fleet) in (["b"], ["c"], ["d"])
