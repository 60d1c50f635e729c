"""`--dry-run`: the agent reports whether it would do it, or why not, and nothing changes."""

from typing import Any

from cli.processes import Rig

SOURCE = """
from dataclasses import dataclass
from pancakes.task import Task, every

class Count(Task):
    @dataclass
    class Settings:
        step: int = 1

    @every(hz=20)
    def tick(self, tick):
        pass
"""
TASKS = """
[device.pose]
driver = "null.pose"
rate_hz = 5

[task.Count]
type = "count.Count"

[task.Idle]
type = "count.Count"
start = false
"""
CHANGES = """
task start a/Idle --set step=2
task stop a/Count
task restart a/Count --drop-state
task rate a/Count 3
task rate a/pose 3
task stop a/pose
service stop a/client
service stop a/network --for 10s
service restart a/device --drop-state
""".strip().splitlines()
REFUSED = (
    "task start a/Count",
    "task rate a/Idle 3",
    "task stop a/Cuont",
    "service start a/client",
    "service stop a/x",
)


def everything(rig: Rig) -> list[Any]:
    """Return everything that a command might have changed."""
    keys = ("service", "task", "state", "incarnation", "rate_hz", "reason")
    tasks = rig.listed("task", "list", "--long")
    return [*([row[key] for key in keys] for row in tasks), *rig.listed("service", "list")]


def test_dry_run_changes_nothing_and_checks_everything(rig: Rig):
    rig.install("count", "[pancakes.tasks]\ncount.Count = plugin_count:Count\n", SOURCE)
    agent = rig.ready("a", TASKS)
    before = everything(rig)

    for change in CHANGES:
        (row,) = rig.listed(*change.split(), "--dry-run")
        assert row["done"] == "dry run" and row["number"] > 0, change
    assert "dry run" in rig.pancakes("task", "stop", "a/Count", "--dry-run").stdout, "a table says so too"
    for change in REFUSED:
        dry = rig.pancakes(*change.split(), "--dry-run")
        assert (dry.returncode, dry.stdout) == (1, ""), change
        assert rig.pancakes(*change.split()).stderr == dry.stderr != "", change

    assert everything(rig) == before
    # It is the next real command that the log tells of, and none before.
    assert rig.pancakes("task", "rate", "a/pose", "9").returncode == 0
    agent.hear("rate_changed task=pose")
    told = [line for line in agent.said if "asked what=" in line or "_changed" in line]
    assert told == agent.said[-1:]
