"""A fleet that takes no port: what is set in its files."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from pancakes.errors import ConfigError
from pancakes.tools.cli.main import pancakes
from pancakes.tools.launch.fleet_file import make_fleet
from pancakes.tools.launch.ports import within_machine
from pancakes.util.plugins import Plugins


def agent(name: str, listen: object, *peers: str, **more: object) -> dict[str, object]:
    return {"agent": {"name": name, "listen": listen, "peers": list(peers)}, **more}


def test_agents_are_found_by_their_names_and_other_places_by_their_ports():
    bus = {"device": {"ir": {"settings": {"world": "tcp://127.0.0.1:7410"}}}}
    tables = {
        "world": agent("world", "tcp://127.0.0.1:1", "tcp://127.0.0.1:2", task={"W": {"bus": "tcp://127.0.0.1:7410"}}),
        "robot": agent("robot", ["tcp://127.0.0.1:2"], "tcp://127.0.0.1:1", "tcp://10.0.0.7:1", **bus),
    }
    assert within_machine(tables, {"world": "field", "robot": "field"}) == {
        "world": ["agent.listen=[]", 'agent.peers=["local://field/robot"]', 'task.W.bus="local://field/port-7410"'],
        "robot": [
            "agent.listen=[]",
            'agent.peers=["local://field/world", "tcp://10.0.0.7:1"]',
            'device.ir.settings.world="local://field/port-7410"',
        ],
    }


def test_who_listens_on_all_interfaces_is_found_by_its_name_as_well():
    tables = {"a": agent("a", "tcp://0.0.0.0:1"), "b": agent("b", [], "tcp://localhost:1")}
    assert within_machine(tables, {"a": "default", "b": "default"})["b"] == [
        "agent.listen=[]",
        'agent.peers=["local://a"]',
    ]


def test_a_fleet_is_launched_within_its_machine_whatever_is_set_of_its_files(tmp_path: Path):
    for name, port in (("a", 1), ("b", 2)):
        text = (
            f'schema = 1\n[agent]\nname = "{name}"\nlisten = "tcp://127.0.0.1:{port}"\npeers = ["tcp://127.0.0.1:1"]\n'
        )
        (tmp_path / f"{name}.toml").write_text(text)
    sets = ["agent.fleet=field", "a:agent.listen=tcp://127.0.0.1:9", 'b:agent.peers=["tcp://127.0.0.1:9"]']
    a, b = make_fleet([tmp_path], sets, None, Plugins(), local=True)
    assert a.config.agent.addresses == ("local://field/a",)
    assert (b.config.agent.addresses, b.config.agent.peers) == (("local://field/b",), ("local://field/a",))


def test_what_is_wrong_with_a_file_is_said_as_ever(tmp_path: Path):
    (tmp_path / "a.toml").write_text("schema = 1\n[agent\n")
    with pytest.raises(ConfigError, match=r"a\.toml:2"):
        make_fleet([tmp_path], [], None, Plugins(), local=True)


def test_a_file_that_says_of_its_agent_no_table_is_refused_with_a_sentence(tmp_path: Path):
    (tmp_path / "a.toml").write_text("schema = 1\nagent = 5\n")
    with pytest.raises(ConfigError, match=r"\[agent\]: expected a table"):
        make_fleet([tmp_path], [], None, Plugins(), local=True)


def test_a_demo_in_virtual_time_has_no_network():
    result = CliRunner().invoke(pancakes, ["demo", "encirclement", "--virtual", "--local"])
    assert result.exit_code == 2 and "--local does not go with --virtual" in result.output
