"""`pancakes rerun ...` on a recording of an agent that is a process of its own."""

import json

import pytest

TASK = """
from dataclasses import dataclass

from pancakes.bodies.devices.types import Load
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
"""
ENTRY = "[pancakes.tasks]\nsums.Sum = plugin_sums:Sum\n"
CONFIG = '[task.Sum]\ntype = "sums.Sum"\n[task.Sum.settings]\ngain = 2.0\n[record]\npath = "r/{agent}.mcap"\n'


@pytest.fixture
def recorded(rig):
    """An agent whose task got 1, 2 and 3, and said 2, 6 and 12."""
    rig.install("sums", ENTRY, TASK)
    agent = rig.ready("a", CONFIG)
    for value in (1, 2, 3):
        assert rig.pancakes("channel", "pub", "a/system", "load", json.dumps({"cpu": value})).returncode == 0
    assert rig.pancakes("record", "stop").returncode == 0
    agent.close()
    return rig


def test_it_agrees_and_what_is_changed_is_shown_with_the_values_and_exit_code_1(recorded):
    result = recorded.pancakes("rerun", "r", "Sum")
    assert (result.returncode, result.stderr) == (0, "")
    assert "a/Sum (sums.Sum) on a, " in result.stdout
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


def test_a_changed_line_of_code_is_found(recorded):
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


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("none", "Sum"), "there is no recording none\n"),
        (("r", "Sums"), "the recording has no task 'Sums', did you mean 'Sum'?\n"),
        (("r", "Sum", "--stay", "2"), "a/Sum has only one stay in the recording\n"),
        (("r", "Sum", "--agent", "b"), "a/Sum was never on 'b' in the recording, only on a\n"),
        (("r", "Sum", "--set", "gian=1"), "bad settings for Sum: gian: unknown key, did you mean 'gain'?\n"),
    ],
)
def test_what_cannot_be_is_a_sentence(recorded, arguments, sentence):
    result = recorded.pancakes("rerun", *arguments)
    assert (result.returncode, result.stderr) == (1, sentence)


def test_a_class_that_is_gone_and_a_recording_without_descriptions_are_sentences(recorded):
    (recorded.plugins / "sums-1.0.dist-info" / "entry_points.txt").write_text("")
    result = recorded.pancakes("rerun", "r", "Sum")
    assert result.returncode == 1
    assert result.stderr.startswith("a/Sum cannot be run again: ")
    assert "'sums.Sum'" in result.stderr
    agent = recorded.ready("b", '[record]\npath = "s/b.mcap"\nchannels = ["system"]\n')
    recorded.pancakes("channel", "pub", "b/system", "load", '{"cpu": 1}')
    recorded.pancakes("record", "stop")
    agent.close()
    assert recorded.pancakes("rerun", "s", "Sum").stderr.startswith("the recording does not say what its tasks were")
    assert recorded.pancakes("rerun", "s", "Sum", "--set", "nonsense").returncode == 2
