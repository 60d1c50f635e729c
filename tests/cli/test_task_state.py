"""`pancakes task info --state`: what a task keeps in its state, for people and as JSON."""

from __future__ import annotations

import pytest
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
ENTRY_POINTS = "[pancakes.tasks]\n" + "".join(
    f"survey.{name} = plugin_survey:{name}\n" for name in ("Survey", "Plain", "Opaque", "Busy")
)


@pytest.fixture
def agent(rig: Rig) -> None:
    rig.install("survey", ENTRY_POINTS, SOURCE)
    rig.ready("a", "".join(f'[task.{name}]\ntype = "survey.{name}"\n' for name in ("Survey", "Plain", "Opaque")))


def told(rig: Rig, *arguments: str) -> str:
    """Returns the table of a task, with one space between words."""
    result = rig.pancakes("task", "info", *arguments, "--state")
    assert (result.returncode, result.stderr) == (0, "")
    return "\n".join(" ".join(line.split()) for line in result.stdout.splitlines())


@pytest.mark.usefixtures("agent")
def test_the_state_of_a_task_is_told_short_for_people_and_whole_as_json(rig: Rig):
    table = told(rig, "a/Survey")

    assert "keeps in its state, at " in table and "(what is cut is whole with --format json)" in table
    lines = table.splitlines()
    assert "visited 7" in lines
    assert "step.name north" in lines and "step.metres 1.23457" in lines
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


@pytest.mark.usefixtures("agent")
def test_a_task_without_a_state_to_tell_is_a_sentence(rig: Rig):
    assert "nothing: it has no state" in told(rig, "a/Plain")

    assert "the state of a/client/Opaque cannot be written down: it contains a value of the class object" in told(
        rig, "a/Opaque"
    )

    assert rig.pancakes("task", "stop", "a/Survey").returncode == 0
    assert "a/client/Survey is stopped, not running" in told(rig, "a/Survey")
    (found,) = rig.listed("task", "info", "a/Survey", "--state")
    assert (found["state"], found["kept_state"], found["kept_state_s"]) == ("stopped", None, None)
    assert found["kept_state_reason"] == "a/client/Survey is stopped, not running"


def test_of_a_task_that_is_busy_all_else_is_told(rig: Rig):
    rig.install("survey", ENTRY_POINTS, SOURCE)
    agent = rig.ready("a", '[task.Busy]\ntype = "survey.Busy"\n')
    agent.hear("busy now")

    table = told(rig, "a/Busy")

    assert "a/client/Busy has not told its state within 3 s: it may be busy" in table
    assert "type survey.Busy" in table
