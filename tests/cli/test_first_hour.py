"""The first hour with a fleet (docs/security.md), between machines that share only a network."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

import pytest
from cli.machines import PASSWORD, Machine, machines
from cli.processes import READY

ONCE = f"{PASSWORD}\n"


@pytest.fixture
def three(request, tmp_path) -> Iterator[list[Machine]]:
    with machines(tmp_path, ["laptop", "robot1", "robot2"], getattr(request, "param", "homes")) as made:
        made[0].said("keys", "init", "garage", "--me", "alice", typed=ONCE * 2)
        yield made


def enrolled(laptop: Machine, machine: Machine, *arguments: str) -> str:
    """Admit a machine with a code; return the output of `join` there."""
    waiting = laptop.begin("keys", *arguments, "--host", laptop.host, "--port", "0", typed=ONCE)
    code = waiting.hear("pancakes keys join ").rpartition(" ")[2]
    said = machine.said("keys", "join", code)
    waiting.hear(f"{arguments[1]} has joined from {machine.host}.")
    assert waiting.ended() == 0
    again = machine.pancakes("keys", "join", code)
    assert again.returncode == 1 and "connection refused. Is pancakes keys enrol still waiting there?" in again.stderr
    return said


def carried(laptop: Machine, machine: Machine, *arguments: str) -> str:
    """Admit a machine with a folder; return the output of `join` there."""
    laptop.said("keys", *arguments, "--out", "stick", typed=ONCE)
    laptop.bring("stick", machine)
    said = machine.said("keys", "join", "stick")
    assert "Remove stick now" in said
    return said


def agents(laptop: Machine, at: Machine) -> dict[str, dict]:
    rows = json.loads(laptop.said("agent", "list", "--at", at.address, "--fleet", "garage", "--format", "json"))
    return {row["agent"]: row for row in rows}


@pytest.mark.parametrize("three", ["homes", "namespaces"], indirect=True)
def test_first_hour_of_two_robots(three):
    laptop, robot1, robot2 = three
    said = enrolled(laptop, robot1, "enrol", "agent1", "--group", "field")
    assert "This machine is agent1 of the fleet garage" in said and "has not left this machine" in said
    carried(laptop, robot2, "enrol", "agent2")
    one = robot1.agent("agent1", [f"tcp://{robot2.address}"])
    two = robot2.agent("agent2", [f"tcp://{robot1.address}"])
    one.hear("agent2 (agent, tcp://")
    one.so_far(), two.hear(READY)
    found = agents(laptop, robot1)
    assert {name: it["neighbours"] for name, it in found.items()} == {"agent1": ["agent2"], "agent2": ["agent1"]}
    listed = json.loads(laptop.said("keys", "list", "--format", "json"))
    assert [(it["name"], it["role"], it["groups"], it["state"]) for it in listed] == [
        ("alice", "operator", [], "good"),
        ("agent1", "agent", ["field"], "good"),
        ("agent2", "agent", [], "good"),
    ]
    assert listed[1]["came_from"] == robot1.host

    enrolled(laptop, robot1, "renew", "agent1")
    two.so_far()  # has the line of the first link, which may come after READY
    reloaded = laptop.said("agent", "reload-keys", "agent1", "--at", robot1.address, "--fleet", "garage")
    assert "agent1" in reloaded
    one.hear("there is a new key in ")
    two.hear("agent1 (agent, tcp://")
    assert agents(laptop, robot2)["agent2"]["neighbours"] == ["agent1"]

    lost = laptop.said("keys", "revoke", "agent2", "lost in the field", "--yes", "--at", robot1.address, typed=ONCE)
    assert "revoked" in lost and "The roster 2 is known to agent1." in lost, lost
    one.hear("agent2 is not believed any more: its certificate was revoked (roster 2): agent/agent2: lost in the field")
    assert agents(laptop, robot1)["agent1"]["neighbours"] == []
    refused = laptop.pancakes("agent", "list", "--at", robot2.address, "--fleet", "garage")
    assert refused.returncode != 0 and "its certificate was revoked" in refused.stderr, refused.stderr

    enrolled(laptop, robot2, "enrol", "agent2")
    robot2.said("agent", "reload-keys", "agent2")
    one.hear("agent2 (agent, tcp://")


def test_first_hour_of_a_person_without_a_right(three):
    laptop, robot1, desk = three
    enrolled(laptop, robot1, "enrol", "agent1")
    said = carried(laptop, desk, "enrol", "bob", "--role", "observer")
    assert "You are observer bob of the fleet garage" in said
    robot1.agent("agent1").hear(READY)
    assert list(agents(desk, robot1)) == ["agent1"]
    at = ("--at", robot1.address, "--fleet", "garage")
    refused = desk.pancakes("task", "stop", "agent1/load", *at)
    grant = re.search(r"pancakes (keys allow bob change --on '(.+)' --agent agent1)", refused.stderr)
    assert refused.returncode == 1 and grant is not None, refused.stderr
    told = laptop.said(
        "keys", "allow", "bob", "change", "--on", grant[2], "--agent", "agent1", "--at", robot1.address, typed=ONCE
    )
    assert "The roster 2 is known to agent1." in told
    assert desk.pancakes("task", "stop", "agent1/load", *at).returncode == 0


def test_first_hour_with_a_wrong_password_issues_nothing(three):
    laptop, robot1, _ = three
    refused = laptop.pancakes("keys", "enrol", "agent1", "--out", "stick", typed="guess\n")
    assert refused.returncode == 1 and "password" in refused.stderr.lower() and "Traceback" not in refused.stderr
    assert not (laptop.home / "stick").exists() and "agent1" not in laptop.said("keys", "list")
    other = robot1.pancakes("keys", "init", "garage", "--me", "eve", typed="one\ntwo\n")
    assert other.returncode != 0 and not (robot1.home / ".config/pancakes/fleets/garage").exists()


def test_first_hour_leaves_no_secret_behind(three):
    """Neither an agent with debug logs nor a command leaves the key, the code or the password anywhere."""
    laptop, robot1, _ = three
    waiting = laptop.begin("keys", "enrol", "agent1", "--host", laptop.host, "--port", "0", typed=ONCE)
    code = waiting.hear("pancakes keys join ").rpartition(" ")[2]
    shown = robot1.said("keys", "join", code)
    assert waiting.ended() == 0
    rest = '[service.log]\nsettings = { level = "debug", file = "all.jsonl", traceback = true }\n'
    robot1.agent("agent1", rest=rest).hear(READY)
    laptop.said("agent", "info", "agent1", "--at", robot1.address, "--fleet", "garage")
    key = robot1.home / ".local/share/pancakes/keys/garage/agent1/key.pem"
    private = key.read_text().partition("PRIVATE KEY-----\n")[2].partition("\n-----END")[0].split("\n")
    secret = code.rpartition("/")[2]
    outside = [path for path in (*robot1.home.rglob("*"), *laptop.home.rglob("*")) if path.is_file() and path != key]
    others = [line for line in waiting.said if code not in line]
    texts = [shown, *others, *(path.read_bytes().decode("latin-1") for path in outside)]
    assert len(private) > 1 and len(texts) > 8
    for text in texts:
        assert not any(line in text for line in private)
        assert secret not in text and secret.replace("-", "") not in text
        if text != ONCE:  # which is what the test itself types
            assert PASSWORD not in text
