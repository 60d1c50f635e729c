"""Several fleets on one machine: which of them a command, or a client of one's own, speaks to."""

import json
import socket
from collections.abc import Iterator

import pytest
from cli.processes import INSECURE, READY, Rig, Running

from pancakes.client import Client, Where
from pancakes.control import Describe
from pancakes.errors import ControlRefused, PancakesError, Unreachable

LOAD = '[device.load]\ndriver = "host.load"\nrate_hz = 2\n'


@pytest.fixture
def fleets(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Running, Running]]:
    """An agent `a` of the fleet north, and another `a` of the fleet south."""
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(rig.runtime))
    with rig.keys.offered():
        yield rig.ready("a", LOAD, fleet="north"), rig.ready("a", LOAD.replace("= 2", "= 3"), fleet="south")


def rate_hz(rig: Rig, *arguments: str) -> float:
    result = rig.pancakes("task", "info", *arguments, "--format", "json")
    assert result.returncode == 0, result.stderr
    found: float = json.loads(result.stdout)[0]["rate_hz"]
    return found


def test_a_verb_speaks_to_the_fleet_that_is_named(rig: Rig, fleets: tuple[Running, Running]):
    assert (rate_hz(rig, "a/load", "--fleet", "north"), rate_hz(rig, "a/load", "--fleet", "south")) == (2.0, 3.0)
    for name in ("north/a/load", "north/a/device/load"):
        assert rate_hz(rig, name) == 2.0
    assert rate_hz(rig, "a/device/load", "--fleet", "south") == 3.0
    assert rig.pancakes("task", "rate", "south/a/load", "5").returncode == 0
    assert (rate_hz(rig, "north/a/load"), rate_hz(rig, "south/a/load")) == (2.0, 5.0)


@pytest.mark.parametrize(
    "arguments",
    [
        ("agent", "info", "north/a"),
        ("agent", "list", "north/a"),
        ("agent", "list", "--fleet", "north"),
        ("task", "list", "north/a"),
        ("service", "info", "north/a/device"),
        ("channel", "info", "north/a/log", "--for", "100ms"),
        ("channel", "echo", "north/a/system", "--count", "1"),
        ("param", "list", "north/a/load"),
        ("param", "list", "--fleet", "north"),
        ("task", "migrations", "--fleet", "north"),
        ("doctor", "--no-machine", "--fleet", "north"),
        ("log", "--fleet", "north"),
        ("down", "north/a"),
        ("down", "--fleet", "north"),
    ],
    ids=" ".join,
)
def test_names_of_all_kinds_may_have_a_fleet(rig: Rig, fleets: tuple[Running, Running], arguments: tuple[str, ...]):
    north, south = fleets
    result = rig.pancakes(*arguments)

    assert result.returncode == 0, result.stderr
    assert "south" not in result.stdout
    if arguments[0] == "down":
        assert (north.ended(), south.process.poll()) == (0, None)


def test_a_task_of_a_service_goes_before_a_task_of_a_fleet_of_the_same_name(rig: Rig):
    rig.ready("a", LOAD, fleet="device")
    rig.ready("device", LOAD, fleet="a")
    assert rate_hz(rig, "a/device/load") == 2.0
    assert rig.pancakes("task", "rate", "a/device/load", "7").returncode == 0

    assert (rate_hz(rig, "a/load"), rate_hz(rig, "device/load")) == (7.0, 2.0)
    assert rate_hz(rig, "a/device/device/load") == 2.0, "written in full it is the agent of the fleet a"


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (
            ("task", "info", "a/load"),
            1,
            "the fleets north and south both have an agent a: name one of them with --fleet",
        ),
        (("agent", "info", "a", "--fleet", "east"), 3, "has only the fleets north, south)"),
        (("agent", "list", "--fleet", "east"), 3, "no agent of the fleet east runs on this machine"),
        (("task", "info", "north/b/load"), 3, "there is no agent 'north'"),
        (
            ("agent", "info", "north/a", "--fleet", "south"),
            2,
            "a command speaks to one fleet, not to south (--fleet) and",
        ),
        (("task", "list", "north/a", "south/a"), 2, "a command speaks to one fleet, not to north and south"),
        (("task", "info", "x/north/a/device/load"), 2, "names no task"),
        (("agent", "info", "x/north/a"), 2, "names no agent: write it as AGENT or FLEET/AGENT"),
        (("down", "--fleet", "east"), 0, "no agent of the fleet east runs on this machine"),
    ],
    ids=str,
)
def test_what_is_wrong_with_a_fleet_is_said(
    rig: Rig, fleets: tuple[Running, Running], arguments: tuple[str, ...], code: int, text: str
):
    result = rig.pancakes(*arguments)
    assert (result.returncode, result.stderr.count("Traceback")) == (code, 0)
    assert text in result.stderr


@pytest.mark.parametrize(
    ("network", "text"),
    [(INSECURE, "it is not of the fleet 'south'; --fleet names another"), ("", "its certificate is of another fleet")],
    ids=["insecure", "with keys"],
)
def test_an_agent_of_another_fleet_at_an_address_is_named(rig: Rig, network: str, text: str):
    north = rig.ready("a", network, fleet="north")
    rig.config("b", network, fleet="south")
    result = rig.pancakes("agent", "list", "--at", f"127.0.0.1:{rig.port(north)}", "--fleet", "south")
    assert result.returncode == 3
    assert text in result.stderr


def test_a_client_takes_an_address_as_a_person_writes_it(rig: Rig, fleets: tuple[Running, Running]):
    place = f"127.0.0.1:{rig.port(fleets[1])}"
    for at in (place, [place], f"tcp://{place}", (f"tcp://{place}", place), Where((place,)), Where(fleet="south")):
        with Client(at, 10.0) as client:
            assert client.request("a", Describe("load")).result["rate_hz"] == 3.0
            assert [it["fleet"] for it in client.survey().agents] == ["south"]
    with Client(timeout_s=10.0) as client, pytest.raises(ControlRefused, match="name one of them with --fleet"):
        client.request("a", Describe())
    with Client(Where(fleet="east")) as client, pytest.raises(Unreachable, match="no agent of the fleet east"):
        client.survey()


@pytest.mark.parametrize(
    ("at", "text"),
    [
        ("nonsense", "'tcp://nonsense' has no port"),
        (["127.0.0.1:0"], "'127.0.0.1:0' has the port 0, at which no agent can be reached"),
        (["127.0.0.1:70000"], "a port is a number from 0 to 65535"),
    ],
)
def test_what_is_no_address_is_said_at_once(at: str | list[str], text: str):
    with pytest.raises(PancakesError, match=text):
        Client(at)


def test_a_fleet_can_share_one_list_of_peers(rig: Rig):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    peers = f'peers = ["tcp://127.0.0.1:{port}", "tcp://localhost:{port}"]'
    config = rig.config("a", agent=peers)
    config.write_text(config.read_text().replace("127.0.0.1:0", f"127.0.0.1:{port}"))
    a = rig.agent(config)
    a.hear(READY)
    b = rig.ready("b", agent=peers)
    a.hear("peer=b")
    with rig.keys.offered(), Client(Where((f"127.0.0.1:{port}",), "test"), 10.0) as client:
        (found,) = client.survey("a").agents

    assert not [it for it in found["mesh"]["addresses"] if it["static"]], "its own address is no peer"
    assert not [line for agent in (a, b) for line in agent.so_far() if "warning" in line or "error" in line]
