"""`pancakes task migrate|migrations|adopt`, on agents that run."""

import json
import signal
from collections.abc import Callable
from typing import Any

import pytest
from cli.processes import Rig, Running
from msgspec.structs import replace

from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.migration.record import Phase, Record
from pancakes.runtime.journal import FileJournal, JournalEntry

SOURCE = """
import time
from dataclasses import dataclass
from pancakes.task import Task, every

class Count(Task):
    @dataclass
    class State:
        n: int = 0

    @every(hz=20)
    def tick(self, tick):
        self.state.n += 1
        self.event("counted", n=self.state.n)

class Drive(Count):
    requires = ("motors",)

class Busy(Task):
    blocking = True

    @every(hz=20)
    def tick(self, tick):
        time.sleep(60.0)
"""
ENTRY_POINTS = """
[pancakes.tasks]
count.Count = plugin_count:Count
count.Drive = plugin_count:Drive
count.Busy = plugin_count:Busy
"""
COUNT = '[task.Count]\ntype = "count.Count"\n\n[task.Home]\ntype = "count.Count"\nstart = false\n'


def command(rig: Rig, *arguments: str) -> tuple[int, list[dict[str, Any]], str]:
    """Runs a command; returns its exit code, what it printed as JSON, and what it said on standard error."""
    result = rig.pancakes(*arguments, "--format", "json")
    return result.returncode, json.loads(result.stdout) if result.stdout else [], result.stderr


def running(rig: Rig, task: str = "Count") -> list[str]:
    """The agents on which a task runs."""
    rows = command(rig, "task", "list")[1]
    return [row["agent"] for row in rows if row["task"] == task and row["state"] == "running"]


@pytest.fixture
def pair(rig: Rig) -> tuple[Running, Running]:
    """Two agents that are connected; the first runs `Count`."""
    rig.install("count", ENTRY_POINTS, SOURCE)
    first = rig.ready("a", COUNT)
    second = rig.ready("b", agent=f'peers = ["{rig.address(first)}"]')
    first.hear("peer_up peer=b")
    first.hear("counted n=")
    return first, second


def test_a_task_moves_and_runs_there_when_the_command_returns(rig: Rig, pair: tuple[Running, Running]):
    code, (ledger,), said = command(rig, "task", "migrate", "a/Count", "--then", "Home", "--to", "b")

    assert (code, said) == (0, "")
    assert (running(rig), running(rig, "Home")) == (["b"], ["a"])
    assert (ledger["task_id"], ledger["outcome"], ledger["winner"], ledger["cost"]) == (
        "a/Count",
        "moved",
        "b",
        "tasks",
    )
    assert ledger["asked_by"].startswith("alice.")
    (line,) = ledger["lines"]
    assert (line["peer"], line["answer"], line["fate"], line["terms"]) == ("b", "bid", "won", {"active tasks": 0.0})
    pair[1].hear("counted n=")

    # What it was is to be seen later too, also on an agent that was started anew.
    (kept,) = command(rig, "task", "migrations", "a")[1]
    assert (kept["number"], kept["boot"], kept["reason"]) == (1, 1, "")
    assert {key: kept[key] for key in ledger} == ledger
    assert command(rig, "task", "migrations", "b")[1] == []
    pair[0].signalled(signal.SIGKILL)
    rig.ready("a", COUNT)
    assert command(rig, "task", "migrations") == (0, [kept], "")


def test_a_dry_run_tells_the_bids_and_moves_nothing(rig: Rig, pair: tuple[Running, Running]):
    code, (ledger,), _ = command(rig, "task", "migrate", "a/client/Count", "--dry-run")

    assert (code, ledger["outcome"], ledger["winner"]) == (0, "dry run", "b")
    assert running(rig) == ["a"]
    assert command(rig, "task", "migrations")[1] == []


def test_a_table_is_for_people(rig: Rig, pair: tuple[Running, Running]):
    result = rig.pancakes("task", "migrate", "a/Count", "--dry-run")

    story, *table = (line.strip() for line in result.stdout.splitlines() if line.strip())
    head, _, row = (line.split() for line in table)
    assert story.startswith("a/Count would move from a to b (cost tasks, 0.")
    assert head == ["neighbour", "answer", "cost", "terms", "fate", "reason"]
    assert row == ["b", "bid", "0", "active", "tasks", "0", "won"]
    assert "only" not in story
    assert "; only b was asked)" in rig.pancakes("task", "migrate", "a/Count", "--to", "b", "--dry-run").stdout

    assert rig.pancakes("task", "migrate", "a/Count").stdout.startswith("a/Count moved from a to b (")
    head, _, row = (line.split() for line in rig.pancakes("task", "migrations").stdout.splitlines() if line.strip())
    assert head[:7] == ["source", "number", "boot", "mission_s", "task_id", "outcome", "winner"]
    assert row[:3] + row[4:7] == ["a", "1", "1", "a/Count", "moved", "b"]


def test_where_nobody_takes_it_every_reason_is_said(rig: Rig):
    rig.install("count", ENTRY_POINTS, SOURCE)
    first = rig.ready("a", '[device.wheels]\ndriver = "null.motors"\n\n[task.Count]\ntype = "count.Drive"\n')
    for name in ("b", "c"):
        rig.ready(name, agent=f'peers = ["{rig.address(first)}"]')
        first.hear(f"peer_up peer={name}")

    for options in ((), ("--dry-run",)):
        code, (ledger,), said = command(rig, "task", "migrate", "a/Count", *options)
        assert code == 1
        assert said == (
            "no neighbour can take Count: b: lacks the device type motors; c: lacks the device type motors\n"
        )
        assert [(line["peer"], line["reason"]) for line in ledger["lines"]] == [
            ("b", "lacks the device type motors"),
            ("c", "lacks the device type motors"),
        ]
    result = rig.pancakes("task", "migrate", "a/Count")
    assert result.returncode == 1
    assert result.stdout.startswith("a/Count stays on a (cost tasks, ")
    assert [line.split()[0] for line in result.stdout.splitlines() if "lacks the device type" in line] == ["b", "c"]
    assert running(rig) == ["a"]
    assert [kept["outcome"] for kept in command(rig, "task", "migrations")[1]] == ["stayed", "stayed"]


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("a/Home",), "a/client/Home is stopped, so it cannot move\n"),
        (("a/Cuont",), "a has no task or service 'Cuont', did you mean 'Count'?\n"),
        (("a/Count", "--then", "Sleep"), "a/client has no task 'Sleep' that could follow Count\n"),
        (("a/client",), "a/client is a service: name one of its tasks\n"),
    ],
)
def test_what_is_refused_at_once(rig: Rig, pair: tuple[Running, Running], arguments: tuple[str, ...], reason: str):
    assert command(rig, "task", "migrate", *arguments) == (1, [], reason)


def test_who_has_no_such_cost_function_says_so(rig: Rig, pair: tuple[Running, Running]):
    code, (ledger,), said = command(rig, "task", "migrate", "a/Count", "--cost", "beauty")
    assert code == 1
    assert "beauty" in said and "beauty" in ledger["lines"][0]["reason"]


def test_an_agent_that_does_not_answer_is_exit_code_3(
    rig: Rig, pair: tuple[Running, Running], freeze: Callable[[Running], None]
):
    assert command(rig, "task", "migrate", "c/Count")[0] == 3
    freeze(pair[0])
    code, ledgers, said = command(rig, "task", "migrate", "a/Count", "--timeout", "0.5")
    assert (code, ledgers) == (3, [])
    assert said.startswith("a cannot be reached: ")
    assert command(rig, "task", "migrations", "--timeout", "1") == (
        0,
        [],
        f"a ({rig.addresses(pair[0])[0]}) did not answer: nothing came within 1 s\n",
    )


def test_a_move_that_takes_longer_than_the_command_waits_may_go_on(rig: Rig):
    rig.install("count", ENTRY_POINTS, SOURCE)
    first = rig.ready("a", '[task.Busy]\ntype = "count.Busy"\n')
    rig.ready("b", agent=f'peers = ["{rig.address(first)}"]')
    first.hear("peer_up peer=b")

    # It is given up once the task has been stuck for 2 s.
    code, _, said = command(rig, "task", "migrate", "a/Busy", "--timeout", "1.5")

    assert code == 3
    assert said.splitlines() == [
        "a did not answer: nothing came within 1.5 s",
        "the move may go on all the same, pancakes task migrations a shows what becomes of it",
    ]


# In doubt --------------------------------------------------------------------------------------------------------


def give_away(rig: Rig, agent: str, peer: str) -> None:
    """Writes into the journal of an agent that stands still what a cut just after COMMITTED leaves there."""
    journal = FileJournal(rig.directory / "state" / "pancakes" / "test" / agent)
    entry = journal.read("record", f"{agent}/Count")
    assert entry is not None
    offer = Epoch(1, agent)
    record = replace(Record.decode(entry.data), phase=Phase.COMMITTED, seen=offer, offer=offer, peer=peer)
    journal.write([JournalEntry("record", entry.key, record.encode())])
    journal.close()


def test_a_task_in_doubt_is_adopted_by_force(rig: Rig):
    rig.install("count", ENTRY_POINTS, SOURCE)
    agent = rig.ready("a", COUNT)
    not_in_doubt = "there is nothing to adopt: a/Count is here already\n"
    assert command(rig, "task", "adopt", "a/Count", "--force") == (1, [], not_in_doubt)
    agent.signalled(signal.SIGTERM)
    give_away(rig, "a", peer="b")
    agent = rig.ready("a", COUNT)

    code, rows, said = command(rig, "task", "adopt", "a/Count")
    assert (code, rows) == (1, [])
    assert said.startswith("a/Count was given to b (offer 1@a), which does not say that it has it. Adopted by force,")
    assert "only after that set b up anew" in said
    assert running(rig) == []

    row = {"agent": "a", "task_id": "a/Count", "instead_of": "b"}
    code, (tried,), _ = command(rig, "task", "adopt", "a/Count", "--force", "--dry-run")
    assert (code, {**tried, "number": 0}) == (0, {**row, "done": "dry run", "number": 0})
    assert running(rig) == []

    code, (adopted,), _ = command(rig, "task", "adopt", "a/Count", "--force")
    assert (code, adopted) == (0, {**row, "done": "adopted", "number": adopted["number"]})
    assert running(rig) == ["a"]
    agent.hear("counted n=")


def test_a_task_is_not_adopted_while_the_other_agent_is_connected(rig: Rig):
    rig.install("count", ENTRY_POINTS, SOURCE)
    rig.ready("a", COUNT).signalled(signal.SIGTERM)
    give_away(rig, "a", peer="b")
    first = rig.ready("a", COUNT)
    # Its disk is empty, so it can say nothing of the offer: the doubt lasts.
    second = rig.ready("b", agent=f'peers = ["{rig.address(first)}"]')
    first.hear("peer_up peer=b")

    code, _, said = command(rig, "task", "adopt", "a/Count", "--force")

    assert code == 1
    assert said.startswith("a/Count is not adopted: b is connected, so it is not gone")
    second.signalled(signal.SIGTERM)
    first.hear("peer_down peer=b")
    assert command(rig, "task", "adopt", "a/Count", "--force")[0] == 0
