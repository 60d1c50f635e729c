"""The members of a guarded task, over the mesh: they grant leases and promises, and believe no impostor."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from typing import Any

import pytest
from msgspec.structs import replace
from services.strangers import identity, say

from pancakes.durable import quotas, registrar
from pancakes.durable.messages import REGISTRAR, Accept, Accepted, CanGuard, Known, MayGuard, Prepare, Promise
from pancakes.durable.record import TaskId
from pancakes.durable.register import NO_EPOCH, Epoch, Register
from pancakes.journal.journal import MARK
from pancakes.packet import Packet
from pancakes.security.access import Access
from pancakes.security.roster import RIGHTS, AccessRule, Right
from pancakes.testing import Fleet

TASK = TaskId("a", "Scan")
LEASE_S = 2.0


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet(seed=5) as made:
        for name in "abc":
            made.start(name)
        made.connect()
        yield made


def epoch(fleet: Fleet, n: int, name: str) -> Epoch:
    return Epoch(n, identity(fleet, name))


def members(fleet: Fleet) -> tuple[Any, ...]:
    return (tuple(identity(fleet, name) for name in "abc"),)


def keep(fleet: Fleet, beat: int = 1, no: int = 0, state: bytes = b"state", **changes: Any) -> Accept:
    """Returns a write of a, which owns the task."""
    register = Register(epoch(fleet, 1, "a"), no, changes.pop("sets", None) or members(fleet))
    return replace(Accept(TASK, "scan", "client", register, beat, LEASE_S, state=state), **changes)


def take(fleet: Fleet, n: int = 2, by: str = "c", **changes: Any) -> Prepare:
    """Returns what c says to take the task."""
    held = (epoch(fleet, 1, "a"), 0)
    return replace(Prepare(TASK, "scan", epoch(fleet, n, by), held, members(fleet)), **changes)


def answered(fleet: Fleet, by: str, message: Accept | Prepare, to: str = "b") -> Any:
    """Says something to a member, and returns its newest answer; None: it gives none."""
    heard: list[Packet] = []
    fleet.agents[by].kernel.stream.tap("network", heard.append)
    say(fleet, by, message, to)
    fleet.run_for(0.2)
    of_member = [it.body for it in heard if it.source.startswith(f"{to}/")]
    said = [it for it in of_member if isinstance(it, Accepted | Promise) or (isinstance(it, Known) and it.facts)]
    return said[-1] if said else None


def is_kept(answer: Any, beat: int, no: int = 0) -> bool:
    return isinstance(answer, Accepted) and (answer.beat, answer.no) == (beat, no)


def may_guard(fleet: Fleet) -> list[str]:
    """Asks b whether it would guard a task; returns its refusals, empty: it would."""
    heard: list[Packet] = []
    fleet.agents["a"].kernel.stream.tap("network", heard.append)
    say(fleet, "a", MayGuard(TASK, "scan"), "b")
    fleet.run_for(0.2)
    return [packet.body.refusal for packet in heard if isinstance(packet.body, CanGuard)]


def again(fleet: Fleet, name: str) -> Any:
    """Starts a crashed agent again."""
    agent = fleet.restart(name)
    fleet.connect()
    return agent


def test_it_grants_a_lease_and_promises_itself_only_after_that(fleet: Fleet) -> None:
    assert is_kept(answered(fleet, "a", keep(fleet)), 1)
    denied = answered(fleet, "c", take(fleet))
    assert isinstance(denied, Known) and denied.facts[0].lease
    fleet.run_for(LEASE_S)
    promise = answered(fleet, "c", take(fleet))
    assert isinstance(promise, Promise) and promise.register.stamp == (epoch(fleet, 1, "a"), 0)
    assert promise.state == b"state"
    passed = answered(fleet, "a", keep(fleet, 2))
    assert isinstance(passed, Known) and passed.facts[0].register.promised == epoch(fleet, 2, "c")


def test_each_request_begins_a_whole_lease(fleet: Fleet) -> None:
    for beat in range(1, 6):
        assert is_kept(answered(fleet, "a", keep(fleet, beat)), beat)
        fleet.run_for(LEASE_S / 2)
        assert isinstance(answered(fleet, "c", take(fleet)), Known)


def test_what_it_keeps_and_promises_outlives_a_restart(fleet: Fleet) -> None:
    answered(fleet, "a", keep(fleet, no=3))
    fleet.crash("b")
    again(fleet, "b")
    assert isinstance(answered(fleet, "c", take(fleet)), Known), "it cannot know when the lease ends that it gave"
    fleet.run_for(LEASE_S)
    assert answered(fleet, "c", take(fleet)).register.no == 3
    fleet.crash("b")
    again(fleet, "b")
    passed = answered(fleet, "a", keep(fleet, 2))
    assert isinstance(passed, Known) and passed.facts[0].register.promised == epoch(fleet, 2, "c")


def test_a_member_whose_disk_was_lost_is_not_the_old_one(fleet: Fleet) -> None:
    answered(fleet, "a", keep(fleet))
    for_the_old_one, write = take(fleet), keep(fleet, 2)
    fleet.crash("b")
    fleet.disk("b").clear()
    again(fleet, "b")
    assert answered(fleet, "c", for_the_old_one) is None and answered(fleet, "a", write) is None
    assert fleet.agents["b"].agent.records.all() == {}


def test_a_member_whose_disk_is_a_copy_is_not_the_old_one(fleet: Fleet) -> None:
    answered(fleet, "a", keep(fleet))
    for_the_old_one = take(fleet)
    fleet.crash("b")
    del fleet.disk("b")[MARK]
    b = again(fleet, "b")
    assert any("b guards a/Scan no more: its disk is a copy" in line for line in b.lines("warning"))
    fleet.run_for(LEASE_S)
    assert not isinstance(answered(fleet, "c", for_the_old_one), Promise)
    old = replace(for_the_old_one, epoch=epoch(fleet, 3, "c"))
    assert not isinstance(answered(fleet, "a", keep(fleet, 2, sets=old.sets)), Accepted)
    assert may_guard(fleet) == [""]
    assert is_kept(answered(fleet, "a", keep(fleet, 3, no=1)), 3, 1), "by its new identity it is one again"
    fleet.crash("b")
    b = again(fleet, "b")
    assert is_kept(answered(fleet, "a", keep(fleet, 4, no=1)), 4, 1), "it is the same copy"
    assert not any("is a copy" in line for line in b.lines("warning"))


def test_one_that_has_lost_a_register_guards_the_task_no_more(fleet: Fleet) -> None:
    answered(fleet, "a", keep(fleet))
    fleet.crash("b")
    disk, name = fleet.disk("b"), "record.a%2FScan.rec"
    disk[name] = disk[name][:-3] + b"???"
    b = again(fleet, "b")
    assert not isinstance(answered(fleet, "a", keep(fleet, 2)), Accepted)
    assert any("a/Scan" in line and "may have forgotten a promise" in line for line in b.lines("warning"))
    assert may_guard(fleet) == ["b has lost what it knew of it"]
    fleet.run_for(LEASE_S)
    assert not isinstance(answered(fleet, "c", take(fleet)), Promise)


def test_nothing_is_promised_that_could_not_be_written(fleet: Fleet) -> None:
    end = fleet.faults.fill_disk("b")
    assert answered(fleet, "a", keep(fleet)) is None
    end()
    assert is_kept(answered(fleet, "a", keep(fleet, 2)), 2)


def test_an_agent_asks_under_an_epoch_of_its_own_alone(fleet: Fleet) -> None:
    for message in (take(fleet, by="a"), keep(fleet)):
        assert not isinstance(answered(fleet, "c", message), Accepted | Promise)
    assert any("speaks only for itself" in line for line in fleet.agents["b"].lines("warning"))
    assert isinstance(answered(fleet, "c", take(fleet)), Promise), "nothing was kept"


def test_a_task_does_not_change_its_type(fleet: Fleet) -> None:
    answered(fleet, "a", keep(fleet))
    assert not isinstance(answered(fleet, "a", keep(fleet, 2, type="harmless")), Accepted)
    assert any("it is a scan, and no harmless" in line for line in fleet.agents["b"].lines("warning"))


def test_an_agent_guards_a_bounded_number_of_tasks_of_a_peer(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quotas, "MOST_GUARDED", 2)
    for name in ("One", "Two"):
        assert isinstance(answered(fleet, "a", keep(fleet, task_id=TaskId("a", name))), Accepted)
    assert answered(fleet, "a", keep(fleet, task_id=TaskId("a", "Three"))) is None
    assert any("guards 2 tasks of a already" in line for line in fleet.agents["b"].lines("warning"))


def test_an_agent_keeps_a_bounded_number_of_bytes_for_a_peer(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quotas, "MOST_BYTES", 100_000)
    for name in ("One", "Two"):
        kept = answered(fleet, "a", keep(fleet, state=b"x" * 45_000, task_id=TaskId("a", name)))
        assert isinstance(kept, Accepted)
    assert answered(fleet, "a", keep(fleet, state=b"x" * 15_000, task_id=TaskId("a", "Five"))) is None
    (told,) = [line for line in fleet.agents["b"].lines("warning") if "a/Five" in line]
    assert "guards 2 tasks of a already (90000 bytes), and no more" in told


@pytest.mark.parametrize("right", ["guard", "host"])
def test_it_needs_the_right_to_guard_and_to_host(fleet: Fleet, right: str) -> None:
    kernel = fleet.agents["b"].kernel
    others: tuple[Right, ...] = tuple(it for it in RIGHTS if it != right)
    strict = Access("b", own=(AccessRule(("*",), others),))
    strict.bearer_of = kernel.access.bearer_of
    kernel.access = strict
    assert answered(fleet, "a", keep(fleet)) is None
    assert any(f"lacks the right {right!r}" in line for line in fleet.agents["b"].lines("warning"))
    (refusal,) = may_guard(fleet)
    assert f"lacks the right {right!r}" in refusal
    if right == "host":
        assert answered(fleet, "c", take(fleet)) is None


def test_it_answers_no_question_to_an_agent_with_another_disk(fleet: Fleet) -> None:
    heard: list[Packet] = []
    a = fleet.agents["a"]
    a.kernel.stream.tap("network", heard.append)
    a.publish("network", MayGuard(TASK, "scan", "another"), to=f"b/{REGISTRAR}")
    fleet.run_for(0.2)
    assert heard == []
    assert may_guard(fleet) == [""]


def test_so_much_waits_for_the_disk_and_no_more(fleet: Fleet) -> None:
    answered(fleet, "a", keep(fleet))
    fleet.run_for(LEASE_S)
    fleet.faults.slow_disk("b", 5.0)
    for n in range(1002, 1060):
        say(fleet, "c", take(fleet, n), "b")
        say(fleet, "c", take(fleet, n, held=(NO_EPOCH, 0)), "b")
    fleet.run_for(1.0)
    gc.collect()
    kept = [it for it in gc.get_objects() if isinstance(it, Prepare) and it.epoch.n > 1000]
    waiting = list(fleet.agents["b"].component(REGISTRAR).entries[TASK].events)
    assert len(waiting) <= registrar.MOST_WAIT and not kept
