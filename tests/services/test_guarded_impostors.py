"""What is said about a guarded task by an agent that has no right to say it changes nothing."""

import pytest
from services.counting import Count

from pancakes.control import Guarding
from pancakes.durable.messages import (
    AskLease,
    CheckpointBody,
    CheckpointId,
    DenyLease,
    KeepLease,
    LeaseKept,
    LeaseSeen,
    Pledge,
    SeizeTask,
    TakeTask,
    YieldLease,
    addressed,
)
from pancakes.durable.record import Epoch, GuardianId, Guards, TaskId, forgotten_guards
from pancakes.durable.snapshot import Snapshot
from pancakes.security.access import Access
from pancakes.security.roster import RIGHTS, AccessRule, Right
from pancakes.supervision.messages import GUARDIAN
from pancakes.testing import Fleet

COUNT = TaskId("a", "Count")
FIRST, HIGH = Epoch(0, "a"), Epoch(7, "d")


@pytest.fixture
def fleet():
    with Fleet(seed=5, classes={"test.Count": Count}) as made:
        made.start("a", tasks={"Count": {"type": Count, "guard": 3, "lease_s": 2.0, "guardians": ["b", "c"]}})
        for name in "bcd":
            made.start(name)
        made.connect()
        assert made.run_until(lambda: len(record(made).guards.members()) == 3, 10)
        made.run_for(1.0)
        assert record(made).guards.version == 2
        yield made


def record(fleet, name="a"):
    found = fleet.agents[name].agent.records.get(COUNT)
    assert found is not None
    return found


def guardian(fleet, name):
    return GuardianId(name, fleet.agents[name].agent.mesh.identity.journal)


def say(fleet, speaker, message, to):
    journal = fleet.agents[to.split("/")[0]].agent.mesh.identity.journal
    fleet.agents[speaker].publish("network", addressed(message, journal), to=to)


def cut_off_from_owner(fleet):
    """B is not linked to a, which would say that it has the task; c is."""
    fleet.network.partition(["a"], ["b"])
    fleet.run_for(3.0)


def goes_on(fleet):
    fleet.run_for(3.0)
    a = fleet.agents["a"]
    return a.running() == ["Count"] and record(fleet).epoch == FIRST and not a.events("permit_lost")


def test_leases_are_granted_by_guardians_alone(fleet):
    a = fleet.agents["a"]
    fleet.faults.cut("a", off=("b", "c"))
    for _ in range(40):
        beat, no = a.component("client").places[COUNT].tenancy.tenure.beat, record(fleet).no
        for name in "bc":
            say(fleet, "d", LeaseKept(COUNT, FIRST, guardian(fleet, name), beat, no, 2), "a/client")
        say(fleet, "d", LeaseKept(COUNT, FIRST, guardian(fleet, "d"), beat, no, 2), "a/client")
        fleet.run_for(0.1)
    assert a.events("permit_lost")


def test_denials_are_of_guardians_alone(fleet):
    for name in "bcd":
        say(fleet, "d", DenyLease(COUNT, FIRST, guardian(fleet, name), HIGH, "why"), "a/client")
    assert goes_on(fleet)


def test_pledges_are_of_guardians_alone(fleet):
    b = fleet.agents["b"]
    cut_off_from_owner(fleet)
    guards = record(fleet).guards
    call = TakeTask(COUNT, "test.Count", FIRST, guards, CheckpointId(FIRST, 1))
    say(fleet, "c", call, "b/client")
    assert fleet.run_until(lambda: COUNT in b.component("client").places, 1.0)
    body = CheckpointBody(record(fleet).snapshot)
    for name in "abcd":
        pledge = Pledge(COUNT, Epoch(1, "b"), guardian(fleet, name), CheckpointId(HIGH, 9), guards, body)
        say(fleet, "d", pledge, "b/client")
    assert goes_on(fleet) and b.running() == []


def test_a_lease_is_given_up_by_its_owner_alone(fleet):
    for name in "abc":
        for boot in range(3):
            say(fleet, "d", YieldLease(COUNT, FIRST, 2**62, boot), f"{name}/{GUARDIAN}")
            say(fleet, "d", YieldLease(COUNT, HIGH, 2**62, boot), f"{name}/{GUARDIAN}")
    assert goes_on(fleet)


def test_lease_that_runs_is_ended_by_no_claim_of_another(fleet):
    """It asks for pledges, or for a lease of half a second under an epoch of its own, and is silent then."""
    guards = record(fleet).guards
    ours = Guards(HIGH, 0, guards.sets)
    claims = [
        SeizeTask(COUNT, "test.Count", HIGH, guards),
        KeepLease(COUNT, "test.Count", HIGH, 1, 0.5, CheckpointId(HIGH, 1), guards, CheckpointBody(b"a lie")),
        KeepLease(COUNT, "test.Count", HIGH, 1, 0.5, CheckpointId(HIGH, 1), ours, CheckpointBody(b"a lie")),
        KeepLease(COUNT, "test.Count", HIGH, 1, 0.5, CheckpointId(HIGH, 1), forgotten_guards(HIGH)),
    ]
    for claim in claims:
        for name in "abc":
            say(fleet, "d", claim, f"{name}/{GUARDIAN}")
        fleet.run_for(0.5)
    assert not fleet.agents["d"].probe.packets(Pledge) and not fleet.agents["d"].probe.packets(LeaseKept)
    assert goes_on(fleet)
    assert [fleet.agents[name].ask(Guarding()).result[0]["epoch"] for name in "bc"] == [str(FIRST)] * 2


def test_what_another_says_of_a_guardian_has_no_task_taken_over(fleet):
    b = fleet.agents["b"]
    fleet.faults.cut("b", off=("a", "c"))
    for _ in range(50):
        for name in "acd":
            say(fleet, "d", LeaseSeen(COUNT, guardian(fleet, name), False, HIGH, Guards()), f"b/{GUARDIAN}")
        fleet.run_for(0.1)
    assert not b.events("task_called") and not fleet.agents["d"].events("task_called")
    assert fleet.agents["a"].running() == ["Count"]


def test_a_task_is_forgotten_by_the_word_of_its_guardians_alone(fleet):
    say(fleet, "d", LeaseSeen(COUNT, guardian(fleet, "d"), False, HIGH, forgotten_guards(HIGH)), f"b/{GUARDIAN}")
    say(fleet, "c", LeaseSeen(TaskId("a", "Nothing"), guardian(fleet, "c"), False, HIGH, Guards()), f"b/{GUARDIAN}")
    assert goes_on(fleet)
    assert [row["task_id"] for row in fleet.agents["b"].ask(Guarding()).result] == ["a/Count"]


def test_a_stranger_is_not_told_of_leases(fleet):
    d = fleet.agents["d"]
    d.publish("network", addressed(AskLease(COUNT), guardian(fleet, "b").journal), to=f"b/{GUARDIAN}")
    fleet.run_for(0.5)
    assert not d.probe.packets(LeaseSeen)


def test_what_was_meant_for_an_agent_with_another_disk_has_no_effect(fleet):
    c, b = fleet.agents["c"], fleet.agents["b"]
    cut_off_from_owner(fleet)
    call = TakeTask(COUNT, "test.Count", FIRST, record(fleet).guards, CheckpointId(FIRST, 1))
    for body, to in ((AskLease(COUNT), f"b/{GUARDIAN}"), (call, "b/client")):
        c.publish("network", addressed(body, "another"), to=to)
    fleet.run_for(0.5)
    assert not c.probe.packets(LeaseSeen) and COUNT not in b.component("client").places
    say(fleet, "c", AskLease(COUNT), f"b/{GUARDIAN}")
    say(fleet, "c", call, "b/client")
    assert fleet.run_until(lambda: c.probe.packets(LeaseSeen) and COUNT in b.component("client").places, 1.0)


def test_a_peer_without_the_right_to_guard_calls_no_agent(fleet):
    b = fleet.agents["b"]
    others: tuple[Right, ...] = tuple(right for right in RIGHTS if right != "guard")
    strict = Access("b", own=(AccessRule(("*",), others),))
    strict.bearer_of = b.kernel.access.bearer_of
    b.kernel.access = strict
    say(fleet, "c", TakeTask(COUNT, "test.Count", FIRST, record(fleet).guards, CheckpointId(FIRST, 1)), "b/client")
    fleet.run_for(0.5)
    assert not b.events("task_called")


@pytest.mark.parametrize("moves", [None, {"when": 5}], ids=["no snapshot", "a malformed rule"])
def test_a_guardian_outlives_a_checkpoint_that_cannot_be_read(fleet, moves):
    bad = TaskId("d", "Bad")
    rule = {"guard": 3, "lease_s": 2.0, "checkpoint_s": 1.0, "guardians": [], "takeover": "auto"}
    snapshot = Snapshot(bad, "test.Count", "", "client", guard=rule, migrate=moves).encode() if moves else b"bad"
    epoch = Epoch(0, "d")
    guards = Guards(epoch, 0, (tuple(guardian(fleet, name) for name in "bcd"),))
    body = CheckpointBody(snapshot)
    for name in "bc":
        keep = KeepLease(bad, "test.Count", epoch, 1, 1.0, CheckpointId(epoch, 1), guards, body)
        say(fleet, "d", keep, f"{name}/{GUARDIAN}")
    fleet.run_for(5.0)
    b = fleet.agents["b"]
    assert any("d/Bad cannot be taken over" in line for line in b.lines("error"))
    assert {row["task_id"] for row in b.ask(Guarding()).result} == {"a/Count", "d/Bad"}
    assert goes_on(fleet)


def test_a_pledge_with_a_checkpoint_that_cannot_be_read_does_not_count(fleet):
    b, guards = fleet.agents["b"], record(fleet).guards
    cut_off_from_owner(fleet)
    say(fleet, "c", TakeTask(COUNT, "test.Count", FIRST, guards, CheckpointId(FIRST, 1)), "b/client")
    assert fleet.run_until(lambda: COUNT in b.component("client").places, 1.0)
    for name in "ac":
        pledge = Pledge(
            COUNT, Epoch(1, "b"), guardian(fleet, name), CheckpointId(HIGH, 9), guards, CheckpointBody(b"x")
        )
        say(fleet, name, pledge, "b/client")
    assert goes_on(fleet) and b.running() == []
    assert any("does not count" in line for line in b.lines("warning"))
