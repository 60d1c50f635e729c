"""Whether a task is born: the decision as a table, and what an agent knows of a task."""

from __future__ import annotations

import pytest

from pancakes.durable.ownership import (
    MOST_ASKED,
    Birth,
    BirthFacts,
    TaskFact,
    Verdict,
    birth_of,
    fact_of,
    newest_fact,
    questions,
)
from pancakes.durable.record import NO_EPOCH, Epoch, Phase, Record, TaskId

TASK = TaskId("a", "Scan")
THERE = TaskFact(TASK, "b", Epoch(1, "a"))
LATER = TaskFact(TASK, "c", Epoch(2, "b"))


@pytest.mark.parametrize(
    ("facts", "verdict", "missing"),
    [
        (BirthFacts(), Verdict.BORN, ()),
        (BirthFacts(("b", "c"), ("c", "b", "d")), Verdict.BORN, ()),
        (BirthFacts(("b", "c"), ("b",)), Verdict.WAITS, ("c",)),
        (BirthFacts(("b", "c"), ("b",), over=True), Verdict.UNASKED, ("c",)),
        (BirthFacts(("b", "c"), (), guardians=(), over=True), Verdict.WAITS, ("b", "c")),
        (BirthFacts(("b", "c"), ("b", "c"), guardians=("d", "e")), Verdict.BORN, ()),
        (BirthFacts(("b", "c"), ("b",), guardians=("b", "c"), over=True), Verdict.WAITS, ("c",)),
        (BirthFacts(("b", "c", "d"), ("b", "c"), guardians=("b", "c"), over=True), Verdict.UNASKED, ("d",)),
        (BirthFacts(("b", "c", "d"), ("b", "c"), guardians=("b", "c")), Verdict.WAITS, ("d",)),
        (BirthFacts(("b",), ("c",), guardians=("c",), over=True), Verdict.UNASKED, ("b",)),
        (BirthFacts(("b",), ("b",), (THERE,)), Verdict.RESTS, ()),
        (BirthFacts((), (), (THERE,)), Verdict.RESTS, ()),
        (BirthFacts(("b", "c"), ("b",), (THERE,), over=True), Verdict.RESTS, ("c",)),
        (BirthFacts(("b",), ("b",), (THERE,), guardians=("b",), over=True), Verdict.RESTS, ()),
    ],
)
def test_the_decision(facts: BirthFacts, verdict: Verdict, missing: tuple[str, ...]) -> None:
    birth = birth_of(facts)
    assert (birth.verdict, birth.missing) == (verdict, missing)


@pytest.mark.parametrize("known", [(THERE, LATER), (LATER, THERE)])
def test_of_several_facts_the_newest_is_told(known: tuple[TaskFact, ...]) -> None:
    assert birth_of(BirthFacts(known=known)) == Birth(Verdict.RESTS, fact=LATER)


@pytest.mark.parametrize(
    ("record", "owner", "epoch"),
    [
        (Record(TASK, Phase.OWNER, Epoch(1, "b"), Epoch(3, "a"), peer="c"), "b", Epoch(3, "a")),
        (Record(TASK, Phase.FROZEN, Epoch(1, "b"), Epoch(2, "b"), Epoch(2, "b"), "c"), "b", Epoch(2, "b")),
        (Record(TASK, Phase.COMMITTED, Epoch(1, "b"), Epoch(1, "b"), Epoch(2, "b"), "c"), "c", Epoch(2, "b")),
        (Record(TASK, Phase.PREPARED, NO_EPOCH, NO_EPOCH, Epoch(2, "c"), "c"), "c", Epoch(2, "c")),
        (Record(TASK, Phase.RELEASED, Epoch(1, "b"), Epoch(2, "b"), peer="c"), "c", Epoch(2, "b")),
        (Record(TASK, seen=Epoch(2, "c"), peer="c"), "c", Epoch(2, "c")),
        (Record(TASK, seen=Epoch(0, "b")), "", Epoch(0, "b")),
    ],
)
def test_each_record_says_that_the_task_was_born_and_where_it_is(record: Record, owner: str, epoch: Epoch) -> None:
    assert fact_of("b", record) == TaskFact(TASK, owner, epoch)


def test_an_agent_that_has_never_heard_of_it_knows_nothing() -> None:
    assert fact_of("b", Record(TASK)) is None
    assert newest_fact([None]) is None
    assert newest_fact([None, LATER, THERE]) == LATER


def test_all_tasks_are_asked_about_each_once() -> None:
    task_ids = [TaskId("a", f"T{number}") for number in range(2 * MOST_ASKED + 1)]
    asked = questions(task_ids)
    assert [len(it.task_ids) for it in asked] == [MOST_ASKED, MOST_ASKED, 1]
    assert [task_id for it in asked for task_id in it.task_ids] == task_ids
