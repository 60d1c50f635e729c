"""`pancakes up`: fleets of real processes, none of which is ever left behind."""

import json
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
from cli.processes import PATIENCE_S, Rig, Running, is_gone, wait_until_gone
from harness.programs import Program, pancakes

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
    """A fleet of two agents, one of which starts after the other."""
    rig.config("gate")
    rig.config("node")
    path = rig.directory / "field.toml"
    path.write_text(FLEET)
    return path


def pid_of(line: str) -> int:
    """Return the process in a line such as `gate runs as process 12`."""
    return int(line.rpartition(" ")[2])


def up(rig: Rig, *arguments: str | Path) -> tuple[Running, int, int]:
    """Launch a fleet of gate and node, and wait until both are ready."""
    fleet = rig.launch(*arguments)
    gate = pid_of(fleet.hear("gate runs as process"))
    node = pid_of(fleet.hear("node runs as process"))
    fleet.hear("node is ready")
    return fleet, gate, node


def test_launch_starts_in_order_and_stops_in_reverse(rig: Rig, field: Path):
    fleet, gate, node = up(rig, field)
    agents = [(it["agent"], it["fleet"], it["ready"]) for it in rig.listed("agent", "list")]
    assert agents == [("gate", "field", True), ("node", "field", True)]
    again = rig.pancakes("up", str(field))
    assert again.returncode == 1, "a fleet is not launched twice"
    assert again.stderr == (
        f"the agent gate of the fleet field runs already (process {gate})\n"
        f"the agent node of the fleet field runs already (process {node})\n"
    )

    code, took_s = fleet.signalled(signal.SIGINT)

    assert code == 0
    assert took_s < 4.0
    assert is_gone(gate) and is_gone(node)
    fleet.everything()
    order = ["gate runs", "gate is ready", "node runs", "node is ready", "node has ended", "gate has ended"]
    places = [next(index for index, line in enumerate(fleet.said) if line.startswith(start)) for start in order]
    assert places == sorted(places)
    assert "gate has ended (exit code 0)" in fleet.said
    assert any(line.startswith("node | ") and "node/kernel: ready" in line for line in fleet.said)


def test_launch_of_a_folder_prints_json(rig: Rig):
    for name in ("a", "b"):
        rig.config(name)
    fleet = rig.launch(rig.directory, "--format", "json")
    fleet.hear('"event": "ready"')
    fleet.hear('"event": "ready"')
    assert fleet.signalled(signal.SIGTERM)[0] == 0

    objects = [json.loads(line) for line in fleet.everything().splitlines()]
    for name in ("a", "b"):
        assert {"agent": name, "event": "ended", "text": "has ended (exit code 0)"} in objects
        assert any(f"{name}/kernel: ready" in it["line"] for it in objects if "line" in it)


def test_launch_begins_missions_together_and_restarts_agents(rig: Rig, field: Path):
    field.write_text(FLEET.replace("[agent.gate]", "set = { clock.hold = true }\n[agent.gate]"))
    fleet, gate, node = up(rig, field)
    fleet.hear("the mission of gate, node begins")
    assert begun(rig, "gate")

    psutil.Process(node).kill()

    fleet.hear("node has ended (ended by SIGKILL) and is started again")
    again = pid_of(fleet.hear("node runs as process"))
    fleet.hear("the mission of node begins")
    assert begun(rig, "node")
    assert rig.entry(again)["name"] == "node"
    assert fleet.signalled(signal.SIGTERM)[0] == 0
    assert is_gone(gate) and is_gone(again)


def test_launch_gives_up_an_agent_that_always_fails(rig: Rig, field: Path):
    (rig.directory / "blocked").write_text("a file where a directory should be")
    field.write_text(FLEET + 'set = { agent.state_dir = "blocked" }\nrestart = { at_most = 1 }\n')
    fleet = rig.launch(field)

    fleet.hear("node | the state directory blocked")
    fleet.hear("node has ended (exit code 1) and is given up after 1 restarts within 60 s")
    assert [row["agent"] for row in rig.listed("agent", "list")] == ["gate"]
    assert fleet.signalled(signal.SIGTERM)[0] == 1


def test_launch_can_hold_missions_and_ends_with_its_agents(rig: Rig, field: Path):
    fleet, gate, node = up(rig, field, "--set", "clock.hold=true", "--hold")
    assert mission_s(rig, "gate") == 0.0
    assert rig.pancakes("down").returncode == 0
    assert fleet.ended() == 0
    assert is_gone(gate) and is_gone(node)


def test_killed_launch_leaves_no_agent(rig: Rig, field: Path):
    fleet, gate, node = up(rig, field)

    fleet.process.kill()

    wait_until_gone(gate, node)


def test_launch_kills_an_agent_that_hangs(rig: Rig, field: Path, suspended: Callable[[int], None]):
    fleet, gate, node = up(rig, field)
    suspended(node)

    code, took_s = fleet.signalled(signal.SIGINT)

    assert code == 0
    assert took_s < 6.0
    assert "node has ended (ended by SIGKILL, killed because it took too long)" in fleet.everything()
    assert is_gone(gate) and is_gone(node)


def test_launch_ends_at_once_on_a_second_signal(rig: Rig, field: Path, suspended: Callable[[int], None]):
    fleet, gate, node = up(rig, field)
    suspended(gate)
    fleet.process.send_signal(signal.SIGINT)
    fleet.hear("node has ended (exit code 0)")  # so it has heard the first one

    _, took_s = fleet.signalled(signal.SIGINT)

    assert took_s < 1.5
    assert is_gone(gate) and is_gone(node)


@pytest.fixture
def suspended() -> Any:
    """Suspend a process that is not our child, and return when it is suspended."""
    pids = []

    def suspend(pid: int) -> None:
        process = psutil.Process(pid)
        process.suspend()
        until_s = time.monotonic() + PATIENCE_S
        while process.status() != psutil.STATUS_STOPPED:
            assert time.monotonic() < until_s
        pids.append(process)

    yield suspend
    for process in pids:
        if process.is_running():
            process.resume()


def test_launch_can_be_stopped_while_agents_start(rig: Rig, field: Path):
    fleet = rig.launch(field)
    gate = pid_of(fleet.hear("gate runs as process"))

    code, took_s = fleet.signalled(signal.SIGTERM)

    assert took_s < 4.0
    assert code == 0
    assert is_gone(gate)


def test_launch_ends_without_a_reader(rig: Rig, field: Path):
    process = Program(
        pancakes("up", str(field)),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=rig.environment,
        cwd=rig.directory,
    )
    with process:
        assert process.stdout is not None
        process.stdout.readline()
        process.stdout.close()

        assert process.wait(PATIENCE_S) == 0
    assert list(rig.runtime.glob("*.json")) == []


def mission_s(rig: Rig, agent: str) -> float:
    time_s: float = next(row["mission_s"] for row in rig.listed("agent", "list") if row["agent"] == agent)
    return time_s


def begun(rig: Rig, agent: str) -> bool:
    """Return whether an agent's mission begins; the launcher announces it a moment before."""
    return any(mission_s(rig, agent) > 0.0 for _ in range(20))


def test_refused_launch_starts_nothing(rig: Rig):
    bad = rig.pancakes("up", str(rig.config("a")), str(rig.config("b", "[clock]\nsped = 1\n")))
    assert (bad.returncode, bad.stdout) == (4, "") and "b.toml:9: [clock] sped" in bad.stderr
    with socket.create_server(("127.0.0.1", 0)) as taken:
        listen = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        used = rig.pancakes("up", str(rig.config("a")), str(rig.config("b")), "--set", f"b:agent.listen={listen}")
    assert (used.returncode, used.stdout) == (1, "")
    assert used.stderr.startswith(f"b cannot listen at {listen}: address already in use\n")
    assert "launch with --local (no ports)" in used.stderr
    assert not any(rig.runtime.glob("*.json"))


def test_local_launch_uses_no_port(rig: Rig):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        listen = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        files = [rig.config("a"), rig.config("b", agent=f'peers = ["{listen}"]')]
        fleet = rig.launch(*files, "--set", f"a:agent.listen={listen}", "--local")
        fleet.hear("b (agent, local://process-")
        while len(rows := rig.listed("agent", "list")) < 2:  # an agent's entry may come after its link
            assert fleet.process.poll() is None
    assert [(row["agent"], row["address"], row["neighbours"]) for row in rows] == [
        ("a", "local://test/a", ["b"]),
        ("b", "local://test/b", ["a"]),
    ]
    assert fleet.signalled(signal.SIGTERM)[0] == 0


def test_launch_dry_run_shows_what_would_be_started(rig: Rig, field: Path, request: pytest.FixtureRequest):
    rows = rig.listed("up", str(field), "--dry-run", "--set", "node:agent.seed=5")
    assert [(row["agent"], row["fleet"], row["after"]) for row in rows] == [
        ("gate", "field", []),
        ("node", "field", ["gate"]),
    ]
    assert rows[1]["set"] == ['agent.fleet="field"', "agent.seed=5"]
    assert not any(rig.runtime.glob("*.json"))

    demo = request.config.rootpath / "configs" / "encirclement"
    anywhere = "agent.listen=tcp://127.0.0.1:0"  # a demo may be running on this computer
    rows = rig.listed("up", str(demo), "--set", anywhere, "--dry-run")
    assert [row["agent"] for row in rows] == ["world", "agent1", "agent2", "sensor"]
    assert rows[1]["after"] == ["world"]
