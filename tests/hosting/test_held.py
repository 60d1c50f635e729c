"""The checkpoints of a task that agents besides its owner tell of when they are asked."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from pancakes.control import Checkpoints
from pancakes.durable.guardian import is_meant, of_records, of_register
from pancakes.durable.guarding import GuardRegister
from pancakes.durable.messages import CheckpointBody, CheckpointId
from pancakes.durable.record import Epoch, GuardianId, Guards, Phase, Record, TaskId, Wanted
from pancakes.durable.snapshot import Snapshot

SCAN = TaskId("a", "Scan")
SNAPSHOT = Snapshot(SCAN, "test.Scan", "1", "client").encode()
ASKED = Checkpoints("Scan")
REGISTER = GuardRegister(
    SCAN,
    "test.Scan",
    Epoch(4, "c"),
    CheckpointId(Epoch(3, "b"), 7),
    CheckpointBody(SNAPSHOT, Wanted.STOPPED),
    Guards(Epoch(3, "b"), 1, ((GuardianId("b", "1"), GuardianId("c", "2")), (GuardianId("d", "3"),))),
)
IN_DOUBT = Record(SCAN, Phase.COMMITTED, Epoch(3, "b"), Epoch(5, "b"), Epoch(4, "b"), "c", snapshot=SNAPSHOT)
ROW = {"task_id": "a/Scan", "type": "test.Scan", "service": "client"}


def test_a_task_is_meant_by_its_name_and_where_several_have_that_by_its_birthplace() -> None:
    assert is_meant(ASKED, SCAN) and is_meant(Checkpoints("Scan", "a"), SCAN)
    assert not is_meant(Checkpoints("Scan", "b"), SCAN) and not is_meant(Checkpoints("Other"), SCAN)


def test_a_guardian_tells_what_it_has_on_disk() -> None:
    held = {"held": "guardian", "wanted": "stopped", "age_s": 1.5, "at_least": True, "epoch": [3, "b"], "no": 7}
    row = {**ROW, **held, "seen": 4, "guardians": [["b", "c"], ["d"]], "peer": ""}
    assert list(of_register(REGISTER, 1.5, True, ASKED)) == [row]
    (with_body,) = of_register(REGISTER, 1.5, True, Checkpoints("Scan", body=True))
    assert with_body == {**row, "snapshot": SNAPSHOT}


def test_a_guardian_that_has_promised_nothing_since_tells_the_epoch_of_the_checkpoint() -> None:
    (row,) = of_register(replace(REGISTER, promised=Epoch(2, "b")), 0.0, False, ASKED)
    assert (row["seen"], row["at_least"]) == (3, False)


def test_a_guardian_without_a_checkpoint_tells_nothing() -> None:
    assert list(of_register(replace(REGISTER, body=None), 0.0, False, ASKED)) == []
    unreadable = replace(REGISTER, body=CheckpointBody(b"no snapshot"))
    assert list(of_register(unreadable, 0.0, False, ASKED)) == []


@pytest.mark.parametrize("phase", [Phase.COMMITTED, Phase.PREPARED])
def test_an_agent_tells_of_a_task_whose_hand_off_is_in_doubt(phase: Phase) -> None:
    held = {"held": "in doubt", "wanted": "running", "age_s": None, "at_least": True, "epoch": [4, "b"], "no": 0}
    row = {**ROW, **held, "seen": 5, "guardians": [], "peer": "c"}
    assert list(of_records([replace(IN_DOUBT, phase=phase)], ASKED)) == [row]
    (later,) = of_records([replace(IN_DOUBT, phase=phase, offer=Epoch(6, "b"))], ASKED)
    assert (later["seen"], later["epoch"]) == (6, [6, "b"])


@pytest.mark.parametrize(
    "record",
    [
        replace(IN_DOUBT, phase=Phase.OWNER),
        replace(IN_DOUBT, phase=Phase.FROZEN),
        replace(IN_DOUBT, phase=Phase.RELEASED),
        replace(IN_DOUBT, snapshot=b""),
        replace(IN_DOUBT, snapshot=b"no snapshot"),
        replace(IN_DOUBT, task_id=TaskId("a", "Other")),
    ],
)
def test_of_others_it_tells_nothing(record: Record) -> None:
    assert list(of_records([record, IN_DOUBT], ASKED)) == list(of_records([IN_DOUBT], ASKED)) != []
