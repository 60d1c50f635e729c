"""`pancakes task info --state`: the state of a task, for people and as JSON."""

from __future__ import annotations

from cli.processes import Rig

SOURCE = """
import time
from dataclasses import dataclass, field

import msgspec
import numpy as np

from pancakes.task import Task, every

class Step(msgspec.Struct):
    name: str = "north"
    metres: float = 1.23456789

class Survey(Task):
    @dataclass
    class State:
        visited: int = 7
        step: Step = field(default_factory=Step)
        grid: np.ndarray = field(default_factory=lambda: np.zeros((40, 25)))
        note: str = "x" * 500
        odd: str = "\\x1b[31mred"

class Plain(Task):
    @every(hz=2)
    def tick(self, tick):
        pass

class Opaque(Task):
    @dataclass
    class State:
        handle: int = 0

    def on_start(self):
        self.state.handle = object()

class Busy(Task):
    @dataclass
    class State:
        count: int = 0

    @every(hz=5)
    def tick(self, tick):
        self.log("info", "busy now")
        time.sleep(600)
"""
NAMES = ("Survey", "Plain", "Opaque", "Busy")
ENTRY_POINTS = "[pancakes.tasks]\n" + "".join(f"survey.{name} = plugin_survey:{name}\n" for name in NAMES)
TASKS = "".join(f'[task.{name}]\ntype = "survey.{name}"\n' for name in NAMES)


def told(rig: Rig, *arguments: str) -> str:
    """Return the table of a task, with one space between words."""
    result = rig.pancakes("task", "info", *arguments, "--state")
    assert (result.returncode, result.stderr) == (0, "")
    return "\n".join(" ".join(line.split()) for line in result.stdout.splitlines())


def test_task_info_shows_the_state_of_a_task(rig: Rig):
    """The state is truncated for people and complete in JSON; a missing state has a reason."""
    rig.install("survey", ENTRY_POINTS, SOURCE)
    rig.ready("a", TASKS).hear("busy now")
    table = told(rig, "a/Survey")
    assert "task state, at " in table and "(truncated; --format json has all of it)" in table
    lines = table.splitlines()
    assert {"visited 7", "step.name north", "step.metres 1.23457"} <= set(lines)
    (grid,) = (line for line in lines if line.startswith("grid [[0, 0, 0"))
    assert grid.endswith("… (float64, 40 x 25)") and len(grid) < 250
    (note,) = (line for line in lines if line.startswith("note xxx"))
    assert note.endswith("… (500 characters)") and len(note) < 250
    assert r"odd \x1b[31mred" in lines, "what would change the terminal is escaped"

    (found,) = rig.listed("task", "info", "a/Survey", "--state")
    assert found["state"] == "running"
    assert found["kept_state"]["step"] == {"name": "north", "metres": 1.23456789}
    assert found["kept_state"]["grid"] == [[0.0] * 25] * 40
    assert found["kept_state"]["note"] == "x" * 500
    assert found["kept_state_s"] > 0.0 and found["kept_state_reason"] == ""
    assert "kept_state" not in rig.listed("task", "info", "a/Survey")[0]

    assert "empty: this task keeps no state" in told(rig, "a/Plain")
    assert "cannot be written down" in told(rig, "a/Opaque")
    busy = told(rig, "a/Busy")
    assert "a/client/Busy did not report its state within 3 s: it may be busy" in busy
    assert "type survey.Busy" in busy, "all else is told"

    assert rig.pancakes("task", "stop", "a/Survey").returncode == 0
    (found,) = rig.listed("task", "info", "a/Survey", "--state")
    assert (found["state"], found["kept_state"], found["kept_state_s"]) == ("stopped", None, None)
    assert found["kept_state_reason"] in told(rig, "a/Survey") and found["kept_state_reason"]
