"""Addresses of agents."""

import pytest
from seeded import for_each

from pancakes.config import Address, parse_address
from pancakes.mesh.address import dialled, spelt


def test_address_parts():
    def check(case):
        text, address, loopback = case
        assert parse_address(text) == address
        assert address.loopback is loopback

    for_each(
        [
            ("tcp://127.0.0.1:7401", Address("tcp", "127.0.0.1", 7401), True),
            ("tcp://localhost:0", Address("tcp", "localhost", 0), True),
            ("tcp://127.8.0.1:1", Address("tcp", "127.8.0.1", 1), True),
            ("tcp://[::1]:65535", Address("tcp", "::1", 65535), True),
            ("tcp://[fe80::1%eth0]:1", Address("tcp", "fe80::1%eth0", 1), False),
            ("tcp://[::ffff:127.0.0.1]:1", Address("tcp", "127.0.0.1", 1), True),
            ("tcp://[::FFFF:7f00:1]:1", Address("tcp", "127.0.0.1", 1), True),
            ("tcp://[0:0:0:0:0:0:0:1]:1", Address("tcp", "::1", 1), True),
            ("tcp://[2001:DB8::0:1]:07401", Address("tcp", "2001:db8::1", 7401), False),
            ("tcp://0.0.0.0:1", Address("tcp", "0.0.0.0", 1), False),
            ("tcp://robot-1.lab.example:1", Address("tcp", "robot-1.lab.example", 1), False),
            ("unix:///run/robot-1.sock", Address("unix", path="/run/robot-1.sock"), True),
            ("tcp://localhost.evil.example:1", Address("tcp", "localhost.evil.example", 1), False),
        ],
        check,
    )


def test_one_place_has_one_spelling():
    for text in ("tcp://[::ffff:10.0.0.7]:7401", "tcp://[::ffff:a00:7]:7401", "tcp://10.0.0.7:07401"):
        assert spelt(text) == "tcp://10.0.0.7:7401"
    assert spelt("tcp://[fe80:0::1%eth0]:1") == "tcp://[fe80::1%eth0]:1"
    assert spelt("local://lab/robot1") == "local://lab/robot1"
    assert spelt("no address") == "no address"


def test_every_interface_has_two_spellings():
    assert parse_address("tcp://0.0.0.0:1").everywhere and parse_address("tcp://[0::0]:1").everywhere
    assert parse_address("tcp://[::ffff:0.0.0.0]:1").everywhere and not parse_address("tcp://[::1]:1").everywhere


def test_address_that_is_none_says_why():
    def check(case):
        text, problem = case
        with pytest.raises(ValueError, match="^'") as error:
            parse_address(text)
        assert problem in str(error.value)

    for_each(
        [
            ("", "is no address"),
            ("127.0.0.1:7401", "write it as tcp://host:port"),
            ("tcp://::1:7401", "an IPv6 host stands in brackets"),
            ("tcp://127.0.0.1:7401/x", "is no address"),
            ("tcp://me@host:1", "is no address"),
            ("unix://run/robot1", "is no address"),
            ("unix:///run/robot 1", "is no address"),
            ("tcp://[fe80::1%\x1b[2J]:1", "is no address"),
            ("tcp://host", "has no port"),
            ("tcp://host:", "has no port"),
            ("tcp://host:http", "has a bad port, 'http'"),
            ("tcp://host:65536", "has a bad port"),
            ("tcp://host:-1", "has a bad port"),
            ("tcp://:7401", "has no host"),
            ("tcp://[]:7401", "has no host"),
            ("tcp://[::x]:7401", "has a bad IPv6 host"),
            ("tcp://256.0.0.1:1", "four numbers from 0 to 255"),
            ("tcp://ho*st:1", "has a bad host"),
        ],
        check,
    )


def test_only_a_port_of_0_asks_for_any_port():
    assert parse_address("tcp://localhost:0").any_port
    assert not parse_address("tcp://localhost:1").any_port and not parse_address("unix:///run/robot1").any_port


def test_agent_address_without_a_port_has_the_default_one():
    for text, whole in (
        ("robot1", "tcp://robot1:7401"),
        ("10.0.0.5", "tcp://10.0.0.5:7401"),
        ("[fe80::1%eth0]", "tcp://[fe80::1%eth0]:7401"),
        ("tcp://robot1", "tcp://robot1:7401"),
        ("robot1:80", "tcp://robot1:80"),
        ("local://robot1", "local://robot1"),
    ):
        assert dialled(text) == whole
    assert spelt("tcp://robot1") == "tcp://robot1:7401"
    with pytest.raises(ValueError, match="has no port"):
        dialled("robot1:")
    with pytest.raises(ValueError, match="has no port"):  # a bus, or a node that is no agent
        parse_address("tcp://robot1")
