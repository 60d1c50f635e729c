"""Which task is meant where a person adopts or forgets one, and what is said where none can be."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from pancakes.durable.commands import task_meant
from pancakes.durable.record import Epoch, Phase, Record, TaskId, Wanted
from pancakes.errors import ControlRefusedError

SCAN, OTHER = TaskId("a", "Scan"), TaskId("z", "Scan")
MINE = Epoch(3, "a")
OWNED = Record(SCAN, Phase.OWNER, epoch=MINE, seen=MINE)
GIVEN = Record(SCAN, Phase.COMMITTED, epoch=MINE, seen=MINE, offer=Epoch(4, "a"), peer="b")
COMING = Record(OTHER, Phase.PREPARED, seen=MINE, offer=Epoch(4, "c"), peer="c")


def refusal(*records: Record, birthplace: str = "", verb: str = "adopt") -> str:
    with pytest.raises(ControlRefusedError) as refused:
        task_meant("a/client", "Scan", birthplace, records, (), verb)
    return str(refused.value)


def test_the_one_that_is_in_doubt_is_meant() -> None:
    assert task_meant("a/client", "Scan", "", (GIVEN,), ()) == GIVEN
    assert task_meant("a/client", "Scan", "z", (GIVEN, COMING), ()) == COMING
    assert task_meant("a/client", "Scan", "", (replace(OWNED, task_id=OTHER), GIVEN), ()) == GIVEN


def test_of_two_in_doubt_the_birthplace_says_which() -> None:
    assert refusal(GIVEN, COMING) == "a/client has a/Scan and z/Scan in doubt: say which by its birthplace"


@pytest.mark.parametrize(
    ("record", "stands"),
    [
        (OWNED, "here already"),
        (replace(OWNED, phase=Phase.FROZEN, offer=Epoch(4, "a"), peer="b"), "here, and about to be handed over"),
        (Record(SCAN, Phase.RELEASED, epoch=MINE, seen=MINE, peer="b"), "with b, which has said so"),
        (Record(SCAN, Phase.ABSENT, seen=MINE, peer="b"), "not here, b had it last"),
    ],
)
def test_of_one_that_is_not_in_doubt_it_is_said_how_it_stands(record: Record, stands: str) -> None:
    assert refusal(record) == f"there is nothing to adopt: a/Scan is {stands}"


@pytest.mark.parametrize(
    ("record", "stands"),
    [
        (GIVEN, "in doubt between this agent and b, so adopt it or wait"),
        (replace(OWNED, wanted=Wanted.DISPUTED, peer="b"), "here, and owned by b too"),
        (Record(SCAN, Phase.RELEASED, epoch=MINE, seen=MINE, wanted=Wanted.REMOVED), "removed"),
    ],
)
def test_only_what_was_lost_is_forgotten(record: Record, stands: str) -> None:
    assert refusal(record, verb="forget") == f"there is nothing to forget: a/Scan is {stands}"


def test_of_a_task_that_it_has_never_heard_of_it_says_so() -> None:
    assert refusal() == "a/client knows of no task 'Scan'"
    assert refusal(OWNED, birthplace="q") == "a/client knows of no task 'Scan' of q"
