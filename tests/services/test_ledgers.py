"""What an agent keeps of the moves that it was asked for."""

import pytest
from msgspec.structs import replace

from pancakes.control import Migrate, Migrations
from pancakes.durable.store import LEDGER, MigrationReports
from pancakes.journal import Disk, JournalEntry, MemoryJournal, VirtualStore
from pancakes.migration import Line, MigrationReport
from pancakes.task import Task
from pancakes.testing import Fleet

CLASSES = {"test.Task": Task}

KEPT = 100
"""As docs/protocol.md says."""


def ledger(name="Count"):
    return MigrationReport(
        f"a/{name}", "a", "rule", "tasks", "moved", "b", (Line("b", "bid", "won", 1.0, {"tasks": 1.0}),), 0.5
    )


def test_each_move_is_kept_over_a_crash_with_all_that_was_said():
    with Fleet(1, classes=CLASSES) as fleet:
        a = fleet.start("a", tasks={"Count": Task, "Other": Task})
        fleet.start("b", tasks={"Mine": Task})
        fleet.start("world", role="environment")
        fleet.connect()
        assert a.ask(Migrate("Count")).ok
        assert not a.ask(Migrate("Other", to="nobody")).ok
        fleet.run_for(0.1)
        fleet.crash("a")
        a = fleet.restart("a")
        fleet.connect()
        fleet.run_for(3.0)
        assert a.ask(Migrate("Other")).ok

        moved, stayed, second = a.ask(Migrations()).result

    assert [(row["number"], row["boot"], row["outcome"], row["winner"]) for row in (moved, stayed, second)] == [
        (1, 1, "moved", "b"),
        (2, 1, "stayed", ""),
        (3, 2, "moved", "b"),
    ]
    assert (moved["task_id"], moved["source"], moved["asked_by"], moved["reason"]) == (
        "a/Count",
        "a",
        "a/test/Probe",
        "",
    )
    assert moved["lines"] == [
        {
            "peer": "b",
            "answer": "bid",
            "fate": "won",
            "cost": 1.0,
            "terms": {"active tasks": 1.0},
            "reason": "",
            "code": "",
            "retry_after_s": None,
        }
    ]
    assert stayed["reason"] == "no neighbour can take Other: nobody is not linked to a, only b"


def test_another_agent_gets_the_same_answer():
    with Fleet(1, classes=CLASSES) as fleet:
        a = fleet.start("a", tasks={"Count": Task})
        b = fleet.start("b")
        fleet.connect()
        assert a.ask(Migrate("Count")).ok
        assert b.ask(Migrations(), to="a").result == a.ask(Migrations()).result != []
        assert b.ask(Migrations()).result == []


def test_a_dry_run_is_no_move():
    with Fleet(1, classes=CLASSES) as fleet:
        a = fleet.start("a", tasks={"Count": Task})
        fleet.start("b")
        fleet.connect()
        assert a.ask(Migrate("Count", dry_run=True)).ok
        assert not a.ask(Migrate("Count", to="nobody", dry_run=True)).ok
        assert a.ask(Migrations()).result == []


@pytest.fixture
def disk():
    return {}


def opened(disk, log=print):
    """Returns what is made of the journal on a disk, what writes to it, and what is told of it."""
    journal = MemoryJournal(disk, "id")
    store = VirtualStore(journal, lambda delay_s, call: call())
    unread: list[str] = []
    return MigrationReports(Disk(journal, store, unread), log), store, unread


def test_the_newest_hundred_are_kept(disk):
    ledgers, store, _ = opened(disk)
    for number in range(KEPT + 30):
        ledgers.add(ledger(f"Task{number}"), "", float(number))
    before = ledgers.plain()
    store.close()

    ledgers, *_ = opened(disk)

    assert ledgers.plain() == before
    assert [row["number"] for row in before] == list(range(31, KEPT + 31))
    assert before[-1]["task_id"] == f"a/Task{KEPT + 29}"
    assert len([name for name in disk if name.startswith(LEDGER)]) == KEPT
    ledgers.add(ledger(), "", 0.0)
    assert ledgers.plain()[-1]["number"] == KEPT + 31


def test_the_account_of_a_hand_off_is_kept_once_also_over_a_restart(disk):
    ledgers, store, _ = opened(disk)
    moved = replace(ledger(), offer="1@a")
    ledgers.add(moved, "", 1.0)
    ledgers.add(moved, "", 2.0)
    store.close()

    ledgers, *_ = opened(disk)
    ledgers.add(moved, "", 3.0)
    ledgers.add(replace(moved, offer="2@a"), "", 4.0)

    assert [row["mission_s"] for row in ledgers.plain()] == [1.0, 4.0]


def test_one_that_cannot_be_read_is_named_and_the_others_are_there(disk):
    ledgers, store, _ = opened(disk)
    ledgers.add(ledger(), "", 1.0)
    store.persist(JournalEntry(LEDGER, "77", b"not an account"), lambda: None, print)
    store.close()

    ledgers, _, (sentence,) = opened(disk)

    assert [row["number"] for row in ledgers.plain()] == [1]
    assert sentence.startswith("the journal's account 77 of a move is not used: ")


def test_one_that_cannot_be_written_is_told(disk):
    said = []
    ledgers, store, _ = opened(disk, lambda level, text: said.append((level, text)))
    store.close()

    ledgers.add(ledger(), "", 1.0)

    assert said == [("warning", "the account of the move of a/Count is not in the journal: the journal is closed")]
    assert len(ledgers.plain()) == 1
