"""A fleet that is launched again: stopped tasks stay stopped, which is reported, unless `--fresh` clears the state."""

import json
import signal
import socket
from pathlib import Path

import pytest
from cli.processes import Rig, Running

WALK = """
from pancakes.task import Task, every

class Walk(Task):
    @every(hz=10)
    def tick(self, tick):
        pass
"""
FLEET = """
schema = 1
[fleet]
name = "field"
[agent.gate]
[agent.node]
after = ["gate"]
"""


@pytest.fixture
def field(rig: Rig) -> Path:
    """A fleet of two agents that meet, with a task on the first."""
    rig.install("walk", "[pancakes.tasks]\nwalk.Walk = plugin_walk:Walk\n", WALK)
    rig.config("gate", '[task.Walk]\ntype = "walk.Walk"\n')
    rig.config("node")
    path = rig.directory / "field.toml"
    path.write_text(FLEET)
    return path


def down(fleet: Running) -> list[str]:
    assert fleet.signalled(signal.SIGTERM)[0] == 0
    return fleet.everything().splitlines()


def tasks(rig: Rig, agent: str) -> dict[str, tuple[str, str]]:
    rows = json.loads(rig.pancakes("task", "list", agent, "--service", "client", "--format", "json").stdout)
    return {row["task"]: (row["state"], row["rest"]) for row in rows}


def records(rig: Rig) -> list[Path]:
    """Return the records of the fleet."""
    return [path for name in ("gate", "node") for path in (rig.directory / "state/pancakes/field" / name).glob("*.rec")]


def acquaint(rig: Rig) -> None:
    """Give the agents their own addresses, and each other as peers."""
    with socket.socket() as one, socket.socket() as two:
        places = {}
        for name, it in (("gate", one), ("node", two)):
            it.bind(("127.0.0.1", 0))
            places[name] = f"tcp://127.0.0.1:{it.getsockname()[1]}"
    for name, other in (("gate", "node"), ("node", "gate")):
        path = rig.directory / f"{name}.toml"
        text = path.read_text().replace("tcp://127.0.0.1:0", places[name])
        path.write_text(text.replace("[agent]", f'[agent]\npeers = ["{places[other]}"]'))


def heard(fleet: Running, text: str) -> None:
    """Wait for a line that contains a text, unless one was printed already."""
    if not any(text in line for line in fleet.said):
        fleet.hear(text)


def test_launch_reports_migrated_tasks_unless_fresh(rig: Rig, field: Path):
    acquaint(rig)
    fleet = rig.launch(field)
    heard(fleet, "task_started task=Walk")
    moved = rig.pancakes("task", "migrate", "gate/Walk", "--to", "node")
    assert moved.returncode == 0, moved.stderr
    assert not [line for line in down(fleet) if "does not start" in line]

    fleet = rig.launch(field)
    fleet.hear("gate does not start client/Walk: moved → node")
    fleet.hear("node is ready")
    assert tasks(rig, "gate") == {"Walk": ("stopped", "moved → node")}
    assert tasks(rig, "node") == {"Walk": ("running", "")}
    assert "moved → node" in rig.pancakes("task", "list", "gate").stdout
    assert "moved → node" in rig.pancakes("task", "info", "gate/Walk").stdout
    said = down(fleet)
    assert [line for line in said if line.startswith("gate | ") and "gate/client/Walk does not start" in line]

    refused = rig.pancakes("up", str(field), "--fresh")
    assert refused.returncode == 1 and "is lost. Pass --yes to do it" in refused.stderr
    fleet = rig.launch(field, "--fresh", "--yes")
    fleet.hear("gate begins from scratch")
    heard(fleet, "task_started task=Walk")
    assert tasks(rig, "gate") == {"Walk": ("running", "")}
    assert tasks(rig, "node") == {}
    assert not [line for line in down(fleet) if "does not start" in line]


def test_launch_fresh_is_refused_beside_an_agent_of_the_fleet(rig: Rig, field: Path):
    fleet = rig.launch(field)
    fleet.hear("node is ready")
    assert rig.pancakes("task", "stop", "gate/Walk").returncode == 0
    down(fleet)
    fleet = rig.launch(field, "--format", "json")
    line = fleet.hear('"event": "rests"')
    assert json.loads(line) == {"agent": "gate", "event": "rests", "text": "does not start client/Walk: stopped"}
    fleet.hear('"agent": "node", "event": "ready"')
    down(fleet)
    before = records(rig)
    assert any(path.name.startswith("record.") for path in before)
    other = rig.ready("other", fleet="field")

    demo = ("demo", "encirclement", "--live", "--headless", "--set", "agent.fleet=field")
    for asked in (("up", str(field), "--fresh"), ("up", str(field), "--fresh", "--dry-run"), demo):
        refused = rig.pancakes(*asked)
        assert refused.returncode == 1, asked
        assert f"other of the fleet field runs outside this launch (process {other.pid})" in refused.stderr
    assert records(rig) == before
    assert rig.pancakes("down", "other").returncode == 0
    would = rig.listed("up", str(field), "--fresh", "--dry-run")
    assert {row["agent"]: row["deletes"] != "" for row in would} == {"gate": True, "node": True}
    assert all(any(path.is_relative_to(row["deletes"]) for path in before) for row in would)
    assert "deletes" not in rig.listed("up", str(field), "--dry-run")[0]
    assert records(rig) == before


def test_launch_fresh_detects_an_agent_at_a_peer_address(rig: Rig, field: Path):
    """This is how it detects an agent on another computer."""
    elsewhere = rig.directory / "elsewhere"
    rig.environment["PANCAKES_RUNTIME_DIR"] = str(elsewhere)
    rig.runtime, here = elsewhere, rig.runtime
    address = rig.address(rig.ready("other", fleet="field"))
    rig.environment["PANCAKES_RUNTIME_DIR"] = str(here)
    rig.runtime = here

    refused = rig.pancakes("up", str(field), "--fresh", "--set", f'node:agent.peers=["{address}"]')

    assert refused.returncode == 1
    assert f"other of the fleet field runs outside this launch ({address})" in refused.stderr
    another = rig.pancakes("up", str(rig.config("lone")), "--fresh", "--dry-run", "--set", f'agent.peers=["{address}"]')
    assert another.returncode == 0, "that one is of another fleet"
