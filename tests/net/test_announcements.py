"""What agents announce by DNS-SD, and what of it is believed."""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec
from ipaddress import ip_interface
from pathlib import Path

import pytest

from pancakes.agent.transport_settings import keys_for, network_settings
from pancakes.client import Client
from pancakes.config import load
from pancakes.errors import ConfigError, PancakesError
from pancakes.mesh.announcements import MOST_ADDRESSES, announced_at, label_of, read
from pancakes.tools.cli.start_checks import machine_doubts
from pancakes.util.plugins import Plugins

OWN = tuple(map(ip_interface, ("10.0.0.5/24", "192.168.7.5/16", "fd00::5/64", "fe80::5/64")))
TEXTS = {b"name": b"robot1", b"fleet": b"field", b"version": b"1.2"}


def test_an_agent_is_announced_at_the_addresses_where_it_can_be_dialled():
    assert announced_at(["local://a", "tcp://0.0.0.0:7401"], OWN) == (7401, ("10.0.0.5", "192.168.7.5"))
    assert announced_at(["tcp://[::]:7401"], OWN) == (7401, ("10.0.0.5", "192.168.7.5", "fd00::5"))
    assert announced_at(["tcp://10.0.0.5:7401", "tcp://[fd00::5]:7401"], OWN) == (7401, ("10.0.0.5", "fd00::5"))


@pytest.mark.parametrize("listen", ["local://a", "tcp://127.0.0.1:7401", "tcp://10.9.9.9:7401", "tcp://robot1:7401"])
def test_an_agent_that_could_not_be_dialled_is_not_announced(listen):
    assert announced_at([listen], OWN) == (0, ())


def test_a_label_is_one_of_dns_and_its_own_for_each_agent_of_each_fleet():
    labels = {label_of(name, fleet) for name in ("a" * 64, "a" * 63 + "b", "a") for fleet in ("f", "f" * 64)}
    assert len(labels) == 6 and all(len(it) <= 63 for it in labels)


def test_an_announcement_becomes_addresses_of_its_port_at_machines_of_these_networks():
    it = read(7401, TEXTS, ["fd00::9", "10.0.0.9", "10.0.0.9"], OWN)
    assert (it.name, it.fleet, it.version) == ("robot1", "field", "1.2")
    assert it.addresses == ("tcp://10.0.0.9:7401", "tcp://[fd00::9]:7401")


def test_only_a_few_addresses_of_one_announcement_are_taken():
    assert len(read(7401, TEXTS, [f"10.0.0.{number}" for number in range(1, 200)], OWN).addresses) == MOST_ADDRESSES


@pytest.mark.parametrize("host", ["127.0.0.1", "8.8.8.8", "224.0.0.251", "0.0.0.0", "::1", "fe80::9", "x", "10.0.1.1"])
def test_an_address_outside_of_these_networks_is_not_dialled(host):
    with pytest.raises(ValueError, match="no address in a network of this machine"):
        read(7401, TEXTS, [host], OWN)


@pytest.mark.parametrize("key", [b"name", b"fleet"])
@pytest.mark.parametrize("text", [None, b"", b"../x", b"a b", b"\x1b[31m", b"\xff\xfe", b"x" * 65, b"x" * 5000, b"a\n"])
def test_a_text_that_is_no_name_is_refused_and_shown_safely(key, text):
    with pytest.raises(ValueError) as refused:
        read(7401, {**TEXTS, key: text}, ["10.0.0.9"], OWN)
    assert str(refused.value).isprintable() and len(str(refused.value)) < 500


@pytest.mark.parametrize("version", [None, b"", b"\x07", b"1" * 33])
def test_a_version_that_is_none_is_not_shown(version):
    assert read(7401, {**TEXTS, b"version": version}, ["10.0.0.9"], OWN).version == "unknown"


@pytest.mark.parametrize("port", [0, -1, 65536])
def test_an_announcement_without_a_port_is_refused(port):
    with pytest.raises(ValueError, match="announces no port"):
        read(port, TEXTS, ["10.0.0.9"], OWN)


def announcing(tmp_path: Path, network: str = ""):
    path = tmp_path / "a.toml"
    path.write_text(f'schema = 1\n[agent]\nname = "robot1"\nmdns = true\n{network}')
    return load(path, (), Plugins())


@pytest.mark.parametrize("network", ["", "[service.network]\nsettings = { insecure = true }\n"])
def test_no_agent_announces_itself_without_keys(tmp_path, monkeypatch, network):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    config = announcing(tmp_path, network)
    with pytest.raises(ConfigError, match=r"a.toml:4: \[agent\] mdns: needs keys of the agent robot1"):
        keys_for(config, network_settings(config), Plugins())


def test_without_zeroconf_a_check_a_terminal_and_the_task_say_what_to_install(tmp_path, monkeypatch):
    from pancakes.mesh.dns_sd import check_installed

    monkeypatch.setitem(sys.modules, "zeroconf", None)
    monkeypatch.setattr("pancakes.tools.cli.start_checks.find_spec", lambda name: None)
    sentence = "without zeroconf: pip install 'pancakes-agents[mdns]'"
    with pytest.raises(PancakesError, match=r"pancakes-agents\[mdns\]"):
        Client("mdns:")
    with pytest.raises(PancakesError, match=r"pancakes-agents\[mdns\]"):
        check_installed("no agent is announced or found by mDNS")
    assert any(sentence in str(it) for it in machine_doubts(announcing(tmp_path), Plugins()))


def test_a_check_says_which_extras_the_services_need(tmp_path, monkeypatch):
    def find_spec(name):
        """Another distribution has brought a part of opentelemetry, and not what sends traces."""
        if name.startswith("opentelemetry."):
            raise ModuleNotFoundError(name)
        return ModuleSpec(name, None) if name == "opentelemetry" else None

    monkeypatch.setattr("pancakes.tools.cli.start_checks.find_spec", find_spec)
    services = '[service.metrics]\ntype = "metrics"\n[service.spans]\ntype = "traces"\n'
    path = tmp_path / "a.toml"
    path.write_text(f'schema = 1\n[agent]\nname = "robot1"\n{services}')
    said = [str(it) for it in machine_doubts(load(path, (), Plugins()), Plugins())]
    assert [it.partition("a.toml:")[2] for it in said if "pip install" in it] == [
        "5: [service.metrics] type: there are no metrics without prometheus_client: pip install"
        " 'pancakes-agents[metrics]'",
        "7: [service.spans] type: no traces are sent without opentelemetry: pip install 'pancakes-agents[otel]'",
    ]
