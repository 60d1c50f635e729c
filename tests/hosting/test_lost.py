"""What is known of a task whose record was lost, and what a person is told before a decision."""

from __future__ import annotations

import pytest
from msgspec.structs import replace
from register.registers import OWNED, TASK, A, B, record

from pancakes.durable.record import Lost
from pancakes.durable.register import NO_EPOCH, Epoch, Standing, Wanted

UNREAD = Lost(TASK, "its record cannot be read")
READ = Lost(TASK, "its journal is a copy", read=record(Standing.YIELDED))


def test_epoch_of_an_adoption_is_above_all_that_is_known() -> None:
    assert (UNREAD.seen, READ.seen) == (NO_EPOCH, Epoch(1, B, 4))
    assert replace(READ, heard=Epoch(0, B)).seen == Epoch(1, B, 4)
    assert replace(READ, heard=Epoch(5, A)).seen == replace(UNREAD, heard=Epoch(5, A)).seen == Epoch(5, A)
    assert (UNREAD.jump, replace(UNREAD, times=3).jump) == (1_000_000, 3_000_000)


@pytest.mark.parametrize(
    ("standing", "was"),
    [
        (Standing.NONE, "was not here"),
        (Standing.OWNER, "was here"),
        (Standing.OFFERED, "was here, and about to go to b"),
        (Standing.YIELDED, "was given to b"),
        (Standing.DISPUTED, "was here, and on another agent too"),
        (Standing.HEIR, "was on its way here from b"),
        (Standing.MEMBER, "was with b, and guarded here"),
        (Standing.RELEASED, "was with b"),
    ],
)
def test_what_can_be_read_of_it_is_told(standing: Standing, was: str) -> None:
    assert UNREAD.story() == "its record cannot be read"
    lost = replace(READ, read=record(standing))
    assert lost.story() == f"its journal is a copy; as far as it can be read, the task {was}"


def test_removal_of_a_lost_task_is_told() -> None:
    lost = replace(READ, read=record(OWNED._replace(wanted=Wanted.REMOVED)))
    assert lost.story().endswith("the task was removed")


def test_person_is_told_how_to_decide() -> None:
    told = UNREAD.undecided("d")
    assert told.startswith("it may run elsewhere, and its record cannot be read. It stays at rest until you decide: ")
    assert "`pancakes task recover d/Scan --here` runs it here" in told
    assert "`pancakes task recover d/Scan --not-here` leaves it there" in told
