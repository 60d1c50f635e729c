"""`pancakes top`: agents and tasks at a glance."""

import json
from collections.abc import Callable
from typing import Any

import pytest
from cli.live_output import LiveOutput, on_a_terminal
from cli.processes import Rig, Running
from rich.console import Console

from pancakes.tools.cli.verbs.top import picture

SOURCE = """
from pancakes.task import Task, every

class Walk(Task):
    @every(hz=50)
    def step(self, tick):
        pass
"""
TASKS = '[task.Walk]\ntype = "walk.Walk"\n[task.Idle]\ntype = "walk.Walk"\nstart = false\n'


@pytest.fixture
def agent(rig: Rig) -> Running:
    rig.install("walk", "[pancakes.tasks]\nwalk.Walk = plugin_walk:Walk\n", SOURCE)
    return rig.ready("a", TASKS)


def row_of(name: str, state: str = "ready", **others: Any) -> dict[str, Any]:
    """A row for an agent."""
    return {
        "agent": name,
        "state": state,
        "processor_share": 0.125,
        "memory_mib": 33.4,
        "lateness_s": 0.00025,
        "links": 2,
        "missed": 0,
        "dropped": 0,
        "battery_level": None,
        "tasks": [],
        **others,
    }


def task_of(name: str, **others: Any) -> dict[str, Any]:
    """A row for a task."""
    known: dict[str, Any] = {"agent": "a", "service": "client", "task": name, "state": "running", "rest": ""}
    known |= {"rate_hz": 10.0, "achieved_hz": 9.5}
    return {**known, "lateness_s": 0.001, "missed": 0, "dropped": 0, "restarts": 0, **others}


def drawn(*agents: dict[str, Any], sort: str = "name", height: int | None = None) -> list[str]:
    """The lines of the two tables."""
    console = Console(width=120, color_system=None)
    with console.capture() as captured:
        console.print(picture(agents, sort, height))
    return [line.rstrip() for line in captured.get().splitlines()]


def test_top_once_shows_achieved_rates(rig: Rig, agent: Running):
    rig.ready("b")
    result = rig.pancakes("top", "--once", "--format", "json", "a")

    assert result.returncode == 0, result.stderr
    (row,) = json.loads(result.stdout)
    assert (row["agent"], row["state"], row["links"], row["battery_level"]) == ("a", "ready", 0, None)
    assert 0.0 <= row["processor_share"] < 4.0
    assert 10.0 < row["memory_mib"] < 500.0
    tasks = {it["task"]: it for it in row["tasks"]}
    assert tasks["Walk"]["rate_hz"] == 50.0
    # On a busy machine ticks are missed, and counted; those that are not come at their rate.
    assert tasks["Walk"]["achieved_hz"] + tasks["Walk"]["missed"] >= 45.0
    assert tasks["Walk"]["achieved_hz"] <= 55.0
    assert 0.0 <= tasks["Walk"]["lateness_s"] < 0.5
    assert (tasks["Idle"]["state"], tasks["Idle"]["achieved_hz"]) == ("stopped", None)

    table = rig.pancakes("top", "--once", "--every", "200ms", "a").stdout
    lines = [line.split() for line in table.splitlines() if line.strip()]
    assert (lines[0][:2], lines[2][:2]) == (["agent", "state"], ["a", "ready"])
    assert ["a/client/Walk", "running", "50"] in [line[:3] for line in lines]
    assert not any(line[0].startswith("b") for line in lines)


def test_top_follows_agents_that_come_and_go(rig: Rig, agent: Running, start: Callable[..., LiveOutput]):
    top = start("top", "--every", "200ms", "--format", "json")
    assert top.record('"agent":"a"')["state"] == "ready"
    other = rig.ready("b")
    top.record('"agent":"b","fleet":"test","role":"agent","state":"ready"')  # it may have been seen as it started
    other.process.kill()
    assert top.record('"agent":"b","fleet":"test","role":"agent","state":"no answer"')["tasks"] == []
    assert top.record('"agent":"a"')["state"] == "ready"
    assert (top.interrupt(), top.said) == (0, [])

    code, shown = on_a_terminal(rig, 12, 90, "top", "--every", "200ms", until=b"more tasks")
    assert code == 0
    assert "a/client/Idle" in shown
    assert shown.rstrip().endswith("\x1b[?1049l"), "the terminal is as it was before"


def test_top_has_short_cells():
    lines = drawn(row_of("a", battery_level=0.5, tasks=[task_of("Walk", lateness_s=None, achieved_hz=9.876)]))

    assert lines[2].split() == ["a", "ready", "12.5", "33", "0.25", "2", "0", "0", "50.0"]
    assert lines[6].split() == ["a/client/Walk", "running", "10", "9.88", "-", "0", "0", "0"]


def test_top_sorts_tasks():
    tasks = [task_of("A", missed=1), task_of("B", missed=5, lateness_s=None), task_of("C", lateness_s=0.5)]

    def order(sort: str) -> list[str]:
        return [line.split()[0][-1] for line in drawn(row_of("a", tasks=tasks), sort=sort)[6:]]

    assert order("name") == ["A", "B", "C"]
    assert order("missed") == ["B", "A", "C"]
    assert order("late") == ["C", "A", "B"]


@pytest.mark.parametrize(("agents", "tasks", "height"), [(2, 30, 20), (30, 2, 20), (30, 30, 12), (1, 1, 5), (3, 3, 24)])
def test_top_fits_the_terminal(agents: int, tasks: int, height: int):
    rows = [row_of(f"agent{n:02}") for n in range(agents)]
    rows[0]["tasks"] = [task_of(f"Task{n:02}") for n in range(tasks)]

    lines = drawn(*rows, height=height)

    assert len(lines) <= max(height, 8)
    shown = (sum(" ready " in line for line in lines), sum(" running " in line for line in lines))
    assert shown[0] >= 1 and shown[1] >= 1
    left_out = [
        f"{total - some} more {what}"
        for total, some, what in ((agents, shown[0], "agents"), (tasks, shown[1], "tasks"))
        if total > some
    ]
    assert lines[-1] == f"and {', '.join(left_out)}" if left_out else "Task" in lines[-1]
