"""Agents are killed exactly where it is said: what is seen, what is written, and what the tally makes of it."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest
from torture.gates import BALLAST_BYTES, Gate, RecordWatch, WriteGate, identity_file, journal_file
from torture.points import POINTS, Point
from torture.proxy import Verdict
from torture.tally import Tally
from torture.traps import Field, Trap
from torture.waits import Waits

from pancakes.mesh.migration.record import Phase, Record, TaskId
from pancakes.runtime.hosting.records import KIND
from pancakes.runtime.journal import FileJournal, JournalEntry, JournalError

TASK = TaskId("a", "One")


def row(kind: str, source: str, to: str, task_id: Any = TASK) -> list[Any]:
    body = {"task_id": list(task_id)}
    return ["network", kind, f"{source}/client", f"{to}/client", 0.0, 1, None, body, None]


class Rig:
    """A trap, and who was killed by it."""

    def __init__(self, directory: Path, point: Point, victim: str = "") -> None:
        self.killed: list[str] = []
        self.trap = Trap(point, Field(TASK, directory, directory, self.killed.append), victim)


def test_a_sender_dies_before_its_word_arrives(tmp_path: Path) -> None:
    rig = Rig(tmp_path, Point("", "migration.commit", "lost"))
    assert rig.trap.watch(row("migration.commit", "b", "c", TaskId("c", "Other"))) is Verdict.PASS
    assert rig.trap.watch(row("migration.prepared", "b", "a")) is Verdict.PASS and not rig.killed
    assert rig.trap.watch(row("migration.commit", "a", "b")) is Verdict.END
    assert rig.killed == ["a"] and rig.trap.spring(0.0) == "a"
    assert rig.trap.watch(row("system", "a", "c")) is Verdict.END, "the dead say nothing"
    assert rig.trap.watch(row("migration.commit", "b", "a")) is Verdict.PASS, "one agent is killed, not two"


def test_a_sender_dies_after_its_word_was_sent(tmp_path: Path) -> None:
    rig = Rig(tmp_path, Point("", "migration.commit", "sent"))
    assert rig.trap.watch(row("migration.commit", "a", "b")) is Verdict.PASS
    assert rig.killed == ["a"]


def test_what_is_to_be_lost_is_lost_until_it_comes_to_the_point(tmp_path: Path) -> None:
    rig = Rig(tmp_path, Point("", "migration.abort", "lost", lose="migration.prepared"))
    assert rig.trap.watch(row("migration.prepared", "b", "a")) is Verdict.LOSE
    assert rig.trap.watch(row("migration.abort", "a", "b")) is Verdict.END and rig.killed == ["a"]


def test_an_agent_is_held_in_the_write_that_follows_a_word(tmp_path: Path) -> None:
    journal = FileJournal(tmp_path / "a")
    journal.write([entry(Phase.OWNER)])
    rig = Rig(tmp_path, Point("", "migration.reserved", "write", Phase.FROZEN))
    assert rig.trap.watch(row("migration.reserved", "b", "a")) is Verdict.PASS
    failures: list[str] = []
    agent = threading.Thread(target=lambda: failures.append(fault(journal, entry(Phase.FROZEN))))
    agent.start()
    assert rig.trap.spring(10.0) == "a" and rig.killed == ["a"]
    assert not failures, "it stands in the write"
    rig.trap.clear()  # in a test it lives, and its write fails
    agent.join(10.0)
    assert "cannot write" in failures[0]
    assert rig.trap.no_disk_s > 0.0
    journal.close()
    (kept,) = FileJournal(tmp_path / "a").entries(KIND)
    assert Record.decode(kept.data).phase is Phase.OWNER


def test_another_record_than_the_one_that_was_meant_is_no_point(tmp_path: Path) -> None:
    journal = FileJournal(tmp_path / "a")
    journal.write([entry(Phase.OWNER)])
    rig = Rig(tmp_path, Point("", "migration.reserved", "write", Phase.FROZEN))
    rig.trap.watch(row("migration.reserved", "b", "a"))

    over = threading.Event()

    def writes() -> None:
        while fault(journal, entry(Phase.OWNER)):  # a checkpoint came first
            pass
        while not over.is_set():  # one may pass while the next gate is laid
            fault(journal, entry(Phase.FROZEN))

    agent = threading.Thread(target=writes, daemon=True)
    agent.start()
    assert rig.trap.spring(10.0) == "a" and rig.killed == ["a"]
    over.set()
    rig.trap.clear()
    agent.join(10.0)
    journal.close()


def test_an_agent_dies_after_a_write(tmp_path: Path) -> None:
    journal = FileJournal(tmp_path / "a")
    journal.write([entry(Phase.COMMITTED)])
    rig = Rig(tmp_path, Point("", "migration.activated", "written"))
    rig.trap.watch(row("migration.activated", "b", "a"))
    assert rig.trap.spring(0.0) == "", "nothing was written yet"
    journal.write([entry(Phase.RELEASED)])
    assert rig.trap.spring(10.0) == "a"
    rig.trap.clear()
    assert rig.trap.no_disk_s == 0.0, "nothing kept it from writing"
    journal.close()


def test_nobody_waits_any_longer_at_a_trap_in_a_run_that_was_broken_off(tmp_path: Path) -> None:
    waits = Waits()
    field = Field(TASK, tmp_path, tmp_path, lambda name: None, waits)
    begun = Trap(Point("", "", "write", Phase.FROZEN), field, "a")
    with pytest.raises(InterruptedError):
        begun.begin(lambda name: waits.break_off())  # it never opens its journal
    with pytest.raises(InterruptedError):
        Trap(Point("", "migration.commit", "lost"), field).spring(1000.0)


def test_the_files_of_a_journal_are_where_the_gates_look_for_them(tmp_path: Path) -> None:
    journal = FileJournal(tmp_path / "a")
    journal.write([entry(Phase.OWNER)])
    assert identity_file(tmp_path, "a").exists()
    journal.close()
    assert journal_file(tmp_path, "a", TASK).exists()


def test_nobody_stands_at_a_gate_that_nobody_came_to(tmp_path: Path) -> None:
    gate = Gate(tmp_path / "gate")
    assert not gate.reached(0.0)
    with pytest.raises(FileExistsError):
        Gate(tmp_path / "gate")
    gate.remove()
    WriteGate(tmp_path).remove()
    assert list(tmp_path.iterdir()) == []


def test_a_gate_in_the_way_of_a_journal_leaves_what_was_there(tmp_path: Path) -> None:
    journal = FileJournal(tmp_path / "a")
    journal.write([entry(Phase.OWNER)])
    before = {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    WriteGate(tmp_path / "a").remove()
    assert {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()} == before
    journal.close()


def test_a_record_is_seen_wherever_it_is_written(tmp_path: Path) -> None:
    journal = FileJournal(tmp_path / "a")
    for one in (entry(Phase.OWNER), entry(Phase.FROZEN), JournalEntry(KIND, str(TASK), bytes(300_000))):
        watch = RecordWatch(tmp_path, "a", TASK)
        journal.write([JournalEntry(KIND, "a/Two", b"")])
        assert not watch.written()
        journal.write([one])
        assert watch.written()
    journal.close()


def test_each_point_has_a_name_of_its_own() -> None:
    names = [point.name for point in POINTS] + [point.then.name for point in POINTS if point.then is not None]
    assert len(names) == len(set(names))


def entry(phase: Phase) -> JournalEntry:
    return JournalEntry(KIND, str(TASK), Record(TASK, phase, snapshot=bytes(BALLAST_BYTES)).encode())


def fault(journal: FileJournal, one: JournalEntry) -> str:
    try:
        journal.write([one])
    except JournalError as error:
        return str(error)
    return ""


def count(directory: Path, durability: str, **files: str) -> Tally:
    for kind, text in files.items():
        (directory / f"One.{kind}").write_text(text)
    tally = Tally()
    tally.count(directory, {"One": durability})
    return tally


def test_a_tally_finds_what_is_doubled_lost_and_under_a_passed_epoch(tmp_path: Path) -> None:
    good = count(tmp_path, "each", count="1 0 a 7\n2 1 b 8\n3 1 b 8\n2 1 b 9\n", heard="1 0\n2 1\n2 1\n")
    assert (good.doubled, good.lost, good.backwards) == ([], [], [])
    assert (good.moves, good.ticks, good.packets, good.worst_step_back) == (1, 4, 3, 1)
    assert count(tmp_path, "each", count="1 1 b 7\n2 0 a 8\n").backwards == ["One ran on a (8) under 0, after 1"]
    assert count(tmp_path, "each", heard="1 0\n1 1\n").doubled == ["One heard packet 1 although its state held 1"]
    assert count(tmp_path, "each", heard="1 0\n3 1\n").lost == ["One heard packet 3 while its state held 1"]
    assert count(tmp_path, "lazy", heard="1 0\n3 1\n").lost == []
    assert count(tmp_path, "lazy", heard="", doubled="b/client/One epoch 1 runs beside another\n").doubled
