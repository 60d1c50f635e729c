"""`pancakes rerun ...` on a recording of an agent that ran as a process."""

import json

import pytest

from pancakes.tools.replay.recorded_run import UNKNOWN_TICKS

TASK = """
from dataclasses import dataclass

from pancakes.devices import Load
from pancakes.task import Task, every, on


class Sum(Task):
    @dataclass
    class Settings:
        gain: float = 1.0

    @dataclass
    class State:
        total: float = 0.0

    @on("system", Load)
    def load(self, packet):
        if packet.source.endswith("/device/load"):
            return
        self.state.total += packet.body.cpu
        self.publish("ctrl", Load(self.settings.gain * self.state.total))

    @every(hz=1)
    def tick(self, tick):
        pass
"""
ENTRY = "[pancakes.tasks]\nsums.Sum = plugin_sums:Sum\n"
CONFIG = '[task.Sum]\ntype = "sums.Sum"\n[task.Sum.settings]\ngain = 2.0\n[record]\npath = "r/{agent}.mcap"\n'


@pytest.fixture
def recorded(rig):
    """Record an agent whose task received 1, 2 and 3, and published 2, 6 and 12."""
    rig.install("sums", ENTRY, TASK)
    agent = rig.ready("a", CONFIG)
    for value in (1, 2, 3):
        assert rig.pancakes("channel", "pub", "a/system", "load", json.dumps({"cpu": value})).returncode == 0
    assert rig.pancakes("record", "stop").returncode == 0
    agent.close()
    return rig


def test_rerun_shows_what_differs_with_exit_code_1(recorded):
    result = recorded.pancakes("rerun", "r", "Sum")
    assert (result.returncode, result.stderr) == (0, "")
    assert "a/Sum (sums.Sum) on a, " in result.stdout
    assert "note:" not in result.stdout
    assert result.stdout.endswith("it agrees with the recording\n")
    other = recorded.pancakes("rerun", "r/a.mcap", "a/Sum", "--set", "gain=3", "--show", "2")
    assert other.returncode == 1
    lines = other.stdout.splitlines()
    assert [line.partition(" s  ")[2] for line in lines[-4:-2]] == [
        "ctrl load: cpu was 2.0, is 3.0",
        "ctrl load: cpu was 6.0, is 9.0",
    ]
    assert lines[-2:] == ["... and 1 more (--show)", "it differs from the recording"]
    assert recorded.pancakes("rerun", "r", "Sum", "--set", "gain=3", "--tolerance", "0.5").returncode == 0

    refused = recorded.pancakes("rerun", "r", "Sums")
    assert (refused.returncode, refused.stdout) == (1, "") and "did you mean 'Sum'?" in refused.stderr
    assert recorded.pancakes("rerun", "none", "Sum").returncode == 1
    assert recorded.pancakes("rerun", "r", "Sum", "--set", "nonsense").returncode == 2
    for options in (("--stay", "2"), ("--agent", "b"), ("--set", "gian=1")):
        assert recorded.pancakes("rerun", "r", "Sum", *options).returncode == 1, options


def test_rerun_notes_that_ticks_are_unknown(rig):
    """The recording has no `task_ticks`."""
    rig.install("sums", ENTRY, TASK)
    agent = rig.ready("a", CONFIG + 'types = ["event", "load", "task_description"]\n')
    assert rig.pancakes("record", "stop").returncode == 0
    agent.close()
    result = rig.pancakes("rerun", "r", "Sum")
    assert result.returncode == 0
    assert [line for line in result.stdout.splitlines() if line.startswith("note:")] == [f"note: {UNKNOWN_TICKS}"]


def test_rerun_finds_a_changed_line_of_code(recorded):
    source = recorded.plugins / "plugin_sums.py"
    source.write_text(source.read_text().replace("+= packet.body.cpu", "+= min(packet.body.cpu, 2.5)"))
    result = recorded.pancakes("rerun", "r", "Sum", "--format", "json")
    assert result.returncode == 1
    (stay,) = json.loads(result.stdout)
    assert (stay["task_id"], stay["agent"], stay["agrees"], stay["whole"]) == ("a/Sum", "a", False, True)
    (difference,) = stay["differences"]
    assert difference["fields"] == [{"field": "cpu", "recorded": 12.0, "now": 11.0}]
    (stream,) = [it for it in stay["streams"] if it["type"] == "load"]
    assert (stream["recorded"], stream["equal"], stream["different"]) == (3, 2, 1)
    assert stay["from_s"] < difference["time_s"] < stay["to_s"]
    source.write_text(source.read_text().replace("self.publish(", "1 / 0\n        self.publish("))
    failing = recorded.pancakes("rerun", "r", "Sum")
    assert failing.returncode == 1
    assert "it fails now: ZeroDivisionError: division by zero at plugin_sums.py:" in failing.stdout

    (recorded.plugins / "sums-1.0.dist-info" / "entry_points.txt").write_text("")
    result = recorded.pancakes("rerun", "r", "Sum")
    assert result.returncode == 1
    assert result.stderr.startswith("a/Sum cannot be rerun: ") and "'sums.Sum'" in result.stderr
