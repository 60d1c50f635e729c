"""Which task a person means that is to be adopted or forgotten, and what is said if none can be meant."""

from __future__ import annotations

import pytest
from msgspec.structs import replace
from register.registers import OWNED, TASK, record

from pancakes.durable.commands import task_meant
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Standing, Wanted
from pancakes.errors import ControlRefusedError

OTHER = TaskId("z", "Scan")
GIVEN = record(Standing.YIELDED)
COMING = replace(record(Standing.HEIR), task_id=OTHER)


def refusal(*records: Record, birthplace: str = "", verb: str = "adopt") -> str:
    with pytest.raises(ControlRefusedError) as refused:
        task_meant("a/client", "Scan", birthplace, records, (), verb)
    return str(refused.value)


def test_task_in_doubt_is_meant() -> None:
    assert task_meant("a/client", "Scan", "", (GIVEN,), ()) == GIVEN
    assert task_meant("a/client", "Scan", "z", (GIVEN, COMING), ()) == COMING
    assert task_meant("a/client", "Scan", "", (replace(record(), task_id=OTHER), GIVEN), ()) == GIVEN
    for standing in (Standing.DISPUTED, Standing.RELEASED):
        assert task_meant("a/client", "Scan", "", (record(standing),), ()) == record(standing)


def test_doubt_comes_before_what_has_moved() -> None:
    moved = replace(record(Standing.RELEASED), task_id=OTHER)
    assert task_meant("a/client", "Scan", "", (GIVEN, moved), ()) == GIVEN
    assert task_meant("a/client", "Scan", "z", (GIVEN, moved), ()) == moved


def test_of_two_in_doubt_the_birthplace_says_which() -> None:
    assert refusal(GIVEN, COMING) == "a/client has a/Scan and z/Scan in doubt: say which by its birthplace"


@pytest.mark.parametrize(
    ("standing", "stands"),
    [
        (Standing.OWNER, "is here already"),
        (Standing.OFFERED, "is being handed over to b"),
    ],
)
def test_task_that_is_not_in_doubt_is_told_of(standing: Standing, stands: str) -> None:
    assert refusal(record(standing)) == f"there is nothing to adopt: a/Scan {stands}"


@pytest.mark.parametrize(
    ("known", "stands"),
    [
        (GIVEN, "was given to b, which has not yet said that it has it"),
        (record(Standing.DISPUTED), "is owned by another agent too"),
        (record(OWNED._replace(wanted=Wanted.REMOVED)), "was removed"),
    ],
)
def test_only_what_never_came_is_forgotten(known: Record, stands: str) -> None:
    assert refusal(known, verb="forget").startswith(f"there is nothing to forget: a/Scan {stands}")
    assert task_meant("a/client", "Scan", "", (COMING,), (), "forget") == COMING


def test_task_that_was_never_heard_of_is_not_known() -> None:
    assert refusal() == "a/client knows of no task 'Scan'"
    assert refusal(record(), birthplace="q") == "a/client knows of no task 'Scan' of q"
    assert TASK.birthplace == "a"
