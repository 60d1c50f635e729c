"""What is remembered of boots, and what becomes of the tasks of an agent whose disk is an old copy."""

from __future__ import annotations

import pytest

from pancakes.durable.answers import MOST_JOURNALS, Boot, BootsSeen
from pancakes.durable.messages import Fact
from pancakes.durable.questions import Verdict, copied_task
from pancakes.durable.record import TaskId
from pancakes.durable.register import Epoch, Identity, Register

MET = Boot("disk", 5, "fifth")


def seen(*boots: Boot) -> BootsSeen:
    known = BootsSeen()
    for boot in boots:
        known = known.with_(boot)
    return known


@pytest.mark.parametrize(
    ("boot", "contradicted"),
    [
        (MET, False),
        (Boot("disk", 6, "sixth"), False),
        (Boot("disk", 4, "fourth"), True),
        (Boot("disk", 4, "another fourth"), True),
        (Boot("disk", 5, "another fifth"), True),
        (Boot("new disk", 1, "first"), False),
    ],
)
def test_a_disk_that_lacks_a_boot_which_was_met_is_an_old_copy(boot: Boot, contradicted: bool) -> None:
    known = seen(Boot("disk", 4, "fourth"), MET)
    assert (known.after(boot) == MET) is contradicted
    assert (known.with_(boot) == known) is (contradicted or boot == MET), "of a copy nothing is remembered"


def test_a_disk_that_comes_back_after_another_one_is_remembered() -> None:
    known = seen(MET, Boot("new disk", 1, "first"))
    assert known.after(Boot("disk", 3, "third")) == MET


def test_of_each_journal_the_newest_boot_is_remembered() -> None:
    # Each came in a packet of its own: equal, and not the same text.
    later = Boot("disk".upper().lower(), 6, "sixth")
    assert later.journal is not MET.journal
    assert seen(MET, later).boots == (later,)


def test_the_newest_journals_of_an_agent_are_remembered() -> None:
    known = seen(MET, *(Boot(f"disk {number}", 1, "first") for number in range(MOST_JOURNALS)))
    assert len(known.boots) == MOST_JOURNALS and known.after(Boot("disk", 1, "first")) is None


def test_what_is_told_of_another_journal_says_nothing() -> None:
    assert not Boot("disk", 1, "first").is_before(Boot("another disk", 9, "ninth"))
    assert Boot("disk", 1, "first").is_before(Boot("disk", 9, "ninth"))


TASK = TaskId("a", "Scan")
A, B = Identity("a"), Identity("b")
OURS = Epoch(3, A)
LATER, SAME = Fact(TASK, Register(Epoch(4, B), 0, ((B,),))), Fact(TASK, Register(OURS, 0, ((A,),)))


@pytest.mark.parametrize(
    ("sayers", "told", "known", "verdict", "missing"),
    [
        ("", "", [], Verdict.GOES_ON, ()),
        ("b", "", [], Verdict.GOES_ON, ()),
        ("b", "b", [LATER], Verdict.GOES_ON, ()),
        ("bc", "", [], Verdict.WAITS, ("b", "c")),
        ("bc", "b", [], Verdict.WAITS, ("c",)),
        ("bc", "bd", [SAME], Verdict.WAITS, ("c",)),
        ("bc", "bc", [], Verdict.GOES_ON, ()),
        ("bc", "bc", [SAME], Verdict.GOES_ON, ()),
        ("bc", "b", [LATER], Verdict.RESTS, ()),
        ("bcd", "bcd", [SAME, LATER], Verdict.RESTS, ()),
    ],
)
def test_what_becomes_of_a_task_on_an_old_copy(
    sayers: str, told: str, known: list[Fact], verdict: Verdict, missing: tuple[str, ...]
) -> None:
    copied = copied_task(OURS, set(sayers), set(told), known)
    assert (copied.verdict, copied.missing) == (verdict, missing)
    assert copied.fact == (LATER if verdict is Verdict.RESTS else None)
