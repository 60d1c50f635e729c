"""A failure at the terminal: one line that names the author's code, and the whole traceback on request."""

import json
import signal

import pytest
from cli.processes import Rig

FAILS = """
from dataclasses import dataclass, field

from pancakes.task import Task, every

def paint(colours):
    return colours["x"]

class Blink(Task):
    @dataclass
    class Settings:
        path_m: list[tuple[float, float]] = field(default_factory=lambda: [(0.0, 0.0), (1.5, 1.0)])
        marks: dict[str, list[int]] = field(default_factory=lambda: {"left": [1, 2]})
        names: list[str] = field(default_factory=lambda: ["a", "b"])

    @every(hz=100)
    def blink(self, tick):
        try:
            paint({})
        except KeyError as error:
            raise ValueError("bad colour") from error
"""
ONCE = '[task.Blink]\ntype = "fails.Blink"\nrestart = { policy = "no" }\n'
SAID = "a/client/Blink is given up: ValueError: bad colour (from KeyError: 'x') at plugin_fails.py:21 in blink"
ROW = "          Traceback (most recent call last):"


@pytest.fixture
def fails(rig: Rig) -> None:
    rig.install("fails", "[pancakes.tasks]\nfails.Blink = plugin_fails:Blink\n", FAILS)


def test_agent_traceback_is_shown_on_request(rig: Rig, fails: None):
    agent = rig.agent(rig.config("a", ONCE), "--traceback")
    agent.hear(SAID)
    assert agent.hear("Traceback") == ROW
    agent.hear("KeyError: 'x'")
    agent.hear("          ValueError: bad colour")
    agent.signalled(signal.SIGTERM)

    launcher = rig.launch(rig.config("b", ONCE), "--traceback")
    launcher.hear(SAID.replace("a/", "b/", 1))
    assert launcher.hear("Traceback").endswith(ROW), "a launcher hands that on to its agents"


def test_traceback_can_be_requested_later(rig: Rig, fails: None):
    """At first the terminal shows a failure in one line."""
    agent = rig.agent(rig.config("a", ONCE))
    agent.hear(SAID)
    rig.entry(agent.pid)

    info = rig.pancakes("task", "info", "a/Blink").stdout
    assert "last failure, at " in info and "  Traceback (most recent call last):" in info.splitlines()
    assert "    return colours[" in info and "  ValueError: bad colour" in info.splitlines()
    lines = [line.split(maxsplit=1) for line in info.splitlines()]
    shown = {line[0]: line[1].strip() for line in lines if len(line) == 2}
    lists = {"path_m": "[[0, 0], [1.5, 1]]", "marks": "left [1, 2]", "names": "a, b"}
    assert {name: shown[name] for name in lists} == lists, "a list of points keeps its brackets"
    (described,) = rig.listed("task", "info", "a/Blink")
    assert described["failure"]["text"] in SAID
    assert described["failure"]["traceback"].endswith("ValueError: bad colour")

    assert "Traceback" not in rig.pancakes("log").stdout
    assert ROW in rig.pancakes("log", "--traceback").stdout.splitlines()
    told = [it for it in rig.listed("log") if "bad colour" in str(it)]
    assert [record["kind"] for record in told] == ["line"]
    assert told[0]["traceback"] == described["failure"]["traceback"]
    every = json.loads(rig.pancakes("log", "--level", "debug", "--format", "json").stdout)
    assert {"task_failed", "task_given_up"} <= {record["kind"] for record in every}

    agent.signalled(signal.SIGTERM)
    agent.everything()
    assert len([line for line in agent.said if "bad colour" in line]) == 1
    assert not any("Traceback" in line for line in agent.said)
