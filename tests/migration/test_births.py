"""Whether a task is born: the decision as a table, and what an agent knows of a task."""

from __future__ import annotations

import pytest

from pancakes.durable.answers import fact_of, newest_fact
from pancakes.durable.messages import Fact
from pancakes.durable.questions import Birth, BirthFacts, Verdict, birth_of
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Epoch, Identity, Register, Wanted

TASK = TaskId("a", "Scan")
B, C = Identity("b"), Identity("c")
THERE = Fact(TASK, Register(Epoch(1, B), 0, ((B,),)))
LATER = Fact(TASK, Register(Epoch(2, C), 0, ((C,),)))


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
def test_of_several_facts_the_newest_is_told(known: tuple[Fact, ...]) -> None:
    assert birth_of(BirthFacts(known=known)) == Birth(Verdict.RESTS, fact=LATER)


def test_a_record_says_that_the_task_was_born_and_not_its_state() -> None:
    register = Register(Epoch(1, B), 4, ((B,),), state=b"state", promised=Epoch(3, C))
    fact = fact_of(Record(TASK, register, B))
    assert fact.register == register.summary()
    assert (fact.epoch, fact.removed) == (Epoch(3, C), False)


def test_of_facts_under_one_epoch_the_removal_is_the_newest() -> None:
    gone = Fact(TASK, THERE.register._replace(no=1, wanted=Wanted.REMOVED))
    assert newest_fact([None]) is None
    assert newest_fact([None, LATER, THERE]) == LATER
    assert newest_fact([gone, THERE]) == newest_fact([THERE, gone]) == gone
