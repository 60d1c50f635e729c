"""A fleet that uses no ports: the changes to its files."""

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


def test_local_addresses_use_agent_names_or_ports():
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


def test_listener_on_all_interfaces_becomes_local():
    tables = {"a": agent("a", "tcp://0.0.0.0:1"), "b": agent("b", [], "tcp://localhost:1")}
    assert within_machine(tables, {"a": "default", "b": "default"})["b"] == [
        "agent.listen=[]",
        'agent.peers=["local://a"]',
    ]


def test_local_launch_overrides_set_addresses(tmp_path: Path):
    for name, port in (("a", 1), ("b", 2)):
        text = (
            f'schema = 1\n[agent]\nname = "{name}"\nlisten = "tcp://127.0.0.1:{port}"\npeers = ["tcp://127.0.0.1:1"]\n'
        )
        (tmp_path / f"{name}.toml").write_text(text)
    sets = ["agent.fleet=field", "a:agent.listen=tcp://127.0.0.1:9", 'b:agent.peers=["tcp://127.0.0.1:9"]']
    a, b = make_fleet([tmp_path], sets, None, Plugins(), local=True)
    assert a.config.agent.addresses == ("local://field/a",)
    assert (b.config.agent.addresses, b.config.agent.peers) == (("local://field/b",), ("local://field/a",))


def test_local_launch_reports_faults_of_files(tmp_path: Path):
    (tmp_path / "a.toml").write_text("schema = 1\n[agent\n")
    with pytest.raises(ConfigError, match=r"a\.toml:2"):
        make_fleet([tmp_path], [], None, Plugins(), local=True)


def test_agent_that_is_not_a_table_is_refused(tmp_path: Path):
    (tmp_path / "a.toml").write_text("schema = 1\nagent = 5\n")
    with pytest.raises(ConfigError, match=r"\[agent\]: expected a table"):
        make_fleet([tmp_path], [], None, Plugins(), local=True)


def test_demo_in_virtual_time_has_no_network():
    result = CliRunner().invoke(pancakes, ["demo", "encirclement", "--virtual", "--local"])
    assert result.exit_code == 2 and "--local and --virtual exclude each other" in result.output
