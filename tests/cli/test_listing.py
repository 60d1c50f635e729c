"""`pancakes agent list` and `pancakes task list`: the answers of agents, and the agents that do not answer."""

import json
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import closing

import pytest
from cli.processes import Rig, Running

LOAD = '[device.load]\ndriver = "host.load"\nrate_hz = 2\n'
QUICK = ("--timeout", "1")


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Rig, Running, Running]]:
    """Two connected agents that no test changes."""
    with closing(Rig(tmp_path_factory.mktemp("shared"))) as rig:
        first = rig.ready("gate", LOAD)
        second = rig.ready("node", agent=f'role = "environment"\npeers = ["{rig.address(first)}"]')
        first.hear("peer_up peer=node")
        yield rig, first, second


def test_agent_list_finds_agents_of_this_machine(shared: tuple[Rig, Running, Running]):
    rig, first, second = shared
    rows = rig.listed("agent", "list")
    assert rows[0].pop("mission_s") > 0.0
    assert rows[0] == {
        "agent": "gate",
        "role": "agent",
        "fleet": "test",
        "address": ", ".join(rig.addresses(first)),
        "ready": True,
        "tasks": 6,
        "neighbours": [],  # neither a world is one, nor the command itself
    }
    assert rows[1]["address"] == f"local://test/node, {rig.address(second)}"
    assert [row["agent"] for row in rig.listed("agent", "list", "--role", "environment")] == ["node"]

    result = rig.pancakes("agent", "list", "nodee")
    assert (result.returncode, result.stderr) == (3, "there is no agent 'nodee', did you mean 'node'?\n")


def test_agent_list_at_one_address_finds_the_fleet(shared: tuple[Rig, Running, Running]):
    rig, _, second = shared
    there = ("--at", rig.address(second).removeprefix("tcp://"), "--fleet", "test", "--format", "json")
    elsewhere = str(rig.directory / "elsewhere")
    for words, names in ((("agent", "list"), {"gate", "node"}), (("task", "list", "gate"), {"gate"})):
        result = rig.pancakes(*words, *there, PANCAKES_RUNTIME_DIR=elsewhere)
        assert {row["agent"] for row in json.loads(result.stdout)} == names


def test_task_list_shows_tasks(shared: tuple[Rig, Running, Running]):
    rig, _, _ = shared
    rows = rig.listed("task", "list", "gate")
    load = {"agent": "gate", "service": "device", "task": "load", "type": "host.load", "state": "running"}
    assert {**load, "rate_hz": 2.0, "rest": ""} in rows
    assert next(row for row in rows if row["task"] == "NetworkClient")["rate_hz"] is None

    head, _, *lines = (line for line in rig.pancakes("task", "list").stdout.splitlines() if line.strip())
    assert head.split() == ["agent", "service", "task", "type", "state", "rate_hz"]
    assert ["gate", "device", "load", "host.load", "running", "2"] in [line.split() for line in lines]


def test_silent_agents_are_reported(rig: Rig, freeze: Callable[[Running], None]):
    agents = {name: rig.ready(name) for name in ("a", "b", "c")}
    freeze(agents["b"])
    silent = f"b ({rig.addresses(agents['b'])[0]}) did not answer: nothing came within 1 s\n"

    for words, code, names in (
        (("task", "list"), 0, {"a", "c"}),
        (("agent", "list", "a", "b"), 0, {"a"}),
        (("agent", "list", "b"), 3, set()),
        (("agent", "info", "b"), 3, set()),
        (("task", "list", "b"), 3, set()),
    ):
        result = rig.pancakes(*words, "--format", "json", *QUICK)
        assert (result.returncode, result.stderr) == (code, silent), words
        assert {row["agent"] for row in json.loads(result.stdout or "[]")} == names
    # Those that are not asked for are not waited for, and one that is not there is a mistake.
    assert [row["agent"] for row in rig.listed("agent", "list", "c", "a", "--timeout", "20")] == ["a", "c"]
    missing = rig.pancakes("agent", "list", "a", "d", *QUICK)
    assert missing.returncode == 3 and "there is no agent 'd'" in missing.stderr


def test_address_without_an_agent_exits_with_3(rig: Rig):
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(10.0)
        address = f"127.0.0.1:{server.getsockname()[1]}"
        asking = rig.run("-m", "pancakes.tools.cli.main", "agent", "list", "--at", address)
        stranger, _ = server.accept()
        with stranger:
            stranger.sendall(b"220 mail.example.org ESMTP\r\n")
            assert asking.ended() == 3
    assert f"tcp://{address} did not answer: the other side broke the protocol" in asking.everything()

    result = rig.pancakes("agent", "list", "--at", address)
    asked = rig.pancakes("task", "stop", "a/Count", "--at", address)  # which reaches nobody who could know of `a`
    for refused in (result, asked):
        assert (refused.returncode, refused.stderr) == (3, f"tcp://{address} cannot be reached: connection refused\n")


def test_killed_agent_leaves_no_entry(rig: Rig):
    rig.ready("a").signalled(signal.SIGKILL)
    assert len(list(rig.runtime.glob("*.json"))) == 1
    assert rig.pancakes("agent", "list").returncode == 3
    assert list(rig.runtime.glob("*.json")) == []
