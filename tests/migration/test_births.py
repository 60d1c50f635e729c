"""Whether a task is born: the decision as a table, and what an agent knows of a task."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest

from pancakes.durable.answers import fact_of, newest_fact
from pancakes.durable.messages import Fact
from pancakes.durable.questions import Finding, Verdict, birth_of
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Epoch, Identity, Register, Wanted

TASK = TaskId("a", "Scan")
B, C = Identity("b"), Identity("c")
THERE = Fact(TASK, Register(Epoch(1, B), 0, ((B,),)))
LATER = Fact(TASK, Register(Epoch(2, C), 0, ((C,),)))


@pytest.mark.parametrize(
    ("decide", "verdict", "missing"),
    [
        (partial(birth_of), Verdict.GOES_ON, ()),
        (partial(birth_of, ("b", "c"), ("c", "b", "d")), Verdict.GOES_ON, ()),
        (partial(birth_of, ("b", "c"), ("b",)), Verdict.WAITS, ("c",)),
        (partial(birth_of, ("b", "c"), ("b",), over=True), Verdict.UNASKED, ("c",)),
        (partial(birth_of, ("b", "c"), (), guardians=(), over=True), Verdict.WAITS, ("b", "c")),
        (partial(birth_of, ("b", "c"), ("b", "c"), guardians=("d", "e")), Verdict.GOES_ON, ()),
        (partial(birth_of, ("b", "c"), ("b",), guardians=("b", "c"), over=True), Verdict.WAITS, ("c",)),
        (partial(birth_of, ("b", "c", "d"), ("b", "c"), guardians=("b", "c"), over=True), Verdict.UNASKED, ("d",)),
        (partial(birth_of, ("b", "c", "d"), ("b", "c"), guardians=("b", "c")), Verdict.WAITS, ("d",)),
        (partial(birth_of, ("b",), ("c",), guardians=("c",), over=True), Verdict.UNASKED, ("b",)),
        (partial(birth_of, ("b",), ("b",), (THERE,)), Verdict.RESTS, ()),
        (partial(birth_of, (), (), (THERE,)), Verdict.RESTS, ()),
        (partial(birth_of, ("b", "c"), ("b",), (THERE,), over=True), Verdict.RESTS, ("c",)),
        (partial(birth_of, ("b",), ("b",), (THERE,), guardians=("b",), over=True), Verdict.RESTS, ()),
    ],
)
def test_the_decision(decide: Callable[[], Finding], verdict: Verdict, missing: tuple[str, ...]) -> None:
    birth = decide()
    assert (birth.verdict, birth.missing) == (verdict, missing)


@pytest.mark.parametrize("known", [(THERE, LATER), (LATER, THERE)])
def test_of_several_facts_the_newest_is_told(known: tuple[Fact, ...]) -> None:
    assert birth_of(known=known) == Finding(Verdict.RESTS, fact=LATER)


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
