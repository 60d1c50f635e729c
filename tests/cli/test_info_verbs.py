"""`pancakes agent info`, `task list|info` and `service list|info`: all that agents say of themselves."""

import json
import os
from collections.abc import Callable

import pytest
from cli.processes import Rig, Running

from pancakes.runtime.life.life import WORDS
from pancakes.tools.cli.verbs import service as service_verbs
from pancakes.tools.cli.verbs import task as task_verbs

SOURCE = """
from dataclasses import dataclass
from pancakes.bodies.devices.types import Pose
from pancakes.runtime.kernel.keep import queue
from pancakes.task import Task, every, on

class Steer(Task):
    requires = ("pose",)

    @dataclass
    class Settings:
        radius_m: float = 0.5

    @every(hz=20)
    def tick(self, tick):
        pass

    @every(hz=2)
    def look(self, tick):
        pass

    @on("system", Pose, keep=queue(8))
    def see(self, packet):
        pass

class Broken(Task):
    def on_start(self):
        raise RuntimeError("no wheels")
"""
ENTRY_POINTS = "[pancakes.tasks]\nsteer.Steer = plugin_steer:Steer\nsteer.Broken = plugin_steer:Broken\n"
CONFIG = """
[channel.map]

[device.pose]
driver = "null.pose"
rate_hz = 5

[task.Steer]
type = "steer.Steer"
settings = { radius_m = 0.8 }

[task.Broken]
type = "steer.Broken"
restart = { policy = "temporary" }
"""


@pytest.fixture
def agent(rig: Rig) -> Running:
    rig.install("steer", ENTRY_POINTS, SOURCE)
    return rig.ready("a", CONFIG)


def said(rig: Rig, *arguments: str) -> str:
    """Runs a command that prints a table and succeeds; returns its lines, with one space between words."""
    result = rig.pancakes(*arguments)
    assert (result.returncode, result.stderr) == (0, "")
    return "\n".join(" ".join(line.split()) for line in result.stdout.splitlines())


def failed(rig: Rig, *arguments: str) -> tuple[int, str]:
    """Runs a command that prints nothing; returns its exit code, and what it says."""
    result = rig.pancakes(*arguments)
    assert result.stdout == ""
    return result.returncode, result.stderr.rstrip("\n")


# An agent -------------------------------------------------------------------------------------------------------


def test_an_agent_says_all_of_itself(rig: Rig, agent: Running):
    other = rig.ready("b", agent=f'peers = ["{rig.address(agent)}"]')
    agent.hear("peer_up peer=b")

    (found,) = rig.listed("agent", "info", "a", "--at", rig.address(other))

    assert (found["agent"], found["role"], found["fleet"]) == ("a", "agent", "test")
    assert found["listen"][-1] == rig.address(agent)
    assert found["process"]["pid"] == agent.pid
    assert found["process"]["uptime_s"] > 0.0
    assert found["disk"]["syncs"] > 0 and found["disk"]["written_bytes"] > 0
    assert (found["speed"], found["held"], found["ready"]) == (1.0, False, True)
    assert found["mission_s"] > 0.0
    assert "load" in found
    assert found["devices"] == ["pose"]
    assert found["neighbours"] == ["b"]
    assert "map" in found["channels"]
    assert found["dead_letters"] == 0
    assert [row["service"] for row in found["services"]] == ["log", "device", "network", "client"]
    (link,) = (peer for peer in found["mesh"]["peers"] if peer["name"] == "b")
    assert link["rtt_s"] is None or link["rtt_s"] > 0.0


def test_the_table_of_an_agent_has_its_sections(rig: Rig, agent: Running):
    rig.ready("b", agent=f'peers = ["{rig.address(agent)}"]')
    agent.hear("peer_up peer=b")

    table = said(rig, "agent", "info", "a")

    lines = table.splitlines()
    assert lines[0] == "a"
    assert [title for title in ("process", "services", "links") if title in lines] == ["process", "services", "links"]
    assert f"addresses {', '.join(rig.addresses(agent))}" in lines
    assert "neighbours b" in lines
    assert "devices pose" in lines
    assert f"pid {agent.pid}" in lines
    assert any("s of the mission, at speed 1; 20" in line and line.endswith(" UTC") for line in lines)
    assert any(line.startswith("disk, an hour ") and line.endswith(" MB written") for line in lines)
    assert any(line.startswith("client ClientService running Steer, Broken") for line in lines)
    (link,) = (line for line in lines if line.startswith("b agent tcp://127.0.0.1:"))
    assert "alice." not in table, "the command shows its own link"
    assert len(link.split()) >= 10


def test_an_agent_that_is_not_there_or_silent(rig: Rig, agent: Running, freeze: Callable[[Running], None]):
    assert failed(rig, "agent", "info", "c") == (3, "there is no agent 'c', only a")
    assert rig.pancakes("agent", "info").returncode == 2
    assert rig.pancakes("task", "list", "--state", "runing").returncode == 2
    assert rig.pancakes("agent", "info", "test/a/client").returncode == 2
    freeze(agent)
    code, sentence = failed(rig, "agent", "info", "a", "--timeout", "0.5")
    assert (code, sentence) == (3, f"a ({rig.addresses(agent)[0]}) did not answer: nothing came within 0.5 s")


def test_of_several_that_are_named_the_silent_one_is_named_too(rig: Rig, freeze: Callable[[Running], None]):
    agents = {name: rig.ready(name) for name in ("a", "b", "c")}
    freeze(agents["b"])

    result = rig.pancakes("agent", "list", "a", "b", "--format", "json", "--timeout", "1")

    assert result.returncode == 0
    assert [row["agent"] for row in json.loads(result.stdout)] == ["a"]
    assert result.stderr == f"b ({rig.addresses(agents['b'])[0]}) did not answer: nothing came within 1 s\n"
    # Those that are not asked for are not waited for, and one that is not there is a mistake.
    assert [row["agent"] for row in rig.listed("agent", "list", "c", "a", "--timeout", "20")] == ["a", "c"]
    code, sentence = failed(rig, "agent", "list", "a", "d", "--timeout", "1")
    assert code == 3
    assert "there is no agent 'd'" in sentence


def test_agents_are_listed_by_fleet_and_role(rig: Rig):
    rig.ready("a", fleet="north")
    rig.ready("w", fleet="south", agent='role = "environment"')
    assert [row["agent"] for row in rig.listed("agent", "list", "--fleet", "north")] == ["a"]
    assert [row["agent"] for row in rig.listed("agent", "list", "--role", "environment")] == ["w"]


def test_commands_come_and_go_without_a_line_in_the_log(rig: Rig, agent: Running):
    for _ in range(3):
        assert rig.listed("agent", "list")
    assert rig.pancakes("task", "rate", "a/pose", "3").returncode == 0
    line = agent.hear("rate_changed")
    assert "by=alice." in line
    assert [text for text in agent.said if "alice." in text] == [line]


# Tasks ----------------------------------------------------------------------------------------------------------


def test_tasks_are_listed_as_asked_for(rig: Rig, agent: Running):
    rig.ready("b", '[device.pose]\ndriver = "null.pose"\n')

    def names(*options: str) -> list[str]:
        return [f"{row['agent']}/{row['task']}" for row in rig.listed("task", "list", *options)]

    assert names("--service", "device") == ["a/pose", "b/pose"]
    assert names("--type", "steer.*") == ["a/Steer", "a/Broken"]
    assert names("--type", "null.pose", "b") == ["b/pose"]
    assert names("--state", "failed") == ["a/Broken"]
    assert names("a", "b", "--service", "device") == ["a/pose", "b/pose"]
    (row,) = rig.listed("task", "list", "--state", "failed", "--long")
    assert row["reason"].startswith("RuntimeError: no wheels at plugin_steer.py:")
    assert (row["incarnation"], row["rate_hz"]) == (1, None)


def test_a_task_says_all_of_itself(rig: Rig, agent: Running):
    (found,) = rig.listed("task", "info", "a/Steer")

    assert (found["agent"], found["service"], found["task"]) == ("a", "client", "Steer")
    assert (found["type"], found["state"], found["rate_hz"]) == ("steer.Steer", "running", 20.0)
    assert found["requires"] == ["pose"]
    assert [timer["timer"] for timer in found["timers"]] == ["tick", "look"]
    (read,) = (row for row in found["reads"] if row["channel"] == "system")
    assert (read["types"], read["limit"]) == (["pose"], 8)
    assert found["settings"] == {"radius_m": 0.8}
    assert found["settings_schema"]["properties"]["radius_m"]["default"] == 0.5
    assert found["fence"]["task_id"] == "a/Steer"


def test_a_device_is_a_task_by_its_name(rig: Rig, agent: Running):
    (found,) = rig.listed("task", "info", "a/pose")
    assert (found["service"], found["type"], found["rate_hz"]) == ("device", "null.pose", 5.0)

    (row,) = rig.listed("task", "rate", "a/pose", "2")
    assert (row["service"], row["timer"], row["before_hz"], row["rate_hz"]) == ("device", "sample", 5.0, 2.0)
    (row,) = rig.listed("task", "stop", "a/pose")
    assert row["done"] == "stopped"
    (found,) = rig.listed("task", "info", "a/device/pose")
    assert (found["state"], found["rate_hz"]) == ("stopped", None)


def test_the_table_of_a_task_has_its_sections(rig: Rig, agent: Running):
    lines = said(rig, "task", "info", "a/Steer").splitlines()

    assert lines[0] == "a/client/Steer"
    assert [title for title in ("timers", "reads", "settings") if title in lines] == ["timers", "reads", "settings"]
    assert "started again permanent, at most 8 times in 60 s, after 0.1 s to 10 s" in lines
    assert any(line.startswith("epoch ") and line.endswith(" of a/Steer") for line in lines)
    assert "requires pose" in lines
    assert "radius_m 0.8" in lines
    assert any(line.startswith("look 2 ") for line in lines)
    assert any(line.startswith("system pose newest 8 ") for line in lines)

    assert "reason RuntimeError: no wheels at plugin_steer.py:" in said(rig, "task", "info", "a/Broken")


def test_a_task_that_is_not_there(rig: Rig, agent: Running):
    assert failed(rig, "task", "info", "a/Stear") == (1, "a has no task 'Stear', did you mean 'Steer'?")
    assert failed(rig, "task", "info", "a/client") == (
        1,
        "a/client is a service, not a task: see pancakes service --help",
    )
    assert failed(rig, "task", "info", "b/Steer") == (3, "there is no agent 'b', only a")


# Services -------------------------------------------------------------------------------------------------------


def test_services_are_listed(rig: Rig, agent: Running):
    rows = rig.listed("service", "list", "a")
    assert [row["service"] for row in rows] == ["log", "device", "network", "client"]
    assert rows[1] == {
        "agent": "a",
        "service": "device",
        "type": "DeviceService",
        "state": "running",
        "tasks": ["pose"],
        "reason": "",
    }
    assert rig.pancakes("service", "stop", "a/client").returncode == 0
    assert [row["service"] for row in rig.listed("service", "list", "--state", "stopped")] == ["client"]

    head, _, row = (line for line in said(rig, "service", "list", "--state", "stopped").splitlines() if line)
    assert head == "agent service type state tasks reason"
    assert row == "a client ClientService stopped -"


def test_a_service_says_all_of_itself(rig: Rig, agent: Running):
    (found,) = rig.listed("service", "info", "a/client", "--at", rig.address(agent))
    assert (found["type"], found["state"]) == ("ClientService", "running")
    assert [(row["task"], row["state"]) for row in found["tasks"]] == [("Steer", "running"), ("Broken", "failed")]

    lines = said(rig, "service", "info", "a/client").splitlines()
    assert lines[0] == "a/client"
    assert "type ClientService" in lines
    assert "Steer steer.Steer running 20" in lines


def test_a_service_that_is_not_there(rig: Rig, agent: Running):
    assert failed(rig, "service", "info", "a/cleint") == (1, "a has no service 'cleint', did you mean 'client'?")
    assert failed(rig, "service", "info", "a/x") == (
        1,
        "a has no service 'x', only log, device, network, client",
    )
    assert failed(rig, "service", "info", "b/client")[0] == 3


def test_the_states_that_can_be_asked_for_are_those_that_there_are():
    words = list(dict.fromkeys(WORDS.values()))
    assert set(task_verbs.STATES) == set(words)
    assert set(service_verbs.STATES) == {*words} - {"stuck"}


@pytest.mark.parametrize(
    "verb",
    [
        ("agent", "list"),
        ("agent", "info"),
        ("task", "list"),
        ("task", "info"),
        ("service", "list"),
        ("service", "info"),
    ],
)
def test_each_has_help_with_an_example(rig: Rig, verb: tuple[str, str]):
    assert f"pancakes {' '.join(verb)}" in rig.pancakes(*verb, "--help").stdout.partition("Example:")[2]


def test_a_verb_that_is_mistyped_is_guessed(rig: Rig):
    result = rig.pancakes("tsk", "list")
    assert result.returncode == 2
    assert "Did you mean 'task'?" in result.stderr
    assert os.linesep in result.stderr
