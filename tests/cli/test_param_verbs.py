"""`pancakes param ...`: show, describe, change, dump and load the settings of running tasks."""

import json
import tomllib
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
from cli.processes import Rig, Running

SOURCE = '''
from dataclasses import dataclass, field
from typing import Annotated, Literal
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from pancakes.task import Task, every

class Count(Task):
    @dataclass
    class Settings:
        """How it counts.

        Attributes:
            step: how much is added each time.
            radius_m: how far it sees.
        """

        step: Annotated[int, Meta(ge=1, le=100)] = 1
        radius_m: float = 0.5
        mood: Literal["good", "bad"] = "good"
        limits: dict[str, float] = field(default_factory=lambda: {"low": 1.0})
        label: str | None = None

    def on_settings(self):
        self.event("counting", step=self.settings.step)

    @every(hz=20)
    def tick(self, tick):
        pass

class Plain(Task):
    pass

class Steers(Task):
    @dataclass
    class Settings:
        gains: np.ndarray = field(default_factory=lambda: np.array([[1.0, 2.0]]))
        offsets: NDArray[np.int16] = field(default_factory=lambda: np.zeros(2, np.int16))
'''
ENTRY_POINTS = "[pancakes.tasks]\n" + "".join(
    f"count.{name} = plugin_count:{name}\n" for name in ("Count", "Plain", "Steers")
)
TASKS = """
[device.here]
driver = "static.pose"
rate_hz = 1
settings = { x_m = 1.0, y_m = 2.0 }

[task.Count]
type = "count.Count"
settings = { step = 2 }

[task.Idle]
type = "count.Count"
start = false

[task.Plain]
type = "count.Plain"
"""
BEFORE = {"step": 2, "radius_m": 0.5, "mood": "good", "limits": {"low": 1.0}, "label": None}


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """An agent that no test changes."""
    with closing(Rig(tmp_path_factory.mktemp("shared"))) as rig:
        rig.install("count", ENTRY_POINTS, SOURCE)
        rig.ready("a", TASKS)
        yield rig


@pytest.fixture
def agent(rig: Rig) -> Running:
    """An agent for one test."""
    rig.install("count", ENTRY_POINTS, SOURCE)
    return rig.ready("a", TASKS)


def done(rig: Rig, *arguments: str) -> list[dict[str, Any]]:
    return rig.listed("param", *arguments)


def refused(rig: Rig, *arguments: str) -> str:
    result = rig.pancakes("param", *arguments)
    assert (result.returncode, result.stdout) == (1, "")
    return result.stderr.rstrip("\n")


def settings(rig: Rig, task: str = "a/Count") -> dict[str, Any]:
    return {row["param"]: row["value"] for row in done(rig, "get", task)}


def test_param_list_and_get_show_settings(shared: Rig):
    rows = done(shared, "list")
    assert {"agent": "a", "service": "device", "task": "here", "param": "x_m", "value": 1.0} in rows
    assert {"here", "Count", "Idle"} <= {row["task"] for row in rows}
    assert done(shared, "list", "a/client/Idle") == [row for row in rows if row["task"] == "Idle"]
    assert settings(shared) == BEFORE

    assert shared.pancakes("param", "get", "a/Count", "mood").stdout == '"good"\n'
    assert shared.pancakes("param", "get", "a/Count", "limits").stdout == "{low = 1.0}\n"
    assert refused(shared, "get", "a/Count", "sttep") == "a/Count has no setting 'sttep', did you mean 'step'?"


def test_param_describe_explains_settings(shared: Rig):
    rows = {row["param"]: row for row in done(shared, "describe", "a/Count")}
    assert rows["step"] == {
        "agent": "a",
        "service": "client",
        "task": "Count",
        "param": "step",
        "value": 2,
        "type": "integer",
        "default": 1,
        "bounds": ">= 1, <= 100",
        "unit": "",
        "description": "how much is added each time.",
        "required": False,
    }
    assert (rows["radius_m"]["unit"], rows["radius_m"]["type"]) == ("m", "number")
    assert sorted(rows["mood"]["type"].split(" or ")) == ['"bad"', '"good"']
    assert (rows["label"]["type"], rows["label"]["default"]) == ("text", None)
    assert [row["param"] for row in done(shared, "describe", "a/Count", "step")] == ["step"]
    assert done(shared, "describe", "a/Plain") == []


def test_param_set_refused_changes_nothing(shared: Rig):
    said = refused(shared, "set", "a/Count", "radius_m=0.9", "step=0", "mod=bad")
    assert "step: " in said and "mod: " in said, "all faults at once"
    assert "is not a table" in refused(shared, "set", "a/Count", "step.size=9")
    refused(shared, "set", "a/Count", "step=0", "--dry-run")
    assert [row["done"] for row in done(shared, "set", "a/Count", "step=7", "--dry-run")] == ["dry run"]
    assert settings(shared) == BEFORE

    assert settings(shared, "a/Idle")["step"] == 1
    refused(shared, "set", "a/Idle", "step=7")


def test_param_load_refuses_a_malformed_file(shared: Rig):
    found = {}
    for text in ("x = \n", "[task.Count]\nstep = 1\n", "[task.Other.settings]\nstep = 1\n"):
        (shared.directory / "bad.toml").write_text(text)
        result = shared.pancakes("param", "load", "a/Count", "bad.toml")
        found[text] = (result.returncode, result.stderr.rstrip("\n"))
    (syntax, *others) = found.values()
    assert syntax[0] == 4 and syntax[1].startswith("bad.toml:1: x: ")
    assert [code for code, _ in others] == [1, 1]
    assert others[0][1].startswith("bad.toml has no settings: ")
    assert others[1][1] == "bad.toml has no settings of 'Count'. It has those of Other"


def test_param_completion_completes_names_of_settings(shared: Rig):
    words = "pancakes param set a/Count st"
    asked = shared.pancakes(_PANCAKES_COMPLETE="bash_complete", COMP_WORDS=words, COMP_CWORD="4")
    assert "plain,step=" in asked.stdout


def test_param_set_changes_a_task_while_it_runs(rig: Rig, agent: Running):
    rows = done(rig, "set", "a/Count", "step=7", "mood=bad", "label=5 o'clock")
    agent.hear("counting step=7")
    assert [(row["param"], row["before"], row["value"], row["done"]) for row in rows] == [
        ("step", 2, 7, "set"),
        ("mood", "good", "bad", "set"),
        ("label", None, "5 o'clock", "set"),
    ]
    assert rows[0]["number"] > 0
    assert settings(rig) == {**BEFORE, "step": 7, "mood": "bad", "label": "5 o'clock"}

    done(rig, "set", "a/Count", "limits.high=9", 'limits."very high"=10')
    assert settings(rig)["limits"] == {"low": 1.0, "high": 9.0, "very high": 10.0}


def test_param_dump_fits_a_configuration_and_is_loaded_again(rig: Rig, agent: Running):
    dump = rig.pancakes("param", "dump", "a").stdout
    plain = {"step": 1, "radius_m": 0.5, "mood": "good", "limits": {"low": 1.0}}
    assert tomllib.loads(dump) == {
        "device": {"here": {"settings": {"x_m": 1.0, "y_m": 2.0, "theta_rad": 0.0}}},
        "task": {"Count": {"settings": {**plain, "step": 2}}, "Idle": {"settings": plain}},
    }
    assert list(tomllib.loads(rig.pancakes("param", "dump", "a/Count").stdout)["task"]) == ["Count"]
    assert [row["task"] for row in done(rig, "dump", "a")] == ["here", "Count", "Idle"], "and no service's own tasks"
    assert [row["task"] for row in done(rig, "dump", "a/Console")] == ["Console"]

    (rig.directory / "kept.toml").write_text(dump)
    done(rig, "set", "a/Count", "step=1", "limits={}")
    rows = done(rig, "load", "a/Count", "kept.toml")
    assert [(row["task"], row["done"]) for row in rows] == [("Count", "set")]
    assert (settings(rig)["step"], settings(rig)["limits"]) == (2, {"low": 1.0})
    given = rig.pancakes("param", "load", "a/Count", "-", given="[task.Count.settings]\nstep = 9\n")
    assert (given.returncode, settings(rig)["step"]) == (0, 9)


def test_param_load_reports_tasks_that_refuse(rig: Rig, agent: Running):
    (rig.directory / "new.toml").write_text(
        "[agent]\nname = 'ignored'\n[task.Count.settings]\nstep = 3\nmood = 'odd'\n[device.here.settings]\nx_m = 4.0\n"
    )
    load = ("param", "load", "a", "new.toml")
    assert rig.pancakes(*load, "--dry-run").returncode == 1
    assert settings(rig, "a/here")["x_m"] == 1.0

    result = rig.pancakes(*load, "--format", "json")
    assert result.returncode == 1 and "a/Count: bad settings for Count: mood: " in result.stderr
    assert {row["task"]: row["done"] for row in json.loads(result.stdout)} == {"Count": "refused", "here": "set"}
    assert (settings(rig)["step"], settings(rig, "a/here")["x_m"]) == (2, 4.0)


def test_param_arrays_are_lists(rig: Rig):
    rig.install("count", ENTRY_POINTS, SOURCE)
    rig.ready("a", '[task.Steers]\ntype = "count.Steers"\nsettings = { offsets = [3, 4] }\n')
    assert rig.pancakes("param", "get", "a/Steers", "gains").stdout == "[[1.0, 2.0]]\n"
    done(rig, "set", "a/Steers", "gains=[[5], [6]]")
    refused(rig, "set", "a/Steers", "offsets=[0.5, 1]")
    changed = {"gains": [[5.0], [6.0]], "offsets": [3, 4]}
    assert settings(rig, "a/Steers") == changed

    table = rig.pancakes("task", "info", "a/Steers").stdout
    assert "[[5.0], [6.0]] (float64, 2 x 1)" in table and "[3, 4] (int16, 2)" in table
    assert rig.listed("task", "info", "a/Steers")[0]["settings"] == changed

    (rig.directory / "kept.toml").write_text(rig.pancakes("param", "dump", "a/Steers").stdout)
    done(rig, "set", "a/Steers", "gains=[[1]]")
    done(rig, "load", "a/Steers", "kept.toml")
    assert settings(rig, "a/Steers") == changed
    rows = {row["param"]: row["type"] for row in done(rig, "describe", "a/Steers")}
    assert rows == {"gains": "list", "offsets": "list"}
