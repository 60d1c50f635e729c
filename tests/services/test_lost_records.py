"""A task whose record was damaged may run elsewhere: it rests, over any number of starts, until a person decides."""

import pytest
from services.counting import Count

from pancakes.control import Adopt, Describe, Forget, Migrate, Start, Stop
from pancakes.testing import Fleet

RECORD = "record.a%2FCount.rec"
IDENTITY = "identity.identity.rec"
DAMAGED = (RECORD, IDENTITY)


@pytest.fixture
def fleet():
    with Fleet(seed=2) as made:
        made.start("a", tasks={"Count": Count})
        made.start("b")
        made.connect()
        yield made


def flip(fleet, agent, name, at):
    """Flips one bit of a file on the disk of an agent that stands still."""
    disk = fleet.disk(agent)
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
def test_damaged_record_makes_no_second_copy(fleet, name):
    """Whichever byte is flipped, and however often the agent stops, crashes and starts again."""
    moved_away(fleet)
    disk = fleet.disk("a")
    before = dict(disk)
    for at, hows in {
        0: "stop",
        7: "crash",
        8: "stop",
        39: "crash stop crash",
        40: "stop",
        60: "crash",
        -1: "stop",
    }.items():
        flip(fleet, "a", name, at)
        for how in hows.split():
            a = fleet.restart("a")
            fleet.run_for(1.0)
            assert copies(fleet) == ["b"], f"byte {at}"
            assert any(
                "a/Count" in line and "pancakes task recover a/Count --not-here" in line for line in a.lines("error")
            )
            assert "until you decide" in a.ask(Start("Count")).reason
            assert "until you decide" in a.ask(Start("Count", dry_run=True)).reason
            assert "until you decide" in a.ask(Describe("Count")).result["reason"]
            getattr(fleet, how)("a")
        disk.clear()
        disk.update(before)


@pytest.mark.parametrize("name", DAMAGED)
def test_forgotten_task_stays_elsewhere_and_may_return(fleet, name):
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


def test_adopted_task_without_record_begins_at_a_high_epoch(fleet):
    moved_away(fleet)
    fleet.stop("b")
    fleet.disk("b").clear()  # the only one that had it
    flip(fleet, "a", RECORD, 50)
    a = fleet.restart("a")

    assert a.ask(Adopt("Count", dry_run=True)).ok and copies(fleet) == []

    assert a.ask(Adopt("Count")).ok
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


def test_adopted_task_without_identity_goes_on(fleet):
    fleet.run_for(2.5)
    fleet.stop("a")
    flip(fleet, "a", IDENTITY, 50)
    a = fleet.restart("a")
    assert copies(fleet) == []

    assert a.ask(Adopt("Count")).ok

    assert copies(fleet) == ["a"] and a.task("Count").state.n >= 20
    assert a.ask(Stop("Count")).ok


def test_guest_with_a_damaged_record_rests_and_is_named(fleet):
    moved_away(fleet)
    fleet.stop("b")
    flip(fleet, "b", RECORD, 50)
    b = fleet.restart("b")
    assert any("a/Count is not started" in line and "task recover b/Count --here" in line for line in b.lines("error"))

    refused = b.ask(Adopt("Count"))
    assert refused.reason.startswith("a/Count cannot be adopted: nothing is left here to run it from")
    assert b.ask(Forget("Count")).ok

    fleet.crash("b")
    assert fleet.restart("b").lines("error") == []
    assert copies(fleet) == []


def test_guest_with_a_readable_record_can_be_adopted(fleet):
    moved_away(fleet)
    fleet.run_for(2.0)
    fleet.stop("b")
    flip(fleet, "b", IDENTITY, 50)
    b = fleet.restart("b")
    assert copies(fleet) == []

    assert b.ask(Adopt("Count")).ok

    assert copies(fleet) == ["b"] and b.task("Count").state.n >= 15


def test_forgotten_task_may_still_be_adopted(fleet):
    fleet.stop("a")
    flip(fleet, "a", RECORD, 50)
    a = fleet.restart("a")
    assert a.ask(Forget("Count")).ok
    fleet.crash("a")
    a = fleet.restart("a")

    assert a.ask(Adopt("Count")).ok

    assert copies(fleet) == ["a"]


def test_forget_refuses_what_is_not_lost(fleet):
    a = fleet.agents["a"]
    assert a.ask(Forget("Count")).reason == "there is nothing to forget: a/Count is here already"
    assert a.ask(Forget("Other")).reason == "a has no task or service 'Other'"
    assert a.ask(Forget("client")).reason == "a/client is a service: name one of its tasks"
    assert copies(fleet) == ["a"]
