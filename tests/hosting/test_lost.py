"""What is known of a task whose record was lost, and what a person is told before a decision."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from pancakes.durable.record import NO_EPOCH, Epoch, Lost, Phase, Record, TaskId, Wanted

SCAN = TaskId("a", "Scan")
UNREAD = Lost(SCAN, "its record cannot be read")
GIVEN = Record(SCAN, Phase.COMMITTED, seen=Epoch(4, "a"), peer="b", snapshot=b"s")
READ = Lost(SCAN, "its journal is a copy", read=GIVEN)


def test_the_epoch_of_an_adoption_is_above_all_that_is_known() -> None:
    assert (UNREAD.seen, READ.seen) == (NO_EPOCH, Epoch(4, "a"))
    assert replace(READ, heard=Epoch(3, "c")).seen == Epoch(4, "a")
    assert replace(READ, heard=Epoch(5, "c")).seen == replace(UNREAD, heard=Epoch(5, "c")).seen == Epoch(5, "c")
    assert (UNREAD.jump, replace(UNREAD, times=3).jump) == (1_000_000, 3_000_000)


@pytest.mark.parametrize(
    ("phase", "was"),
    [
        (Phase.ABSENT, "was not here"),
        (Phase.OWNER, "was here"),
        (Phase.FROZEN, "was here, and about to be handed over to b"),
        (Phase.COMMITTED, "was given to b"),
        (Phase.PREPARED, "was on its way here from b"),
        (Phase.RELEASED, "was handed over to b"),
    ],
)
def test_what_can_be_read_of_it_is_told(phase: Phase, was: str) -> None:
    assert UNREAD.story() == "its record cannot be read"
    lost = replace(READ, read=replace(GIVEN, phase=phase))
    assert lost.story() == f"its journal is a copy; as far as it can be read, the task {was}"


def test_that_it_was_removed_is_told() -> None:
    lost = replace(READ, read=replace(GIVEN, phase=Phase.RELEASED, wanted=Wanted.REMOVED))
    assert lost.story().endswith("the task was removed")


def test_a_person_is_told_what_would_be_lost() -> None:
    assert (UNREAD.snapshot, READ.snapshot) == (b"", b"s")
    assert "(as its configuration says, its state is lost)" in UNREAD.meaning("d")
    assert "it runs on d (from what is in that record), under a new epoch" in READ.meaning("d")
    assert UNREAD.meaning("d").startswith("of a/Scan, its record cannot be read. Adopted by force, ")
    assert UNREAD.meaning("d").endswith("`pancakes task forget d/Scan` leaves it there. Nothing was done")


def test_a_person_is_told_how_to_decide() -> None:
    told = UNREAD.undecided("d")
    assert told.startswith("it may run elsewhere, and its record cannot be read. It stays at rest until you decide: ")
    assert "`pancakes task adopt d/Scan --force` runs it here" in told
    assert "`pancakes task forget d/Scan` leaves it there" in told
