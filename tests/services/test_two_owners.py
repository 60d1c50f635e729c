"""Two agents own one task: that is noticed when they are linked, and only the one with the higher right goes on."""

from __future__ import annotations

import pytest
from msgspec.structs import replace
from services.numbered import Sink
from services.test_what_other_versions_left import change_record, with_state

from pancakes.control import Adopt, Describe, Forget, Migrate, Restart, Start, Stop
from pancakes.durable.answers import NeighbourUp
from pancakes.durable.messages import REGISTRAR, Fact, Known
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Epoch, Identity, Register
from pancakes.durable.registrar import Registrar
from pancakes.durable.snapshot import Snapshot
from pancakes.journal.journal import MARK, JournalEntry, seal, unseal
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


def identity_of(agent):
    """Returns the agent as an owner of tasks."""
    identity = agent.agent.mesh.identity
    return Identity(agent.name, identity.journal, identity.copy)


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
    assert any("it is paused here, and runs on b" in line for line in a.lines())


def test_it_rests_over_a_restart_and_a_start_is_refused(fleet):
    a, _ = restored(fleet)
    refused = a.ask(Start("Sink"))
    assert not refused.ok and "a/Sink is owned by another agent too" in refused.reason
    fleet.crash("b")
    fleet.crash("a")
    a = fleet.restart("a")
    fleet.run_for(2.0)
    assert state(a) == ("stopped", "disputed")


def test_a_dispute_outlives_a_copy_of_the_disk_until_a_person_decides(fleet):
    restored(fleet)
    fleet.crash("b")
    fleet.crash("a")
    fleet.disk("a").pop(MARK)
    a = fleet.restart("a")
    fleet.run_for(12.0)
    assert state(a) == ("stopped", "disputed")
    assert "owned by another agent too" in a.ask(Start("Sink")).reason
    assert a.ask(Adopt("Sink")).ok
    fleet.run_for(1.0)
    assert state(a)[0] == "running"


def test_a_dispute_that_is_on_disk_is_told_once_after_each_start(fleet):
    a, _ = restored(fleet)
    fleet.crash("a")
    a = fleet.restart("a")
    fleet.connect()
    fleet.run_for(2.0)
    assert state(a) == ("stopped", "disputed")
    fleet.network.break_links("a", "b")
    fleet.run_for(2.0)
    assert len(a.events("task_disputed")) == 1


def test_adopted_it_lives_here_and_stands_still_on_the_other_agent(fleet):
    a, b = restored(fleet)
    assert a.ask(Adopt("Sink")).ok
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
    assert dry.ok and dry.result == {"task_id": "a/Sink", "epoch": "1@b", "runs": True}
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
        return with_state(record, replace(Snapshot.decode(record.snapshot), type="test.Gone").encode())

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
        assert not refused.ok and "b owns a/Sink (epoch 1@b), of which a knows nothing" in refused.reason
        assert a.ask(Restart("client")).ok, "its successor is told again"
        fleet.run_for(1.0)


def test_a_link_that_stands_before_its_network_service_runs_is_caught_up_with(fleet, monkeypatch):
    receive = Registrar.take_message
    deaf = lambda it, message: None if isinstance(message, NeighbourUp) else receive(it, message)  # noqa: E731
    monkeypatch.setattr(Registrar, "take_message", deaf)
    a, b = restored(fleet)
    assert state(a)[0] == state(b)[0] == "running"
    assert a.ask(Restart("network/NetworkClient")).ok
    fleet.run_for(1.0)
    assert state(a) == ("stopped", "disputed") and state(b)[0] == "running"


def test_a_copy_of_a_disk_under_another_name_owns_nothing(fleet):
    """The card was cloned after a migration, and the clone bears the name of another agent."""
    _, b, _ = moved(fleet)
    fleet.stop("b")
    put(fleet, "c", copy_of(fleet, "b"))
    b = fleet.restart("b")
    c = fleet.start("c", classes={"Sink": Sink})
    fleet.connect()
    fleet.run_for(2.0)
    assert state(b)[0] == "running" and c.running() == []


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
    assert a.ask(Adopt("Sink")).ok
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
    me = identity_of(a)
    fleet.crash("a")
    register = Register(Epoch(1, me), sets=((me,),), state=b"junk", promised=Epoch(1, me))
    disk = fleet.disk("a")
    entry = unseal(me.journal, disk["record.a%2FSink.rec"])
    record = Record(task_id, register, me, "client").encode()
    disk["record.b%2FOld.rec"] = seal(me.journal, JournalEntry(entry.kind, str(task_id), record))
    a = fleet.restart("a")
    fleet.connect()
    b = identity_of(fleet.agents["b"])
    claim = Known(b, (), (Fact(task_id, Register(Epoch(2, b), sets=((b,),))),))
    fleet.agents["b"].publish(NETWORK, claim, to=f"a/{REGISTRAR}")
    fleet.run_for(1.0)
    disputed = a.events("task_disputed")
    assert [(it["task"], it["peer"]) for it in disputed] == [("Old", "b")]
    assert a.ask(Describe(target="Sink")).ok, "the service goes on"
