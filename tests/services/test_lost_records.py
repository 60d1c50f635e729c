"""A task whose record was damaged may run elsewhere: it rests, over any number of starts, until a person decides."""

import pytest
from services.counting import Count

from pancakes.control import Adopt, Describe, Forget, Migrate, Start, Stop
from pancakes.testing import FleetInTest

RECORD = "record.a%2FCount.rec"
IDENTITY = "identity.identity.rec"
DAMAGED = (RECORD, IDENTITY)


@pytest.fixture
def fleet():
    with FleetInTest(seed=2) as made:
        made.start("a", tasks={"Count": Count})
        made.start("b")
        made.connect()
        yield made


def flip(fleet, agent, name, at):
    """Flips one bit of a file on the disk of an agent that stands still."""
    disk = fleet.fleet.disk(agent)
    changed = bytearray(disk[name])
    changed[at] ^= 1
    disk[name] = bytes(changed)


def moved_away(fleet):
    """Count, born on a, runs on b, and a stands still."""
    assert fleet.agents["a"].ask(Migrate("Count")).ok
    fleet.run_for(1.5)
    fleet.stop("a")


def copies(fleet):
    return [name for name, agent in fleet.agents.items() if "Count" in agent.running()]


@pytest.mark.parametrize("name", DAMAGED)
@pytest.mark.parametrize("at", [0, 7, 8, 39, 40, 60, -1])
def test_whichever_byte_of_it_is_flipped_no_start_makes_a_second_copy(fleet, name, at):
    moved_away(fleet)
    flip(fleet, "a", name, at)
    for how in ("stop", "crash", "stop"):
        a = fleet.restart("a")
        fleet.run_for(1.0)
        assert copies(fleet) == ["b"]
        assert any("a/Count" in line and "pancakes task forget a/Count" in line for line in a.lines("error"))
        assert "until you decide" in a.ask(Start("Count")).reason
        assert "until you decide" in a.ask(Start("Count", dry_run=True)).reason
        assert "until you decide" in a.ask(Describe("Count")).result["reason"]
        getattr(fleet, how)("a")


@pytest.mark.parametrize("name", DAMAGED)
def test_forgotten_it_stays_where_it_is_and_may_come_back(fleet, name):
    moved_away(fleet)
    flip(fleet, "a", name, 50)
    a = fleet.restart("a")

    tried = a.ask(Forget("Count", dry_run=True))
    assert tried.ok and tried.result == {"task_id": "a/Count"}
    assert "until you decide" in a.ask(Start("Count")).reason

    assert a.ask(Forget("Count")).ok
    assert a.events("task_forgotten") == [{"kind": "task_forgotten", "task": "Count"}]
    assert any("a/Count was forgotten on a, as a/test/Probe asked" in line for line in a.lines("warning"))
    for _ in range(2):
        fleet.crash("a")
        a = fleet.restart("a")
        fleet.run_for(1.0)
        assert copies(fleet) == ["b"] and a.lines("error") == []
    assert a.ask(Start("Count")).reason.startswith("a/Count is not here: it was forgotten")
    assert a.ask(Forget("Count")).reason.startswith("there is nothing to forget")

    assert fleet.agents["b"].ask(Migrate("Count")).ok
    fleet.run_for(1.0)
    assert copies(fleet) == ["a"] and a.task("Count").state.n > 20


def test_adopted_after_its_record_was_damaged_it_begins_anew_under_an_epoch_that_all_agents_believe(fleet):
    moved_away(fleet)
    fleet.stop("b")
    fleet.fleet.disk("b").clear()  # the only one that had it
    flip(fleet, "a", RECORD, 50)
    a = fleet.restart("a")

    refused = a.ask(Adopt("Count"))
    assert "Adopted by force, it runs on a (as its configuration says, its state is lost)" in refused.reason
    assert "there are two of it" in refused.reason and refused.reason.endswith("Nothing was done")
    assert a.ask(Adopt("Count", force=True, dry_run=True)).ok and copies(fleet) == []

    assert a.ask(Adopt("Count", force=True)).ok
    assert copies(fleet) == ["a"] and a.task("Count").state.n <= 1
    (adopted,) = a.events("task_adopted")
    assert adopted["epoch"] >= 1_000_000
    fleet.crash("a")
    a = fleet.restart("a")
    fleet.start("b")
    fleet.connect()
    assert copies(fleet) == ["a"]
    assert a.ask(Migrate("Count")).ok
    fleet.run_for(1.0)
    assert copies(fleet) == ["b"]


def test_adopted_after_the_identity_was_damaged_it_goes_on_where_it_was(fleet):
    fleet.run_for(2.5)
    fleet.stop("a")
    flip(fleet, "a", IDENTITY, 50)
    a = fleet.restart("a")
    assert copies(fleet) == []

    assert "the task was here. Adopted by force" in a.ask(Adopt("Count")).reason
    assert a.ask(Adopt("Count", force=True)).ok

    assert copies(fleet) == ["a"] and a.task("Count").state.n >= 20
    assert a.ask(Stop("Count")).ok


def test_what_came_from_elsewhere_and_was_lost_rests_too_and_is_named(fleet):
    moved_away(fleet)
    fleet.stop("b")
    flip(fleet, "b", RECORD, 50)
    b = fleet.restart("b")
    assert any("a/Count is not started" in line and "task adopt b/Count" in line for line in b.lines("error"))

    refused = b.ask(Adopt("Count", force=True))
    assert refused.reason.startswith("a/Count cannot be adopted: nothing is left here to run it from")
    assert b.ask(Forget("Count")).ok

    fleet.crash("b")
    assert fleet.restart("b").lines("error") == []
    assert copies(fleet) == []


def test_what_came_from_elsewhere_can_be_adopted_where_its_record_can_be_read(fleet):
    moved_away(fleet)
    fleet.run_for(2.0)
    fleet.stop("b")
    flip(fleet, "b", IDENTITY, 50)
    b = fleet.restart("b")
    assert copies(fleet) == []

    assert b.ask(Adopt("Count", force=True)).ok

    assert copies(fleet) == ["b"] and b.task("Count").state.n >= 15


def test_who_forgot_it_by_mistake_may_adopt_it_still(fleet):
    fleet.stop("a")
    flip(fleet, "a", RECORD, 50)
    a = fleet.restart("a")
    assert a.ask(Forget("Count")).ok
    fleet.crash("a")
    a = fleet.restart("a")

    assert "a was told to forget it" in a.ask(Adopt("Count")).reason
    assert a.ask(Adopt("Count", force=True)).ok

    assert copies(fleet) == ["a"]


def test_what_is_not_lost_is_not_forgotten(fleet):
    a = fleet.agents["a"]
    assert a.ask(Forget("Count")).reason == "there is nothing to forget: a/Count is here already"
    assert a.ask(Forget("Other")).reason == "a has no task or service 'Other'"
    assert a.ask(Forget("client")).reason == "a/client is a service: name one of its tasks"
    assert copies(fleet) == ["a"]
