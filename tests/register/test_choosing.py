"""Whom the owner of a task chooses as its guardians."""

from pancakes.durable.messages import CanGuard, choose
from pancakes.durable.record import TaskId
from pancakes.durable.register import Identity

TASK = TaskId("a", "Scan")
A, B, C, D, E = (Identity(name, "j") for name in "abcde")


def can(guardian, refusal="", runs=True, battery=False, up_s=1000.0):
    return CanGuard(TASK, guardian, refusal, runs, battery, up_s)


def chosen(*answers, now=(A,), silent=(), named=(), number=3):
    return choose(A, now, silent, named, number, answers)


def test_two_others_are_needed():
    assert chosen(can(B)) is None
    assert chosen(can(B), can(C)) == (A, B, C)
    assert chosen(can(B), can(C), number=5) is None


def test_one_that_refuses_and_the_owner_itself_are_none():
    assert chosen(can(B, "may not"), can(C), can(A)) is None


def test_the_order():
    battery, new, witness = can(B, battery=True), can(C, up_s=1.0), can(D, runs=False)
    assert chosen(battery, new, witness, can(E)) == (A, E, C)
    assert chosen(battery, witness, can(E)) == (A, E, B)
    assert chosen(battery, new, witness, can(E), named=["d"]) == (A, D, E)


def test_those_that_are_there_stay_unless_they_are_silent():
    assert chosen(can(D), can(E), now=(A, C, B)) == (A, C, B)
    assert chosen(can(D, battery=True), now=(A, B, C), silent=[B]) == (A, C, D)
    assert chosen(now=(A, B, C), silent=[B]) is None


def test_an_agent_whose_disk_was_lost_takes_its_own_place():
    again = Identity("b", "other")
    assert chosen(can(again), now=(A, B, C), silent=[B]) == (A, C, again)
