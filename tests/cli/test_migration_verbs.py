"""`pancakes task migrate|migrations`, on running agents."""

import json
import signal
from collections.abc import Callable
from typing import Any

import pytest
from cli.processes import Rig, Running

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

class Busy(Task):
    blocking = True

    @every(hz=20)
    def tick(self, tick):
        time.sleep(60.0)
"""
ENTRY_POINTS = """
[pancakes.tasks]
count.Count = plugin_count:Count
count.Busy = plugin_count:Busy
"""
COUNT = '[task.Count]\ntype = "count.Count"\n\n[task.Home]\ntype = "count.Count"\nstart = false\n'
BUSY = '[task.Busy]\ntype = "count.Busy"\nstart = false\n'


def command(rig: Rig, *arguments: str) -> tuple[int, list[dict[str, Any]], str]:
    """Run a command; return its exit code, its JSON output, and its standard error."""
    result = rig.pancakes(*arguments, "--format", "json")
    return result.returncode, json.loads(result.stdout) if result.stdout else [], result.stderr


def running(rig: Rig, task: str = "Count") -> list[str]:
    """Return the agents on which a task runs."""
    rows = command(rig, "task", "list")[1]
    return [row["agent"] for row in rows if row["task"] == task and row["state"] == "running"]


@pytest.fixture
def pair(rig: Rig) -> tuple[Running, Running]:
    """Two connected agents; the first runs `Count`."""
    rig.install("count", ENTRY_POINTS, SOURCE)
    first = rig.ready("a", COUNT + BUSY)
    second = rig.ready("b", agent=f'peers = ["{rig.address(first)}"]')
    first.hear("peer_up peer=b")
    first.hear("counted n=")
    return first, second


def test_task_migrate_returns_once_the_task_runs_there(rig: Rig, pair: tuple[Running, Running]):
    code, (ledger,), said = command(rig, "task", "migrate", "a/Count", "--then", "Home", "--to", "b")
    assert (code, said) == (0, "")
    assert (running(rig), running(rig, "Home")) == (["b"], ["a"])
    found = (ledger["task_id"], ledger["outcome"], ledger["winner"], ledger["cost"])
    assert found == ("a/Count", "moved", "b", "tasks")
    assert ledger["asked_by"].startswith("alice.")
    (line,) = ledger["lines"]
    assert (line["peer"], line["answer"], line["fate"], line["terms"]) == ("b", "bid", "won", {"active tasks": 0.0})
    pair[1].hear("counted n=")

    # What it was is to be seen later too, also on an agent that was started again.
    (kept,) = command(rig, "task", "migrations", "a")[1]
    assert (kept["number"], kept["boot"], kept["reason"]) == (1, 1, "")
    assert {key: kept[key] for key in ledger} == ledger
    assert command(rig, "task", "migrations", "b")[1] == []
    head, _, row = (line.split() for line in rig.pancakes("task", "migrations").stdout.splitlines() if line.strip())
    assert head[:7] == ["source", "number", "boot", "mission_s", "task_id", "outcome", "winner"]
    assert row[:3] + row[4:7] == ["a", "1", "1", "a/Count", "moved", "b"]
    pair[0].signalled(signal.SIGKILL)
    rig.ready("a", COUNT)
    assert command(rig, "task", "migrations") == (0, [kept], "")


def test_task_migrate_dry_run_shows_the_bids(rig: Rig, pair: tuple[Running, Running]):
    """A migration that is refused, at once or by the only neighbour, does not stop the task either."""
    code, (ledger,), _ = command(rig, "task", "migrate", "a/client/Count", "--dry-run")
    assert (code, ledger["outcome"], ledger["winner"]) == (0, "dry run", "b")

    result = rig.pancakes("task", "migrate", "a/Count", "--dry-run")
    story, *table = (line.strip() for line in result.stdout.splitlines() if line.strip())
    head, _, row = (line.split() for line in table)
    assert story.startswith("a/Count would migrate from a to b (cost tasks, 0.") and "only" not in story
    assert head == ["neighbour", "answer", "cost", "terms", "fate", "reason"]
    assert row == ["b", "bid", "0", "active", "tasks", "0", "won"]
    assert "; only b was asked)" in rig.pancakes("task", "migrate", "a/Count", "--to", "b", "--dry-run").stdout

    code, rows, said = command(rig, "task", "migrate", "a/Home")
    assert (code, rows) == (1, []) and "a/client/Home" in said
    assert command(rig, "task", "migrations")[1] == []
    code, (ledger,), said = command(rig, "task", "migrate", "a/Count", "--cost", "beauty")
    assert code == 1 and "beauty" in said and "beauty" in ledger["lines"][0]["reason"]
    shown = rig.pancakes("task", "migrate", "a/Count", "--cost", "beauty")
    assert shown.returncode == 1 and shown.stdout.startswith("a/Count stays on a (cost beauty")
    assert [kept["outcome"] for kept in command(rig, "task", "migrations")[1]] == ["stayed", "stayed"]
    assert running(rig) == ["a"]


def test_unanswered_task_migrate_exits_with_3(
    rig: Rig, pair: tuple[Running, Running], freeze: Callable[[Running], None]
):
    assert command(rig, "task", "migrate", "c/Count")[0] == 3
    # A move is given up once the task has been stuck for 2 s; the command waits for less.
    assert rig.pancakes("task", "start", "a/Busy").returncode == 0
    code, _, said = command(rig, "task", "migrate", "a/Busy", "--timeout", "1.5")
    assert code == 3
    assert said.splitlines() == [
        "a did not answer: nothing came within 1.5 s",
        "the migration may still continue: pancakes task migrations a shows its outcome",
    ]
    freeze(pair[0])
    code, ledgers, said = command(rig, "task", "migrate", "a/Count", "--timeout", "0.5")
    assert (code, ledgers) == (3, []) and said.startswith("a cannot be reached: ")
