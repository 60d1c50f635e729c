"""Created tasks that are guarded: taken over like others, and forgotten by their guardians once they are removed."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from msgspec.structs import replace
from services.created import COUNT, Count, count_of

from pancakes.control import Configure, Create, Guarding, Remove, Start, Stop
from pancakes.durable.record import TaskId
from pancakes.testing import AgentHandle, Fleet

GUARDED = Create("Count", "test.Count", {"step": 2}, 5.0, {"guard": {"copies": 3, "lease_s": 2.0}})


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet(seed=18, classes={"test.Count": Count}) as made:
        yield made


def guarding(agent: AgentHandle) -> list[str]:
    """Returns the tasks that an agent guards."""
    return [row["task_id"] for row in agent.ask(Guarding()).result]


def guarded(fleet: Fleet) -> list[AgentHandle]:
    """Three agents that guard the task, which runs on the first."""
    agents = [fleet.start(name) for name in "abc"]
    fleet.connect()
    would, does = (agents[0].ask(it) for it in (replace(GUARDED, dry_run=True), GUARDED))
    assert does.ok and would.result == does.result, does.reason
    assert fleet.run_until(lambda: all(len(guarding(it)) == 1 for it in agents))
    fleet.run_for(5.0)
    return agents


def test_a_created_task_that_is_guarded_is_taken_over(fleet: Fleet) -> None:
    _, b, c = guarded(fleet)
    fleet.crash("a")
    fleet.run_for(15.0)
    assert sorted([*b.running(), *c.running()]) == ["Count"]
    a = fleet.restart("a")
    fleet.connect()
    fleet.run_for(5.0)
    assert a.running() == []
    owner = b if b.running() else c
    assert owner.ask(Remove("Count"), timeout_s=30.0).ok
    assert a.ask(GUARDED).ok


def test_the_guardians_of_a_removed_task_forget_it_and_none_has_it_run_again(fleet: Fleet) -> None:
    a, b, c = agents = guarded(fleet)
    removed = a.ask(Remove("Count"), timeout_s=30.0)
    assert removed.ok, removed.reason
    fleet.run_for(1.0)
    assert [guarding(it) for it in agents] == [[], [], []]
    fleet.crash("a")
    fleet.run_for(20.0)
    assert b.running() == c.running() == []
    a = fleet.restart("a")
    fleet.connect()
    assert a.ask(GUARDED).ok
    fleet.run_for(5.0)
    assert a.running() == ["Count"] and [guarding(it) for it in (a, b, c)] == [["a/Count"]] * 3


def test_what_was_guarded_and_removed_runs_unguarded_where_it_is_created_so(fleet: Fleet) -> None:
    a, *_ = guarded(fleet)
    assert a.ask(Remove("Count"), timeout_s=30.0).ok
    assert a.ask(COUNT).ok
    fleet.run_for(4.05)
    assert count_of(a) == 40


def test_a_guardian_that_was_away_while_it_was_removed_forgets_it_too(fleet: Fleet) -> None:
    a, b, c = guarded(fleet)
    away = c if "c" in str(a.ask(Guarding()).result[0]["guardians"]) else b
    fleet.crash(away.name)
    fleet.run_for(3.0)
    assert a.ask(Remove("Count"), timeout_s=60.0).ok
    back = fleet.restart(away.name)
    fleet.run_for(60.0)
    assert not back.running() and not a.running() and guarding(back) == []


def test_a_removal_that_waits_for_guardians_says_so_and_is_done_once_they_are_back(fleet: Fleet) -> None:
    a, _, _ = guarded(fleet)
    fleet.crash("b")
    fleet.crash("c")
    began_s = fleet.now()
    waits = a.ask(Remove("Count"), timeout_s=60.0)
    assert 4.0 <= fleet.now() - began_s < 4.3
    assert not waits.ok and "removed once more than half of its guardians let go of it (b, c)" in waits.reason
    assert a.ask(Start("Count")).reason == "a/client/Count is being removed"
    fleet.restart("b")
    fleet.restart("c")
    assert a.wait_for_event("task_removed", timeout_s=60.0)["task"] == "Count"
    fleet.run_for(20.0)
    assert not any(it.running() for it in fleet.agents.values())


def test_what_is_asked_of_one_that_cannot_start_without_its_guardians_is_answered_and_done_once_they_are_back(
    fleet: Fleet,
) -> None:
    a, _, _ = guarded(fleet)
    assert a.ask(Stop("Count"), timeout_s=30.0).ok
    fleet.crash("b")
    fleet.crash("c")
    fleet.run_for(5.0)
    for body in (Start("Count"), Configure("Count", {"step": 5}), Remove("Count")):
        reason = a.ask(body, timeout_s=6.0).reason
        assert reason == (
            "a/client/Count is starting; what was asked for waits for its guardians (b, c)."
            " It is done once more than half of them answer"
        )
    fleet.restart("b")
    fleet.restart("c")
    assert a.wait_for_event("task_removed", timeout_s=60.0)["task"] == "Count"
    fleet.run_for(20.0)
    assert not any(it.running() for it in fleet.agents.values())


def test_an_agent_that_ends_right_after_a_removal_guards_it_no_more(fleet: Fleet) -> None:
    a, b, c = guarded(fleet)
    a.publish("sysctrl", Remove("Count"))
    record = a.agent.records.get
    while (kept := record(TaskId("a", "Count"))) is None or not kept.removed:
        assert fleet.dispatcher.step()
    fleet.crash("a")
    a = fleet.restart("a")
    fleet.connect()
    fleet.run_for(20.0)
    assert guarding(a) == [] and not any(it.running() for it in (a, b, c))
