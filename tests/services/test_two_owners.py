"""Two agents own one task: that is noticed when they are linked, and only the one with the higher right goes on."""

from __future__ import annotations

import pytest
from msgspec.structs import replace
from services.numbered import Sink
from services.test_what_other_versions_left import change_record

from pancakes.control import Adopt, Describe, Forget, Migrate, Restart, Start, Stop
from pancakes.durable.census import CENSUS, Census, NeighbourUp
from pancakes.durable.ownership import Owned, OwnerClaim
from pancakes.durable.record import Epoch, Phase, Record, TaskId
from pancakes.durable.snapshot import Snapshot
from pancakes.packet import NETWORK
from pancakes.testing import Fleet

TASKS = {"Sink": Sink}


@pytest.fixture
def fleet():
    with Fleet(seed=5) as made:
        yield made


def state(agent):
    found = agent.ask(Describe(target="Sink")).result
    return found["state"], found["rest"]


def copy_of(fleet, name):
    """What is on an agent's disk, without the lock of its process."""
    return {file: data for file, data in fleet.disk(name).items() if file != "lock"}


def put(fleet, name, disk):
    fleet.disk(name).clear()
    fleet.disk(name).update(disk)


def moved(fleet):
    """Two agents, of which a had the task, and b has it; and the disk of a before that."""
    a = fleet.start("a", tasks=TASKS)
    b = fleet.start("b", classes={"Sink": Sink})
    fleet.connect()
    before = copy_of(fleet, "a")
    assert a.ask(Migrate("Sink")).ok
    fleet.run_for(2.0)
    return a, b, before


def restored(fleet):
    """As `moved`, and the disk of a is as it was before, and a has started again."""
    _, b, before = moved(fleet)
    fleet.crash("a")
    put(fleet, "a", before)
    a = fleet.restart("a")
    fleet.connect()
    fleet.run_for(1.0)
    return a, b


def test_of_two_owners_the_one_with_the_lower_epoch_stands_still_and_both_say_so(fleet):
    a, b = restored(fleet)
    assert state(a) == ("stopped", "disputed") and state(b)[0] == "running"
    (here,) = a.events("task_disputed")
    (there,) = b.events("task_disputed")
    assert (here["peer"], here["stands_still"], there["peer"], there["stands_still"]) == ("b", True, "a", False)
    assert any("it stands still here, and goes on on b" in line for line in a.lines())


def test_it_rests_over_a_restart_and_a_start_is_refused(fleet):
    a, _ = restored(fleet)
    refused = a.ask(Start("Sink"))
    assert not refused.ok and "a/Sink is owned by b too" in refused.reason
    fleet.crash("b")
    fleet.crash("a")
    a = fleet.restart("a")
    fleet.run_for(2.0)
    assert state(a) == ("stopped", "disputed")


def test_a_dispute_that_is_on_disk_is_not_told_again_when_the_other_owner_is_back(fleet):
    a, _ = restored(fleet)
    fleet.crash("a")
    a = fleet.restart("a")
    fleet.connect()
    fleet.run_for(2.0)
    assert state(a) == ("stopped", "disputed")
    assert a.events("task_disputed") == []


def test_adopted_it_lives_here_and_stands_still_on_the_other_agent(fleet):
    a, b = restored(fleet)
    told = a.ask(Adopt("Sink"))
    assert not told.ok and "Nothing was done" in told.reason
    assert a.ask(Adopt("Sink", force=True)).ok
    fleet.run_for(1.0)
    assert state(a)[0] == "running" and state(b) == ("stopped", "disputed")
    gave_up = b.ask(Forget("Sink", owner="a"))
    assert gave_up.ok, gave_up.reason
    fleet.run_for(1.0)
    assert a.ask(Migrate("Sink", to="b")).ok
    fleet.run_for(2.0)
    assert state(b)[0] == "running"


def test_what_is_given_up_is_gone_and_what_lives_goes_on(fleet):
    a, b = restored(fleet)
    dry = b.ask(Forget("Sink", owner="a", dry_run=True))
    assert dry.ok and dry.result == {"task_id": "a/Sink", "epoch": "1@a", "runs": True}
    assert "stop it there first" in b.ask(Forget("Sink", owner="a")).reason
    assert a.ask(Forget("Sink", owner="b")).ok
    fleet.run_for(1.0)
    assert state(b)[0] == "running"
    assert b.ask(Migrate("Sink", to="a")).ok
    fleet.run_for(2.0)
    assert state(a)[0] == "running"
    assert not a.ask(Forget("Sink", owner="b")).ok, "it owns it alone"


def test_what_rests_without_its_class_is_given_up_too(fleet):
    a, _ = restored(fleet)
    journal = a.agent.mesh.identity.journal
    fleet.crash("a")

    def gone(record):
        return replace(record, snapshot=replace(Snapshot.decode(record.snapshot), type="test.Gone").encode())

    change_record(fleet.disk("a"), journal, "Sink", gone)
    a = fleet.start("a")
    fleet.connect()
    fleet.run_for(1.0)
    assert any("unknown task type 'test.Gone'" in line for line in a.lines("error"))
    dry = a.ask(Forget("client/Sink", owner="b", dry_run=True))
    assert dry.ok and dry.result == {"task_id": "a/Sink", "epoch": "0@a", "runs": False}
    assert a.ask(Forget("client/Sink", owner="b")).ok


def test_a_birthplace_with_an_empty_disk_gives_way(fleet):
    moved(fleet)
    fleet.crash("a")
    fleet.disk("a").clear()
    a = fleet.restart("a")
    fleet.connect()
    fleet.run_for(1.0)
    assert state(a) == ("stopped", "disputed") and state(fleet.agents["b"])[0] == "running"


def test_a_birthplace_that_hears_of_the_owner_first_gives_no_birth(fleet):
    moved(fleet)
    fleet.crash("a")
    fleet.disk("a").clear()
    a = fleet.start("a", tasks={"Sink": {"type": Sink, "start": False}})
    fleet.connect()
    fleet.run_for(1.0)
    for _ in range(2):
        refused = a.ask(Start("Sink"))
        assert not refused.ok and "b owns a/Sink (epoch 1@a), of which a knows nothing" in refused.reason
        assert a.ask(Restart("client")).ok, "its successor is told again"
        fleet.run_for(1.0)


def test_a_link_that_stands_before_its_network_service_runs_is_caught_up_with(fleet, monkeypatch):
    receive = Census.take_message
    deaf = lambda census, message: None if isinstance(message, NeighbourUp) else receive(census, message)  # noqa: E731
    monkeypatch.setattr(Census, "take_message", deaf)
    a, b = restored(fleet)
    assert state(a)[0] == state(b)[0] == "running"
    assert a.ask(Restart("network/NetworkClient")).ok
    fleet.run_for(1.0)
    assert state(a) == ("stopped", "disputed") and state(b)[0] == "running"


def test_of_two_copies_of_one_disk_both_stand_still(fleet):
    """The card was cloned after a hand-off, and the clone bears the name of another agent."""
    _, b, _ = moved(fleet)
    fleet.stop("b")
    put(fleet, "c", copy_of(fleet, "b"))
    b = fleet.restart("b")
    c = fleet.start("c", classes={"Sink": Sink})
    fleet.connect()
    fleet.run_for(2.0)
    assert state(b) == ("stopped", "disputed") and state(c) == ("stopped", "disputed")


def test_one_that_was_stopped_is_disputed_too(fleet):
    _, b, before = moved(fleet)
    fleet.crash("a")
    put(fleet, "a", before)
    assert b.ask(Stop("Sink")).ok
    a = fleet.restart("a")
    fleet.connect()
    fleet.run_for(1.0)
    assert state(a) == ("stopped", "disputed") and state(b) == ("stopped", "stopped")


def test_where_the_other_owner_has_given_it_on_the_new_one_and_the_old_one_know_each_other(fleet):
    a, b = restored(fleet)
    c = fleet.start("c", classes={"Sink": Sink})
    fleet.connect()
    assert "a has a/Sink, under the epoch 0@a" in b.ask(Migrate("Sink", to="c")).reason, "a person must decide first"
    fleet.network.partition(["a"], ["c"])
    fleet.run_for(5.0)
    assert b.ask(Migrate("Sink", to="c")).ok
    fleet.network.heal()
    fleet.run_for(10.0)
    assert state(c)[0] == "running" and state(a)[1] == "disputed"
    assert c.events("task_disputed")[0]["peer"] == "a"
    assert a.ask(Adopt("Sink", force=True)).ok
    fleet.run_for(1.0)
    assert state(a)[0] == "running" and state(c) == ("stopped", "disputed")


def test_what_was_handed_over_is_owned_by_its_owner_alone(fleet):
    _, b, _ = moved(fleet)
    assert b.ask(Migrate("Sink", to="a")).ok
    fleet.run_for(2.0)
    a = fleet.agents["a"]
    assert a.ask(Migrate("Sink", to="b")).ok
    fleet.run_for(2.0)
    for agent in (a, b):
        assert agent.events("task_disputed") == []
    refused = b.ask(Forget("Sink", owner="a", dry_run=True))
    assert not refused.ok and "is owned by b alone" in refused.reason


def test_a_claim_on_a_task_that_cannot_be_read_here_is_heard_all_the_same(fleet):
    a, _, _ = moved(fleet)
    task_id = TaskId("b", "Old")
    service = a.component("client")
    a.agent.records.persist(Record(task_id, Phase.OWNER, Epoch(1, "a"), Epoch(1, "a"), snapshot=b"junk"), service)
    fleet.run_for(0.5)
    fleet.crash("a")
    a = fleet.restart("a")
    fleet.connect()
    claim = Owned((OwnerClaim(task_id, Epoch(2, "b")),))
    fleet.agents["b"].component("client").publish(NETWORK, claim, f"a/{CENSUS}")
    fleet.run_for(1.0)
    disputed = a.events("task_disputed")
    assert [(it["task"], it["peer"]) for it in disputed] == [("Old", "b")]
    assert a.ask(Describe(target="Sink")).ok, "the service goes on"
