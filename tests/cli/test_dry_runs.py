"""`--dry-run`: the agent says whether it would do it, or why not, and nothing changes."""

import json
from typing import Any

import pytest
from cli.processes import Rig, Running

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

class Drive(Task):
    requires = ("motors",)
"""
ENTRY_POINTS = "[pancakes.tasks]\ncount.Count = plugin_count:Count\ncount.Drive = plugin_count:Drive\n"
TASKS = """
[device.pose]
driver = "null.pose"
rate_hz = 5

[task.Count]
type = "count.Count"

[task.Idle]
type = "count.Count"
start = false

[task.Drive]
type = "count.Drive"
start = false
"""


@pytest.fixture
def agent(rig: Rig) -> Running:
    rig.install("count", ENTRY_POINTS, SOURCE)
    return rig.ready("a", TASKS)


def everything(rig: Rig) -> list[Any]:
    """What would differ if anything had been done."""
    keys = ("service", "task", "state", "incarnation", "rate_hz", "reason")
    tasks = json.loads(rig.pancakes("task", "list", "--long", "--format", "json").stdout)
    services = json.loads(rig.pancakes("service", "list", "--format", "json").stdout)
    return [*([row[key] for key in keys] for row in tasks), *services]


@pytest.mark.parametrize(
    "arguments",
    [
        ("task", "start", "a/Idle", "--set", "step=2"),
        ("task", "stop", "a/Count"),
        ("task", "restart", "a/Count", "--drop-state"),
        ("task", "rate", "a/Count", "3"),
        ("task", "rate", "a/pose", "3"),
        ("task", "stop", "a/pose"),
        ("service", "stop", "a/client"),
        ("service", "stop", "a/network", "--for", "10s"),
        ("service", "restart", "a/device", "--drop-state"),
    ],
)
def test_what_would_be_done_is_not_done(rig: Rig, agent: Running, arguments: tuple[str, ...]):
    before = everything(rig)

    result = rig.pancakes(*arguments, "--dry-run", "--format", "json")

    assert (result.returncode, result.stderr) == (0, "")
    (row,) = json.loads(result.stdout)
    assert row["done"] == "dry run"
    assert row["number"] > 0
    assert everything(rig) == before
    # It is the next real command that the log tells of, and none before.
    assert rig.pancakes("task", "rate", "a/pose", "9").returncode == 0
    agent.hear("rate_changed task=pose")
    assert [line for line in agent.said if "asked what=" in line or "_changed" in line] == agent.said[-1:]


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("task", "start", "a/Count"), "a/client/Count is running already"),
        (("task", "start", "a/Idle", "--set", "stepp=2"), "stepp: unknown key, did you mean 'step'?"),
        (("task", "start", "a/Drive"), "a lacks the device types motors, which Drive requires"),
        (("task", "stop", "a/Idle"), "a/client/Idle is stopped already"),
        (("task", "rate", "a/Idle", "3"), "a/client/Idle is stopped, not running"),
        (("task", "rate", "a/Count", "3", "--timer", "tock"), "has no timer 'tock', only tick"),
        (("task", "stop", "a/Cuont"), "a has no task 'Cuont', did you mean 'Count'?"),
        (("service", "start", "a/client"), "a/client is running already"),
        (("service", "stop", "a/network"), "only for a time"),
        (("service", "stop", "a/cleint"), "a has no service 'cleint', only"),
    ],
)
def test_what_would_be_refused_says_why(rig: Rig, agent: Running, arguments: tuple[str, ...], reason: str):
    dry = rig.pancakes(*arguments, "--dry-run")
    assert (dry.returncode, dry.stdout) == (1, "")
    assert reason in dry.stderr
    assert rig.pancakes(*arguments).stderr == dry.stderr


def test_a_table_says_that_it_was_a_dry_run(rig: Rig, agent: Running):
    result = rig.pancakes("task", "stop", "a/Count", "--dry-run")
    assert "dry run" in result.stdout


@pytest.mark.parametrize(
    "verb",
    [
        *(("task", verb) for verb in ("start", "stop", "restart", "rate", "migrate", "adopt", "fence")),
        *(("service", verb) for verb in ("start", "stop", "restart")),
    ],
)
def test_each_verb_that_changes_something_has_it(rig: Rig, verb: tuple[str, str]):
    assert "--dry-run" in rig.pancakes(*verb, "--help").stdout
