"""`pancakes agent list` and `pancakes task list`: the agents' own answers, and who gave none."""

import json
import signal
import socket
from collections.abc import Callable

import pytest
from cli.processes import Rig, Running

LOAD = '[device.load]\ndriver = "host.load"\nrate_hz = 2\n'
QUICK = ("--timeout", "1")


@pytest.fixture
def pair(rig: Rig) -> tuple[Running, Running]:
    """Two agents that are connected."""
    first = rig.ready("a", LOAD)
    second = rig.ready("b", agent=f'peers = ["{rig.address(first)}"]')
    first.hear("peer_up peer=b")
    return first, second


def test_the_agents_of_this_machine_are_found(rig: Rig, pair: tuple[Running, Running]):
    first, second = pair

    rows = rig.listed("agent", "list")

    assert [row["agent"] for row in rows] == ["a", "b"]
    mission_s = rows[0].pop("mission_s")
    assert mission_s > 0.0
    assert rows[0] == {
        "agent": "a",
        "role": "agent",
        "fleet": "test",
        "address": ", ".join(rig.addresses(first)),
        "ready": True,
        "tasks": 6,
        "neighbours": ["b"],  # and not the command itself, which is a client
    }
    assert rows[1]["address"] == f"local://test/b, {rig.address(second)}"


def test_one_agent_leads_to_the_rest_of_its_fleet(rig: Rig, pair: tuple[Running, Running]):
    address = rig.address(pair[1]).removeprefix("tcp://")
    rig.environment["PANCAKES_RUNTIME_DIR"] = str(rig.directory / "elsewhere")

    assert [row["agent"] for row in rig.listed("agent", "list", "--at", address, "--fleet", "test")] == ["a", "b"]
    assert {row["agent"] for row in rig.listed("task", "list", "a", "--at", address, "--fleet", "test")} == {"a"}


def test_agents_of_several_fleets_are_found_at_once(rig: Rig):
    rig.ready("a", fleet="north")
    rig.ready("b", fleet="south")

    assert [(row["fleet"], row["agent"]) for row in rig.listed("agent", "list")] == [("north", "a"), ("south", "b")]


def test_agents_of_one_name_in_two_fleets_have_to_be_told_apart(rig: Rig):
    north = rig.ready("a", fleet="north")
    rig.ready("a", fleet="south")

    result = rig.pancakes("task", "list", "a")

    assert result.returncode == 1
    assert "the fleets north and south both have an agent a" in result.stderr
    assert rig.listed("task", "list", "a", "--at", rig.address(north))


def test_tasks_are_listed_with_what_they_do(rig: Rig):
    rig.ready("a", LOAD)

    rows = rig.listed("task", "list", "a")

    assert {
        "agent": "a",
        "service": "device",
        "task": "load",
        "type": "host.load",
        "state": "running",
        "rate_hz": 2.0,
        "rest": "",
    } in rows
    assert next(row for row in rows if row["task"] == "NetworkClient")["rate_hz"] is None


def test_a_table_is_for_people(rig: Rig):
    rig.ready("a", LOAD)

    result = rig.pancakes("task", "list")

    head, _, *rows = (line for line in result.stdout.splitlines() if line.strip())
    assert head.split() == ["agent", "service", "task", "type", "state", "rate_hz"]
    assert ["a", "device", "load", "host.load", "running", "2"] in [row.split() for row in rows]


def test_who_does_not_answer_is_named_and_the_others_are_listed(
    rig: Rig, pair: tuple[Running, Running], freeze: Callable[[Running], None]
):
    freeze(pair[1])

    result = rig.pancakes("task", "list", "--format", "json", *QUICK)

    assert result.returncode == 0
    assert {row["agent"] for row in json.loads(result.stdout)} == {"a"}
    assert result.stderr == f"b ({rig.addresses(pair[1])[0]}) did not answer: nothing came within 1 s\n"


def test_where_nobody_answers_the_exit_code_is_3(rig: Rig, freeze: Callable[[Running], None]):
    agent = rig.ready("a")
    freeze(agent)

    result = rig.pancakes("agent", "list", *QUICK)
    assert result.returncode == 3
    assert result.stdout == ""
    assert result.stderr == f"a ({rig.addresses(agent)[0]}) did not answer: nothing came within 1 s\n"

    result = rig.pancakes("task", "list", "a", *QUICK)
    assert result.returncode == 3
    assert result.stderr == f"a ({rig.addresses(agent)[0]}) did not answer: nothing came within 1 s\n"


def test_where_nobody_is_there_it_says_where_it_looked(rig: Rig):
    result = rig.pancakes("agent", "list")

    assert result.returncode == 3
    assert (
        result.stderr == f"no agent runs on this machine ({rig.runtime} names none): start one, or name one with --at\n"
    )


def test_an_address_at_which_nobody_listens(rig: Rig):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]

    result = rig.pancakes("agent", "list", "--at", f"127.0.0.1:{port}")

    assert result.returncode == 3
    assert f"tcp://127.0.0.1:{port} cannot be reached: connection refused" in result.stderr


def test_an_address_at_which_something_else_listens(rig: Rig):
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(10.0)
        address = f"127.0.0.1:{server.getsockname()[1]}"
        asking = rig.run("-m", "pancakes.tools.cli.main", "agent", "list", "--at", address)
        stranger, _ = server.accept()
        with stranger:
            stranger.sendall(b"220 mail.example.org ESMTP\r\n")
            assert asking.ended() == 3
    assert f"tcp://{address} did not answer: the other side broke the protocol" in asking.everything()


def test_an_agent_that_nobody_knows(rig: Rig):
    rig.ready("agent1")

    result = rig.pancakes("task", "list", "agnt1")

    assert result.returncode == 3
    assert result.stderr == "there is no agent 'agnt1', did you mean 'agent1'?\n"


def test_an_agent_that_was_killed_leaves_nothing_behind(rig: Rig):
    agent = rig.ready("a")
    agent.signalled(signal.SIGKILL)
    assert len(list(rig.runtime.glob("*.json"))) == 1

    assert rig.pancakes("agent", "list").returncode == 3
    assert list(rig.runtime.glob("*.json")) == []


def test_bad_usage_is_exit_code_2(rig: Rig):
    assert rig.pancakes("agent", "list", "--at", "127.0.0.1").returncode == 2
    assert rig.pancakes("agent", "list", "--timeout", "0").returncode == 2
    assert rig.pancakes("agent", "lisst").returncode == 2
    assert rig.pancakes("agnt").returncode == 2
