"""Several fleets on one machine: which of them a command or a client talks to."""

import socket
from collections.abc import Iterator
from contextlib import closing

import pytest
from cli.processes import INSECURE, READY, Rig, Running

from pancakes.client import Client, Target
from pancakes.control import Describe
from pancakes.errors import ControlRefusedError, PancakesError, UnreachableError

LOAD = '[device.load]\ndriver = "host.load"\nrate_hz = 2\n'
NAMED = """
agent info north/a
agent list north/a
agent list --fleet north
task list north/a
service info north/a/device
channel info north/a/log --for 100ms
channel echo north/a/system --count 1
param list north/a/load
param list --fleet north
task migrations --fleet north
doctor --no-machine --fleet north
log --fleet north
down --dry-run north/a
down --dry-run --fleet north
""".strip().splitlines()
WRONG = {
    "task info a/load": (1, "the fleets north and south both have an agent a: name one of them with --fleet"),
    "agent info a --fleet east": (3, "has only the fleets north, south)"),
    "agent list --fleet east": (3, "no agent of the fleet east runs on this machine"),
    "task info north/b/load": (3, "there is no agent 'north'"),
    "down --fleet east": (1, "has only the fleets north, south)"),
    "down --dry-run --fleet east": (1, "has only the fleets north, south)"),
}


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Rig, Running, Running]]:
    """An agent `a` of the fleet north, and another `a` of the fleet south."""
    with closing(Rig(tmp_path_factory.mktemp("shared"))) as rig:
        with rig.keys.offered():
            yield rig, rig.ready("a", LOAD, fleet="north"), rig.ready("a", LOAD.replace("= 2", "= 3"), fleet="south")


def rate_hz(rig: Rig, *arguments: str) -> float:
    found: float = rig.listed("task", "info", *arguments)[0]["rate_hz"]
    return found


def test_fleet_is_chosen_by_option_or_prefix(shared: tuple[Rig, Running, Running]):
    rig, _, _ = shared
    assert (rate_hz(rig, "a/load", "--fleet", "north"), rate_hz(rig, "a/load", "--fleet", "south")) == (2.0, 3.0)
    for name in ("north/a/load", "north/a/device/load"):
        assert rate_hz(rig, name) == 2.0
    found = [(row["fleet"], row["agent"]) for row in rig.listed("agent", "list")]
    assert found == [("north", "a"), ("south", "a")]
    done = {line: rig.pancakes(*line.split()) for line in NAMED}
    assert {line: it.stderr for line, it in done.items() if it.returncode or "south" in it.stdout} == {}


def test_wrong_fleet_is_an_error(shared: tuple[Rig, Running, Running]):
    rig, _, _ = shared
    done = {line: rig.pancakes(*line.split()) for line in WRONG}
    found = {line: (it.returncode, it.stderr) for line, it in done.items()}
    assert {line: it for line, it in found.items() if it[0] != WRONG[line][0] or WRONG[line][1] not in it[1]} == {}


def test_doctor_reports_a_fleet_without_agents_here(shared: tuple[Rig, Running, Running]):
    rig, _, _ = shared
    result = rig.pancakes("doctor", "--no-machine", "--fleet", "east")
    assert result.returncode == 1 and "has only the fleets north, south)" in result.stdout


def test_changes_reach_only_the_agent_of_the_fleet(rig: Rig):
    """A service's task takes precedence over a task of a fleet of the same name."""
    agents = rig.ready("a", LOAD, fleet="device"), rig.ready("device", LOAD, fleet="a")
    assert rate_hz(rig, "a/device/load") == 2.0
    assert rig.pancakes("task", "rate", "a/device/load", "7").returncode == 0
    assert (rate_hz(rig, "a/load"), rate_hz(rig, "device/load")) == (7.0, 2.0)
    assert rate_hz(rig, "a/device/device/load") == 2.0, "written in full it is the agent of the fleet a"
    assert rig.pancakes("down", "--fleet", "device").returncode == 0
    assert (agents[0].ended(), agents[1].process.poll()) == (0, None)
    assert rig.pancakes("down", "a/device").returncode == 0
    assert agents[1].ended() == 0


@pytest.mark.parametrize(
    ("network", "text"),
    [(INSECURE, "it is not of the fleet 'south'; --fleet names another"), ("", "its certificate is of another fleet")],
    ids=["insecure", "with keys"],
)
def test_fleet_of_an_agent_at_an_address_must_be_named(rig: Rig, network: str, text: str):
    north = rig.ready("a", network, fleet="north")
    rig.config("b", network, fleet="south")
    result = rig.pancakes("agent", "list", "--at", f"127.0.0.1:{rig.port(north)}", "--fleet", "south")
    assert result.returncode == 3 and text in result.stderr


def test_client_accepts_short_addresses(shared: tuple[Rig, Running, Running], monkeypatch: pytest.MonkeyPatch):
    rig, _, south = shared
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(rig.runtime))
    place = f"127.0.0.1:{rig.port(south)}"
    for at in (place, [place], f"tcp://{place}", (f"tcp://{place}", place), Target((place,)), Target(fleet="south")):
        with Client(at, 10.0) as client:
            assert client.request("a", Describe("load")).result["rate_hz"] == 3.0
            assert [it["fleet"] for it in client.describe().agents] == ["south"]
    with Client(timeout_s=10.0) as client, pytest.raises(ControlRefusedError, match="name one of them with --fleet"):
        client.request("a", Describe())
    with Client(Target(fleet="east")) as client, pytest.raises(UnreachableError, match="no agent of the fleet east"):
        client.describe()


def test_client_refuses_malformed_addresses():
    for at, text in {
        "nonsense:": "'tcp://nonsense:' has no port",
        "127.0.0.1:0": "'127.0.0.1:0' has the port 0, at which no agent can be reached",
        "127.0.0.1:70000": "a port is a number from 0 to 65535",
    }.items():
        with pytest.raises(PancakesError, match=text):
            Client([at])


def test_all_agents_can_share_one_list_of_peers(rig: Rig):
    """An agent skips its own address in the list."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    peers = f'peers = ["tcp://127.0.0.1:{port}", "tcp://localhost:{port}"]'
    config = rig.config("a", agent=peers)
    config.write_text(config.read_text().replace("127.0.0.1:0", f"127.0.0.1:{port}"))
    a = rig.agent(config)
    a.hear(READY)
    b = rig.ready("b", agent=peers)
    a.hear("peer=b")
    with rig.keys.offered(), Client(Target((f"127.0.0.1:{port}",), "test"), 10.0) as client:
        (found,) = client.describe("a").agents

    assert not [it for it in found["mesh"]["addresses"] if it["static"]]
    assert not [line for agent in (a, b) for line in agent.so_far() if "warning" in line or "error" in line]
