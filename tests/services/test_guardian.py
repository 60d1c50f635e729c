"""The guardian of an agent, over the mesh: it grants leases and pledges, remembers them, and believes no impostor."""

from __future__ import annotations

import gc

import pytest
from msgspec.structs import replace

from pancakes.durable import guardian
from pancakes.durable.messages import (
    CanGuard,
    CheckpointBody,
    CheckpointId,
    DenyLease,
    KeepLease,
    LeaseKept,
    MayGuard,
    Pledge,
    SeizeTask,
    YieldLease,
)
from pancakes.durable.record import Epoch, GuardianId, Guards, TaskId
from pancakes.journal.journal import MARK
from pancakes.packet import NETWORK
from pancakes.security.access import Access
from pancakes.security.roster import RIGHTS, AccessRule, Right
from pancakes.supervision.messages import GUARDIAN
from pancakes.testing import Fleet

TASK = TaskId("a", "Scan")
OLD = Epoch(1, "a")
LEASE_S = 2.0


@pytest.fixture
def fleet():
    with Fleet(seed=5) as made:
        made.start("a")
        made.start("b")
        made.start("c")
        made.connect()
        yield made


def journal(fleet, name):
    return fleet.agents[name].agent.mesh.identity.journal


def guards(fleet):
    return Guards(OLD, 0, (tuple(GuardianId(name, journal(fleet, name)) for name in "abc"),))


def keep(fleet, beat=1, no=0, body=b"state", **changes):
    checkpoint = CheckpointId(OLD, no)
    message = KeepLease(
        TASK, "scan", OLD, beat, LEASE_S, checkpoint, guards(fleet), CheckpointBody(body), journal=journal(fleet, "b")
    )
    return replace(message, **changes)


def seize(fleet, n=2, by="c", **changes):
    message = SeizeTask(TASK, "scan", Epoch(n, by), guards(fleet), journal(fleet, "b"))
    return replace(message, **changes)


def answered(fleet, by, message, to="b"):
    """Says something to a guardian, and returns its newest answer; None: it gives none."""
    asker = fleet.agents[by]
    asker.probe.forget()
    asked = asker.publish(NETWORK, message, f"{to}/{GUARDIAN}")
    fleet.run_for(0.2)
    kinds = (LeaseKept, Pledge, DenyLease)
    said = [it.body for kind in kinds for it in asker.probe.packets(kind) if it.destination == asked.source]
    return said[-1] if said else None


def may_guard(fleet, journal):
    """Asks b whether it would guard a task; returns its refusals, empty: it would."""
    a = fleet.agents["a"]
    a.probe.forget()
    a.publish(NETWORK, MayGuard(TASK, "scan", journal), f"b/{GUARDIAN}")
    fleet.run_for(0.2)
    return [packet.body.refusal for packet in a.probe.packets(CanGuard)]


def test_it_grants_a_lease_and_pledges_itself_only_after_that(fleet):
    kept = answered(fleet, "a", keep(fleet))
    assert (kept.epoch, kept.guardian.agent, kept.beat, kept.no) == (OLD, "b", 1, 0)
    denied = answered(fleet, "c", seize(fleet))
    assert isinstance(denied, DenyLease) and "lease" in denied.reason
    fleet.run_for(LEASE_S)
    pledge = answered(fleet, "c", seize(fleet))
    assert isinstance(pledge, Pledge) and pledge.checkpoint == CheckpointId(OLD, 0)
    assert pledge.body == CheckpointBody(b"state")
    passed = answered(fleet, "a", keep(fleet, 2))
    assert isinstance(passed, DenyLease) and passed.promised == Epoch(2, "c")


def test_each_keep_begins_a_whole_lease(fleet):
    for beat in range(1, 6):
        assert answered(fleet, "a", keep(fleet, beat)).beat == beat
        fleet.run_for(LEASE_S / 2)
        assert isinstance(answered(fleet, "c", seize(fleet)), DenyLease)


def test_what_it_keeps_and_promises_outlives_a_restart(fleet):
    answered(fleet, "a", keep(fleet, no=3))
    fleet.crash("b")
    fleet.restart("b")
    fleet.connect()
    denied = answered(fleet, "c", seize(fleet))
    assert isinstance(denied, DenyLease), "it cannot know when the lease ends that it gave"
    fleet.run_for(LEASE_S)
    assert answered(fleet, "c", seize(fleet)).checkpoint.no == 3
    fleet.crash("b")
    fleet.restart("b")
    fleet.connect()
    assert answered(fleet, "a", keep(fleet, 2)).promised == Epoch(2, "c")


def test_a_guardian_whose_disk_was_lost_is_not_believed_to_be_the_old_one(fleet):
    answered(fleet, "a", keep(fleet))
    meant_for_the_old_one = seize(fleet)
    fleet.crash("b")
    fleet.disk("b").clear()
    fleet.restart("b")
    fleet.connect()
    assert answered(fleet, "c", meant_for_the_old_one) is None
    denied = answered(fleet, "c", replace(meant_for_the_old_one, journal=journal(fleet, "b")))
    assert isinstance(denied, DenyLease) and "knows nothing of it" in denied.reason


def test_a_guardian_whose_disk_is_a_copy_is_not_believed_to_be_the_old_one(fleet):
    answered(fleet, "a", keep(fleet))
    meant_for_the_old_one = seize(fleet)
    fleet.crash("b")
    del fleet.disk("b")[MARK]
    b = fleet.restart("b")
    fleet.connect()
    assert any("b guards a/Scan anew: its disk is a copy" in line for line in b.lines("warning"))
    denied = answered(fleet, "c", meant_for_the_old_one)
    assert isinstance(denied, DenyLease) and "knows nothing of it" in denied.reason
    assert "is none of its guardians" in answered(fleet, "a", keep(fleet, 2)).reason
    new = Guards(OLD, 1, ((GuardianId("a", journal(fleet, "a")), denied.guardian),))
    assert may_guard(fleet, journal(fleet, "b")) == [""]
    assert isinstance(answered(fleet, "a", keep(fleet, 3, guards=new)), LeaseKept)
    fleet.crash("b")
    b = fleet.restart("b")
    fleet.connect()
    assert answered(fleet, "a", keep(fleet, 4, guards=new)).guardian == denied.guardian, "it is the same copy"
    assert not any("is a copy" in line for line in b.lines("warning"))


def test_one_that_has_lost_a_register_guards_the_task_no_more(fleet):
    answered(fleet, "a", keep(fleet))
    fleet.crash("b")
    disk = fleet.disk("b")
    (name,) = [file for file in disk if "guard" in file]
    disk[name] = disk[name][:-3] + b"???"
    b = fleet.restart("b")
    fleet.connect()
    denied = answered(fleet, "a", keep(fleet, 2))
    assert isinstance(denied, DenyLease) and "may have forgotten a pledge" in denied.reason
    assert any("guards 'a/Scan' no more" in line for line in b.lines())
    assert may_guard(fleet, journal(fleet, "b")) == ["b has lost what it knew of it"]


def test_nothing_is_promised_that_could_not_be_written(fleet):
    end = fleet.faults.fill_disk("b")
    assert answered(fleet, "a", keep(fleet)) is None
    end()
    assert answered(fleet, "a", keep(fleet, 2)).beat == 2


def test_an_agent_asks_under_an_epoch_of_its_own_alone(fleet):
    for message in (seize(fleet, by="a"), keep(fleet)):
        denied = answered(fleet, "c", message)
        assert isinstance(denied, DenyLease) and "speaks for itself alone" in denied.reason
    assert isinstance(answered(fleet, "c", seize(fleet)), Pledge), "nothing was kept"


def test_a_task_does_not_change_its_type(fleet):
    answered(fleet, "a", keep(fleet))
    fleet.run_for(LEASE_S)
    denied = answered(fleet, "c", seize(fleet, type="harmless"))
    assert isinstance(denied, DenyLease) and "it is a scan, and no harmless" in denied.reason


def test_an_agent_guards_a_bounded_number_of_tasks_of_a_peer(fleet, monkeypatch):
    monkeypatch.setattr(guardian, "MOST_TASKS", 2)
    for name in ("One", "Two"):
        assert isinstance(answered(fleet, "a", keep(fleet, task_id=TaskId("a", name))), LeaseKept)
    denied = answered(fleet, "a", keep(fleet, task_id=TaskId("a", "Three")))
    assert isinstance(denied, DenyLease) and "2 tasks of a already" in denied.reason


def test_an_agent_keeps_a_bounded_number_of_bytes_for_a_peer(fleet, monkeypatch):
    monkeypatch.setattr(guardian, "MOST_BYTES", 2**20)
    for name in ("One", "Two", "Three", "Four"):
        kept = answered(fleet, "a", keep(fleet, body=b"x" * (2**18 - 1024), task_id=TaskId("a", name)))
        assert isinstance(kept, LeaseKept)
    denied = answered(fleet, "a", keep(fleet, body=b"x" * 5000, task_id=TaskId("a", "Five")))
    assert isinstance(denied, DenyLease)
    assert denied.reason == "the checkpoints of a would take more than 1 MiB on b"


@pytest.mark.parametrize("right", ["guard", "host"])
def test_it_needs_the_right_to_guard_and_to_host(fleet, right):
    kernel = fleet.agents["b"].kernel
    others: tuple[Right, ...] = tuple(it for it in RIGHTS if it != right)
    strict = Access("b", own=(AccessRule(("*",), others),))
    strict.bearer_of = kernel.access.bearer_of
    kernel.access = strict
    denied = answered(fleet, "a", keep(fleet))
    assert isinstance(denied, DenyLease) and f"lacks the right {right!r}" in denied.reason
    (refusal,) = may_guard(fleet, journal(fleet, "b"))
    assert f"lacks the right {right!r}" in refusal


def test_it_answers_no_question_to_an_agent_with_another_disk(fleet):
    assert may_guard(fleet, "another") == []
    assert may_guard(fleet, journal(fleet, "b")) == [""]


def test_so_much_waits_for_the_disk_and_no_more(fleet):
    answered(fleet, "a", keep(fleet))
    fleet.run_for(LEASE_S)
    fleet.faults.slow_disk("b", 5.0)
    c = fleet.agents["c"]
    for n in range(1002, 1060):
        c.publish(NETWORK, seize(fleet, n), f"b/{GUARDIAN}")
        c.publish(NETWORK, YieldLease(TASK, Epoch(n, "c"), 1, 1, journal(fleet, "b")), f"b/{GUARDIAN}")
    fleet.run_for(1.0)
    gc.collect()
    kept = [it for it in gc.get_objects() if isinstance(it, (SeizeTask, YieldLease)) and it.epoch.n > 1000]
    assert len(kept) <= guardian.MOST_WAIT + 1, "those that wait, and the one that is being written"
