"""`pancakes agent info`, `task list|info` and `service list|info`: the descriptions of agents."""

from collections.abc import Iterator
from contextlib import closing

import pytest
from cli.processes import Rig, Running

from pancakes.supervision.lifecycle import WORDS
from pancakes.tools.cli.verbs import service as service_verbs
from pancakes.tools.cli.verbs import task as task_verbs

SOURCE = """
from dataclasses import dataclass
from pancakes.devices import Pose
from pancakes.kernel.handlers import drop_oldest
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

    @on("system", Pose, queue=8)
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
restart = { policy = "no" }
"""


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Rig, Running, Running]]:
    """Two connected agents that no test changes."""
    with closing(Rig(tmp_path_factory.mktemp("shared"))) as rig:
        rig.install("steer", ENTRY_POINTS, SOURCE)
        first = rig.ready("a", CONFIG)
        second = rig.ready("b", '[device.pose]\ndriver = "null.pose"\n', agent=f'peers = ["{rig.address(first)}"]')
        first.hear("peer_up peer=b")
        yield rig, first, second


def said(rig: Rig, *arguments: str) -> list[str]:
    """Run a command that must succeed and prints a table; return its lines, with one space between words."""
    result = rig.pancakes(*arguments)
    assert (result.returncode, result.stderr) == (0, "")
    return [" ".join(line.split()) for line in result.stdout.splitlines()]


def test_agent_info_shows_all_of_an_agent(shared: tuple[Rig, Running, Running]):
    rig, agent, other = shared
    (found,) = rig.listed("agent", "info", "a", "--at", rig.address(other))
    assert (found["agent"], found["role"], found["fleet"]) == ("a", "agent", "test")
    assert found["listen"][-1] == rig.address(agent)
    assert found["process"]["pid"] == agent.pid and found["process"]["uptime_s"] > 0.0
    assert found["disk"]["syncs"] > 0 and found["disk"]["written_bytes"] > 0
    assert (found["speed"], found["held"], found["ready"]) == (1.0, False, True)
    assert found["mission_s"] > 0.0 and "load" in found
    assert (found["devices"], found["neighbours"], found["dead_letters"]) == (["pose"], ["b"], 0)
    assert "map" in found["channels"]
    assert [row["service"] for row in found["services"]] == ["log", "device", "network", "client"]
    (link,) = (peer for peer in found["mesh"]["peers"] if peer["name"] == "b")
    assert link["rtt_s"] is None or link["rtt_s"] > 0.0

    lines = said(rig, "agent", "info", "a")
    assert lines[0] == "a"
    expected = {"process", "services", "links", "neighbours b", "devices pose", f"pid {agent.pid}"}
    assert expected | {f"addresses {', '.join(rig.addresses(agent))}"} <= set(lines)
    assert any("s of the mission, at speed 1; 20" in line and line.endswith(" UTC") for line in lines)
    assert any(line.startswith("disk, an hour ") and line.endswith(" MB written") for line in lines)
    assert any(line.startswith("client ClientService running Steer, Broken") for line in lines)
    (line,) = (line for line in lines if line.startswith("b agent tcp://127.0.0.1:"))
    assert len(line.split()) >= 10
    assert "alice." not in "".join(lines), "the command does not show its own link"


def test_agent_log_omits_read_only_commands(shared: tuple[Rig, Running, Running]):
    rig, agent, _ = shared
    for _ in range(3):
        assert rig.listed("agent", "list")
    assert rig.pancakes("task", "rate", "a/pose", "5").returncode == 0
    assert "by=alice." in (line := agent.hear("rate_changed"))
    assert [text for text in agent.said if "alice." in text] == [line]


def test_task_list_filters(shared: tuple[Rig, Running, Running]):
    rig, _, _ = shared

    def names(*options: str) -> list[str]:
        return [f"{row['agent']}/{row['task']}" for row in rig.listed("task", "list", *options)]

    assert names("--service", "device") == names("a", "b", "--service", "device") == ["a/pose", "b/pose"]
    assert names("--type", "steer.*") == ["a/Steer", "a/Broken"]
    assert names("--type", "null.pose", "b") == ["b/pose"]
    (row,) = rig.listed("task", "list", "--state", "failed", "--long")
    assert (row["agent"], row["task"], row["incarnation"], row["rate_hz"]) == ("a", "Broken", 1, None)
    assert row["reason"].startswith("RuntimeError: no wheels at plugin_steer.py:")


def test_task_info_shows_all_of_a_task(shared: tuple[Rig, Running, Running]):
    rig, _, _ = shared
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

    lines = said(rig, "task", "info", "a/Steer")
    assert lines[0] == "a/client/Steer"
    assert {"timers", "reads", "settings", "requires pose", "radius_m 0.8"} <= set(lines)
    assert "restarts always, at most 8 times in 60 s, after 0.1 s to 10 s" in lines
    assert any(line.startswith("epoch ") and line.endswith(" of a/Steer") for line in lines)
    assert any(line.startswith("look 2 ") for line in lines)
    assert any(line.startswith("system pose 8 8 ") for line in lines)
    assert "reason RuntimeError: no wheels at plugin_steer.py:" in "\n".join(said(rig, "task", "info", "a/Broken"))
    (found,) = rig.listed("task", "info", "a/device/pose")
    assert (found["service"], found["type"], found["rate_hz"]) == ("device", "null.pose", 5.0), "a device is a task"


def test_service_list_and_info_show_all_of_services(shared: tuple[Rig, Running, Running]):
    rig, agent, _ = shared
    rows = rig.listed("service", "list", "a")
    assert [row["service"] for row in rows] == ["log", "device", "network", "client"]
    expected = {"agent": "a", "service": "device", "type": "DeviceService", "state": "running"}
    assert rows[1] == {**expected, "tasks": ["pose"], "reason": ""}
    assert rig.listed("service", "list", "--state", "stopped") == []
    head, _, *lines = (line for line in said(rig, "service", "list", "b") if line)
    assert head == "agent service type state tasks reason"
    assert "b device DeviceService running pose" in lines

    (found,) = rig.listed("service", "info", "a/client", "--at", rig.address(agent))
    assert (found["type"], found["state"]) == ("ClientService", "running")
    assert [(row["task"], row["state"]) for row in found["tasks"]] == [("Steer", "running"), ("Broken", "failed")]
    lines = said(rig, "service", "info", "a/client")
    assert lines[0] == "a/client"
    assert {"type ClientService", "Steer steer.Steer running 20"} <= set(lines)


def test_info_of_missing_things_is_refused(shared: tuple[Rig, Running, Running]):
    rig, _, _ = shared
    expected = {
        ("task", "info", "a/Stear"): (1, "a has no task 'Stear', did you mean 'Steer'?\n"),
        ("task", "info", "c/Steer"): (3, "there is no agent 'c', only a, b\n"),
        ("service", "info", "a/cleint"): (1, "a has no service 'cleint', did you mean 'client'?\n"),
        ("service", "info", "a/x"): (1, "a has no service 'x', only log, device, network, client\n"),
        ("agent", "info", "c"): (3, "there is no agent 'c', only a, b\n"),
    }
    done = {words: rig.pancakes(*words) for words in expected}
    assert {words: (result.returncode, result.stderr) for words, result in done.items()} == expected
    assert {result.stdout for result in done.values()} == {""}


def test_state_options_are_complete():
    words = set(WORDS.values())
    assert set(task_verbs.STATES) == words
    assert set(service_verbs.STATES) == words - {"stuck"}
