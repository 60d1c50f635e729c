"""A failure at the terminal: one line with the author's own, and the whole traceback for who asks for it."""

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
ONCE = '[task.Blink]\ntype = "fails.Blink"\nrestart = { policy = "temporary" }\n'
SAID = "a/client/Blink is given up: ValueError: bad colour (from KeyError: 'x') at plugin_fails.py:21 in blink"
ROW = "          Traceback (most recent call last):"


@pytest.fixture
def fails(rig: Rig) -> None:
    rig.install("fails", "[pancakes.tasks]\nfails.Blink = plugin_fails:Blink\n", FAILS)


def test_a_terminal_shows_a_failure_in_one_line(rig: Rig, fails: None):
    agent = rig.agent(rig.config("a", ONCE))
    agent.hear(SAID)
    agent.signalled(signal.SIGTERM)
    agent.everything()
    assert len([line for line in agent.said if "bad colour" in line]) == 1
    assert not any("Traceback" in line for line in agent.said)


def test_with_traceback_it_shows_all_of_it(rig: Rig, fails: None):
    agent = rig.agent(rig.config("a", ONCE), "--traceback")
    agent.hear(SAID)
    assert agent.hear("Traceback") == ROW
    agent.hear("KeyError: 'x'")
    agent.hear("          ValueError: bad colour")


def test_a_launcher_hands_that_on_to_its_agents(rig: Rig, fails: None):
    launcher = rig.launch(rig.config("a", ONCE), "--traceback")
    launcher.hear(SAID)
    assert launcher.hear("Traceback").endswith(ROW)


def test_it_can_be_asked_for_later(rig: Rig, fails: None):
    rig.agent(rig.config("a", ONCE)).hear(SAID)

    info = rig.pancakes("task", "info", "a/Blink").stdout
    assert "last failure, at " in info and "  Traceback (most recent call last):" in info.splitlines()
    assert "    return colours[" in info and "  ValueError: bad colour" in info.splitlines()
    (described,) = json.loads(rig.pancakes("task", "info", "a/Blink", "--format", "json").stdout)
    assert described["failure"]["text"] in SAID
    assert described["failure"]["traceback"].endswith("ValueError: bad colour")

    assert "Traceback" not in rig.pancakes("log").stdout
    assert ROW in rig.pancakes("log", "--traceback").stdout.splitlines()
    told = [it for it in json.loads(rig.pancakes("log", "--format", "json").stdout) if "bad colour" in str(it)]
    assert [record["kind"] for record in told] == ["line"]
    assert told[0]["traceback"] == described["failure"]["traceback"]
    every = json.loads(rig.pancakes("log", "--level", "debug", "--format", "json").stdout)
    assert {"task_failed", "task_given_up"} <= {record["kind"] for record in every}


def test_a_list_of_points_keeps_its_brackets(rig: Rig, fails: None):
    rig.agent(rig.config("a", ONCE)).hear(SAID)
    info = [line.split(maxsplit=1) for line in rig.pancakes("task", "info", "a/Blink").stdout.splitlines()]
    assert [
        text.strip() for name, text in filter(lambda it: len(it) == 2, info) if name in ("path_m", "marks", "names")
    ] == [
        "[[0, 0], [1.5, 1]]",
        "left [1, 2]",
        "a, b",
    ]
    assert rig.pancakes("param", "get", "a/Blink", "path_m").stdout == "[[0.0, 0.0], [1.5, 1.0]]\n"
