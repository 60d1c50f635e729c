"""What a record says of a task: its views, and its form on disk."""

from __future__ import annotations

import msgpack
import pytest
from register.registers import GUARDED, OWNED, REGISTERS, STATE, TASK, A, B, C, D, record

from pancakes.durable.record import Record, TaskId, dispute_of, rest_of, resting, why_not_here
from pancakes.durable.register import Epoch, Register, Standing, Wanted, standing_of
from pancakes.errors import MigrationError

VIEWS = ("owned", "here", "in_doubt", "under_way", "disputed", "unborn", "may_begin")
TRUE_OF = {
    Standing.NONE: {"unborn", "may_begin"},
    Standing.OWNER: {"owned", "here"},
    Standing.OFFERED: {"owned", "here", "under_way"},
    Standing.YIELDED: {"here", "in_doubt", "under_way"},
    Standing.DISPUTED: {"owned", "here", "disputed"},
    Standing.HEIR: {"here", "in_doubt", "under_way"},
    Standing.MEMBER: set(),
    Standing.RELEASED: set(),
}
REMOVED = OWNED._replace(wanted=Wanted.REMOVED, state=None)


@pytest.mark.parametrize("standing", Standing, ids=lambda it: it.name)
def test_record_in_each_standing(standing: Standing) -> None:
    it = record(standing)
    assert it.standing is standing_of(A, it.register) is standing
    assert {view for view in VIEWS if getattr(it, view)} == TRUE_OF[standing]


@pytest.mark.parametrize(
    ("standing", "peer"),
    [
        (Standing.NONE, ""),
        (Standing.OWNER, ""),
        (Standing.OFFERED, "b"),
        (Standing.YIELDED, "b"),
        (Standing.DISPUTED, ""),
        (Standing.HEIR, "b"),
        (Standing.MEMBER, "b"),
        (Standing.RELEASED, "b"),
    ],
)
def test_agent_on_the_other_side(standing: Standing, peer: str) -> None:
    assert record(standing).peer == peer


def test_removed_task_may_begin_and_has_no_peer() -> None:
    it = record(REMOVED)
    assert (it.standing, it.removed, it.may_begin, it.peer, it.snapshot) == (Standing.RELEASED, True, True, "", b"")
    assert record(REGISTERS[Standing.RELEASED]._replace(wanted=Wanted.REMOVED)).peer == ""


def test_members_are_each_told_once_in_order() -> None:
    joint = record(OWNED._replace(sets=((A, C), (C, A, D))))
    assert (joint.members, joint.guarded) == ([A, C, D], True)
    assert (record().members, record().guarded, record(GUARDED).guarded) == ([A], False, True)
    assert record(Standing.NONE).members == [] and not record(Standing.NONE).guarded


def test_highest_epoch_is_the_one_that_was_promised() -> None:
    assert (record().seen, record(Standing.YIELDED).seen) == (Epoch(0, A), Epoch(1, B, 4))
    assert record(Standing.YIELDED).epoch == Epoch(0, A)


def test_agent_with_another_disk_is_no_owner_of_what_was_its_own() -> None:
    for former in (A._replace(journal="lost"), A._replace(copy="1")):
        it = record(Register(Epoch(0, former), 3, ((former,),), state=STATE))
        assert (it.standing, it.was_ours, it.owned) == (Standing.RELEASED, True, False)
    assert not record().was_ours and not record(Standing.HEIR).was_ours


@pytest.mark.parametrize("standing", Standing, ids=lambda it: it.name)
def test_record_comes_back_as_it_was_written(standing: Standing) -> None:
    it = record(standing, sequel=b"what follows")
    assert Record.decode(it.encode()) == it


@pytest.mark.parametrize(
    "data",
    [b"", b"\xc1", msgpack.packb([1]), msgpack.packb({"task_id": ["agent1", 3]}), record().encode()[:-1]],
)
def test_bytes_that_are_no_record_are_refused(data: bytes) -> None:
    with pytest.raises(MigrationError, match="no record"):
        Record.decode(data)


@pytest.mark.parametrize(
    ("register", "word"),
    [
        (REGISTERS[Standing.NONE], "otherwise"),
        (OWNED, "otherwise"),
        (OWNED._replace(wanted=Wanted.STOPPED), "stopped"),
        (OWNED._replace(wanted=Wanted.FAILED), "failed"),
        (REMOVED, "otherwise"),
        (REGISTERS[Standing.OFFERED], "otherwise"),
        (REGISTERS[Standing.DISPUTED], "disputed"),
        (REGISTERS[Standing.YIELDED], "moved → b"),
        (REGISTERS[Standing.HEIR], "otherwise"),
        (REGISTERS[Standing.MEMBER], "moved → b"),
        (REGISTERS[Standing.RELEASED], "moved → b"),
    ],
)
def test_word_for_why_a_task_rests(register: Register, word: str) -> None:
    assert rest_of(record(register), "otherwise") == word


def test_task_that_was_let_rest_says_so() -> None:
    forgotten = record(Register(promised=Epoch(3, A), no=1, epoch=Epoch(3, A._replace(agent=""))))
    assert rest_of(forgotten) == "forgotten"


@pytest.mark.parametrize(
    ("register", "why"),
    [
        (OWNED, "a/Scan is here already"),
        (REMOVED, "a/Scan was removed"),
        (REGISTERS[Standing.OFFERED], "a/Scan is being handed over to b"),
        (REGISTERS[Standing.YIELDED], "a/Scan was given to b, which has not yet said that it has it"),
        (REGISTERS[Standing.HEIR], "a/Scan is on its way here from b, which has not yet given it away"),
        (REGISTERS[Standing.RELEASED], "a/Scan moved to b"),
        (REGISTERS[Standing.DISPUTED], dispute_of(record(Standing.DISPUTED))),
    ],
)
def test_sentence_for_why_a_task_is_not_here(register: Register, why: str) -> None:
    assert why_not_here(record(register)) == why


def test_tasks_that_will_not_start_are_told_before_the_start() -> None:
    other = TaskId("a", "Other")
    records = {TASK: record(OWNED._replace(wanted=Wanted.STOPPED)), other: record(Standing.OWNER)}
    assert resting("a", ["Scan", "Other", "New"], records) == {"Scan": "stopped"}


@pytest.mark.parametrize("text", ["ScanTarget", "agent1/", "/ScanTarget", "agent1/client/ScanTarget", ""])
def test_task_id_reads_birthplace_and_name(text: str) -> None:
    assert TaskId.parse(str(TASK)) == TASK
    with pytest.raises(MigrationError, match="birthplace/name"):
        TaskId.parse(text)
