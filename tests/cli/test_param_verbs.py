"""`pancakes param ...`: settings of tasks that run, looked at, explained, changed, kept and brought back."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from cli.processes import PATIENCE_S, Rig, Running

SOURCE = '''
from dataclasses import dataclass, field
from typing import Annotated, Literal
from msgspec import Meta
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
'''
ENTRY_POINTS = "[pancakes.tasks]\ncount.Count = plugin_count:Count\ncount.Plain = plugin_count:Plain\n"
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


@pytest.fixture
def agent(rig: Rig) -> Running:
    rig.install("count", ENTRY_POINTS, SOURCE)
    return rig.ready("a", TASKS)


def done(rig: Rig, *arguments: str) -> list[dict[str, Any]]:
    """Runs a command that prints JSON and succeeds."""
    result = rig.pancakes("param", *arguments, "--format", "json")
    assert result.returncode == 0, result.stderr
    rows: list[dict[str, Any]] = json.loads(result.stdout)
    return rows


def refused(rig: Rig, *arguments: str) -> str:
    result = rig.pancakes("param", *arguments)
    assert (result.returncode, result.stdout) == (1, "")
    return result.stderr.rstrip("\n")


def settings(rig: Rig, task: str = "a/Count") -> dict[str, Any]:
    return {row["param"]: row["value"] for row in done(rig, "get", task)}


BEFORE = {"step": 2, "radius_m": 0.5, "mood": "good", "limits": {"low": 1.0}, "label": None}


def test_settings_are_listed_of_all_of_an_agent_or_of_a_task(rig: Rig, agent: Running):
    rows = done(rig, "list")

    assert {"agent": "a", "service": "device", "task": "here", "param": "x_m", "value": 1.0} in rows
    assert {"here", "Count", "Idle"} <= {row["task"] for row in rows}
    assert done(rig, "list", "a") == rows
    assert done(rig, "list", "a/client/Idle") == [row for row in rows if row["task"] == "Idle"]
    assert settings(rig) == BEFORE


def test_one_value_is_printed_as_toml(rig: Rig, agent: Running):
    assert rig.pancakes("param", "get", "a/Count", "mood").stdout == '"good"\n'
    assert rig.pancakes("param", "get", "a/Count", "limits").stdout == "{low = 1.0}\n"
    assert refused(rig, "get", "a/Count", "sttep") == "a/Count has no setting 'sttep', did you mean 'step'?"


def test_settings_are_changed_while_the_task_runs(rig: Rig, agent: Running):
    rows = done(rig, "set", "a/Count", "step=7", "mood=bad", "label=5 o'clock")

    agent.hear("counting step=7")
    assert [(row["param"], row["before"], row["value"], row["done"]) for row in rows] == [
        ("step", 2, 7, "set"),
        ("mood", "good", "bad", "set"),
        ("label", None, "5 o'clock", "set"),
    ]
    assert rows[0]["number"] > 0
    assert settings(rig) == {**BEFORE, "step": 7, "mood": "bad", "label": "5 o'clock"}


def test_a_value_inside_of_a_table_is_changed_alone(rig: Rig, agent: Running):
    done(rig, "set", "a/Count", "limits.high=9", 'limits."very high"=10')

    assert settings(rig)["limits"] == {"low": 1.0, "high": 9.0, "very high": 10.0}
    assert refused(rig, "set", "a/Count", "step.size=9") == "step is a value and has no keys in it"


def test_a_refused_value_says_why_and_nothing_changes(rig: Rig, agent: Running):
    said = refused(rig, "set", "a/Count", "radius_m=0.9", "step=0", "mod=bad")

    assert "step: expected an integer >= 1, not 0" in said
    assert "mod: unknown key, did you mean 'mood'?" in said
    assert settings(rig) == BEFORE


def test_a_dry_run_says_whether_it_would_be_good(rig: Rig, agent: Running):
    assert [row["done"] for row in done(rig, "set", "a/Count", "step=7", "--dry-run")] == ["dry run"]
    assert "step" in refused(rig, "set", "a/Count", "step=0", "--dry-run")
    assert settings(rig) == BEFORE


def test_a_task_that_stands_still_has_settings_that_cannot_be_changed_now(rig: Rig, agent: Running):
    assert settings(rig, "a/Idle")["step"] == 1
    assert refused(rig, "set", "a/Idle", "step=7") == "a/client/Idle is stopped, not running"


def test_what_may_be_set_is_explained(rig: Rig, agent: Running):
    rows = {row["param"]: row for row in done(rig, "describe", "a/Count")}

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
    assert [row["param"] for row in done(rig, "describe", "a/Count", "step")] == ["step"]
    assert done(rig, "describe", "a/Plain") == []


def test_a_dump_is_loaded_again(rig: Rig, agent: Running):
    done(rig, "set", "a/Count", "step=7", "limits.high=9")
    dump = rig.pancakes("param", "dump", "a").stdout
    (rig.directory / "kept.toml").write_text(dump)
    done(rig, "set", "a/Count", "step=1", "limits={}")

    rows = done(rig, "load", "a/Count", "kept.toml")

    assert [(row["task"], row["done"]) for row in rows] == [("Count", "set")]
    assert settings(rig)["step"] == 7
    assert settings(rig)["limits"] == {"low": 1.0, "high": 9.0}


def test_a_dump_fits_into_a_configuration(rig: Rig, agent: Running):
    dump = rig.pancakes("param", "dump", "a").stdout

    assert tomllib.loads(dump) == {
        "device": {"here": {"settings": {"x_m": 1.0, "y_m": 2.0, "theta_rad": 0.0}}},
        "task": {
            "Count": {"settings": {"step": 2, "radius_m": 0.5, "mood": "good", "limits": {"low": 1.0}}},
            "Idle": {"settings": {"step": 1, "radius_m": 0.5, "mood": "good", "limits": {"low": 1.0}}},
        },
    }
    assert list(tomllib.loads(rig.pancakes("param", "dump", "a/Count").stdout)["task"]) == ["Count"]
    assert [row["task"] for row in done(rig, "dump", "a")] == ["here", "Count", "Idle"]  # and no service's own tasks
    assert [row["task"] for row in done(rig, "dump", "a/Console")] == ["Console"]


def test_a_load_does_what_is_good_and_names_who_refuses(rig: Rig, agent: Running):
    (rig.directory / "new.toml").write_text(
        "[agent]\nname = 'ignored'\n[task.Count.settings]\nstep = 3\nmood = 'odd'\n[device.here.settings]\nx_m = 4.0\n"
    )

    tried = rig.pancakes("param", "load", "a", "new.toml", "--dry-run", "--format", "json")
    assert tried.returncode == 1
    assert settings(rig, "a/here")["x_m"] == 1.0
    result = rig.pancakes("param", "load", "a", "new.toml", "--format", "json")

    assert result.returncode == 1
    assert "a/Count: bad settings for Count: mood: expected one of 'good', 'bad', not 'odd'" in result.stderr
    assert {row["task"]: row["done"] for row in json.loads(result.stdout)} == {"Count": "refused", "here": "set"}
    assert settings(rig)["step"] == 2
    assert settings(rig, "a/here")["x_m"] == 4.0


def test_settings_come_from_standard_input_too(rig: Rig, agent: Running):
    result = subprocess.run(
        [sys.executable, "-m", "pancakes.tools.cli.main", "param", "load", "a/Count", "-"],
        input="[task.Count.settings]\nstep = 9\n",
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        env=rig.environment,
        cwd=rig.directory,
    )

    assert result.returncode == 0
    assert settings(rig)["step"] == 9


@pytest.mark.parametrize(
    ("text", "code", "expected"),
    [
        ("x = \n", 4, "bad.toml:1: TOML: "),
        ("[task.Count]\nstep = 1\n", 1, "bad.toml has no settings in it"),
        ("[task.Other.settings]\nstep = 1\n", 1, "bad.toml has no settings of 'Count', only of Other"),
    ],
)
def test_a_file_that_is_none(rig: Rig, agent: Running, text: str, code: int, expected: str):
    (rig.directory / "bad.toml").write_text(text)

    result = rig.pancakes("param", "load", "a/Count", "bad.toml")

    assert result.returncode == code
    assert expected in result.stderr


@pytest.mark.parametrize(
    "arguments",
    [("set", "a/Count"), ("set", "a/Count", "step"), ("set", "a", "step=1"), ("get", "a"), ("list", "a/b/c/d/e")],
)
def test_what_cannot_be_read_is_exit_code_2(rig: Rig, arguments: tuple[str, ...]):
    result = rig.pancakes("param", *arguments)

    assert result.returncode == 2
    assert "Usage: " in result.stderr


def test_who_is_not_there_is_told(rig: Rig, agent: Running):
    assert refused(rig, "get", "a/Cuont") == "a has no task 'Cuont', did you mean 'Count'?"
    assert rig.pancakes("param", "list", "b").returncode == 3


@pytest.mark.parametrize("verb", ["list", "get", "set", "describe", "dump", "load"])
def test_each_verb_has_help_with_an_example(rig: Rig, verb: str):
    assert f"pancakes param {verb}" in rig.pancakes("param", verb, "--help").stdout.partition("Example:")[2]


def test_names_of_settings_are_completed(rig: Rig, agent: Running):
    rig.environment.update(
        _PANCAKES_COMPLETE="bash_complete", COMP_WORDS="pancakes param set a/Count st", COMP_CWORD="4"
    )
    source = "from pancakes.tools.cli.main import pancakes; pancakes(prog_name='pancakes')"
    asked = rig.run("-c", source, whole=True)

    assert "plain,step=" in asked.everything()


ARRAYS = """
from dataclasses import dataclass, field
import numpy as np
from numpy.typing import NDArray
from pancakes.task import Task

class Steers(Task):
    @dataclass
    class Settings:
        gains: np.ndarray = field(default_factory=lambda: np.array([[1.0, 2.0]]))
        offsets: NDArray[np.int16] = field(default_factory=lambda: np.zeros(2, np.int16))
"""


def test_arrays_are_shown_changed_kept_and_brought_back_as_lists(rig: Rig, tmp_path: Path):
    rig.install("steers", "[pancakes.tasks]\nsteers.Steers = plugin_steers:Steers\n", ARRAYS)
    rig.ready("a", '[task.Steers]\ntype = "steers.Steers"\nsettings = { offsets = [3, 4] }\n')

    assert settings(rig, "a/Steers") == {"gains": [[1.0, 2.0]], "offsets": [3, 4]}
    assert rig.pancakes("param", "get", "a/Steers", "gains").stdout == "[[1.0, 2.0]]\n"
    done(rig, "set", "a/Steers", "gains=[[5], [6]]")
    assert settings(rig, "a/Steers")["gains"] == [[5.0], [6.0]]
    assert "offsets: expected whole numbers" in refused(rig, "set", "a/Steers", "offsets=[0.5, 1]")

    told = rig.pancakes("task", "info", "a/Steers").stdout
    assert "[[5.0], [6.0]] (float64, 2 x 1)" in told
    assert "[3, 4] (int16, 2)" in told
    (told,) = json.loads(rig.pancakes("task", "info", "a/Steers", "--format", "json").stdout)
    assert told["settings"] == {"gains": [[5.0], [6.0]], "offsets": [3, 4]}

    kept = tmp_path / "steers.toml"
    kept.write_text(rig.pancakes("param", "dump", "a/Steers").stdout)
    done(rig, "set", "a/Steers", "gains=[[1]]")
    done(rig, "load", "a/Steers", str(kept))
    assert settings(rig, "a/Steers")["gains"] == [[5.0], [6.0]]
    rows = {row["param"]: row["type"] for row in done(rig, "describe", "a/Steers")}
    assert rows == {"gains": "list", "offsets": "list"}
