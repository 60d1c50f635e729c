"""A configuration file, and what an agent knows once it has been read."""

from pathlib import Path

import pytest

from pancakes.config import load, parse
from pancakes.errors import ConfigError

MINIMAL = 'schema = 1\n[agent]\nname = "agent1"\n'

FULL = """
schema = 1

[agent]
name = "agent1"
listen = "tcp://127.0.0.1:7401"
peers = ["tcp://127.0.0.1:7402", "tcp://[::1]:7403"]
role = "environment"
fleet = "lab"
state_dir = "state/agent1"
seed = 7

[clock]
speed = 5
hold = true

[channel.images]

[device.motors]
driver = "sim.differential_drive"
settings = { wheel_base_m = 0.0885 }
hold_after_mission_s = 0.25

[device.pose]
driver = "network.pose"
rate_hz = 10

[service.network]
settings = { discovery_hz = 1 }

[service.vision]
type = "example.Vision"

[task.ScanTarget]
type = "encirclement.ScanTarget"
restart = { policy = "on-failure", at_most = 5, within_s = 2 }
settings = { radius_m = 0.55 }
durability = "each"
migrate = { when = "battery", below = 0.65, cost = "tasks", then = "GoHome" }

[task.GoHome]
type = "encirclement.GoHome"
service = "vision"
start = false
rate_hz = 4
"""


def test_a_name_is_all_that_an_agent_needs():
    config = parse(MINIMAL, "agent1.toml")

    agent = config.agent
    assert (agent.name, agent.listen, agent.peers, agent.role, agent.fleet) == ("agent1", (), (), "agent", "default")
    assert agent.state_dir == ""
    assert agent.seed is None
    assert (config.clock.speed, config.clock.hold) == (1.0, False)
    assert not config.devices and not config.tasks and not config.channels


def test_the_four_default_services_are_always_there():
    services = parse(MINIMAL, "agent1.toml").services

    assert {name: service.type for name, service in services.items()} == {
        "device": "device",
        "network": "network",
        "log": "log",
        "client": "client",
    }


def test_everything_that_a_file_can_say():
    config = parse(FULL, "agent1.toml")

    agent = config.agent
    assert agent.peers == ("tcp://127.0.0.1:7402", "tcp://[::1]:7403")
    assert (agent.role, agent.fleet, agent.state_dir, agent.seed) == ("environment", "lab", "state/agent1", 7)
    assert (config.clock.speed, config.clock.hold) == (5.0, True)
    assert list(config.channels) == ["images"]

    motors, pose = config.devices["motors"], config.devices["pose"]
    assert (motors.name, motors.driver, motors.rate_hz) == ("motors", "sim.differential_drive", None)
    assert (motors.settings, motors.hold_after_mission_s) == ({"wheel_base_m": 0.0885}, 0.25)
    assert (pose.rate_hz, pose.hold_after_mission_s) == (10.0, 0.5)

    assert config.services["network"].settings == {"discovery_hz": 1}
    assert config.services["vision"].type == "example.Vision"

    scan, home = config.tasks["ScanTarget"], config.tasks["GoHome"]
    assert (scan.service, scan.start, scan.rate_hz, scan.durability) == ("client", True, None, "each")
    assert (scan.restart.policy, scan.restart.at_most, scan.restart.within_s) == ("on-failure", 5, 2.0)
    assert scan.migrate is not None
    assert (scan.migrate.when, scan.migrate.field, scan.migrate.below, scan.migrate.above) == (
        "battery",
        "level",
        0.65,
        None,
    )
    assert (scan.migrate.cost, scan.migrate.then) == ("tasks", "GoHome")
    assert (home.service, home.start, home.rate_hz, home.migrate) == ("vision", False, 4.0, None)
    assert (home.restart.policy, home.restart.at_most, home.restart.within_s) == ("always", 8, 60.0)
    assert (home.restart.pause_s, home.restart.pause_max_s, home.restart.again_s) == (0.1, 10.0, 0.0)


def test_tables_keep_the_order_of_the_file():
    config = parse(MINIMAL + '[task.b]\ntype = "x"\n[task.a]\ntype = "x"\n', "agent1.toml")

    assert list(config.tasks) == ["b", "a"]


def test_it_can_say_where_a_key_stands():
    config = parse(FULL, "agent1.toml")
    line = FULL.splitlines().index("[device.pose]") + 1

    assert config.places.where("device", "pose") == f"agent1.toml:{line}"
    assert config.places.where("device", "pose", "rate_hz") == f"agent1.toml:{line + 2}"
    assert config.places.where("device", "pose", "hold_after_mission_s") == f"agent1.toml:{line}", (
        "not written: its table"
    )
    assert config.places.where("task", "Other") == "agent1.toml", "no such table: the file"


def test_load_reads_a_file_with_windows_line_ends_and_a_byte_order_mark(tmp_path: Path):
    path = tmp_path / "agent1.toml"
    path.write_bytes(b"\xef\xbb\xbf" + MINIMAL.replace("\n", "\r\n").encode())

    config = load(path)

    assert config.agent.name == "agent1"
    assert config.path == str(path)
    assert config.places.where("agent", "name") == f"{path}:3"


def test_a_missing_file_is_named_with_the_one_that_was_meant(tmp_path: Path):
    (tmp_path / "agent1.toml").write_text(MINIMAL)
    missing = tmp_path / "agnet1.toml"

    with pytest.raises(ConfigError) as error:
        load(missing)
    assert str(error.value) == f"{missing}: file: there is no such file, did you mean '{tmp_path / 'agent1.toml'}'?"


def test_a_missing_file_is_never_answered_with_one_that_is_no_configuration(tmp_path: Path):
    (tmp_path / "lamp.pid").write_text("1")
    with pytest.raises(ConfigError, match="there is no such file$"):
        load(tmp_path / "lamp")


def test_a_missing_file_in_a_missing_folder_is_named(tmp_path: Path):
    with pytest.raises(ConfigError, match="there is no such file$"):
        load(tmp_path / "nowhere" / "agent1.toml")


def test_a_directory_is_no_file(tmp_path: Path):
    with pytest.raises(ConfigError, match="is a directory, not a file"):
        load(tmp_path)


def test_a_file_that_may_not_be_read_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(path: Path, mode: str) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)  # the rights of a file do not stop root, who may run this
    with pytest.raises(ConfigError, match="agent1.toml: file: cannot be read: permission denied"):
        load(tmp_path / "agent1.toml")


def test_a_file_that_is_not_utf8_says_on_which_line(tmp_path: Path):
    path = tmp_path / "agent1.toml"
    path.write_bytes(b"schema = 1\n[agent]\nname = 'Z\xfcrich'\n")

    with pytest.raises(ConfigError, match=r"agent1.toml:3: file: is not UTF-8"):
        load(path)
