"""Keys of `[device.NAME]` that say when a device misses too much, and when it is silent."""

import pytest

from pancakes.config import check_plugins, parse
from pancakes.devices.health import MissRule
from pancakes.errors import ConfigError
from pancakes.util.plugins import Plugins

HEAD = 'schema = 1\n[agent]\nname = "a"\n'


def faults_of(text):
    try:
        found = check_plugins(parse(HEAD + text, "a.toml"), Plugins())
    except ConfigError as error:
        found = list(error.faults)
    return "; ".join(map(str, found))


def test_both_have_defaults_and_are_read():
    plain, said = parse(
        HEAD
        + """
[device.load]
driver = "host.load"
rate_hz = 1
[device.pose]
driver = "network.pose"
silent_mission_s = 5
missed = { in_a_row = 10, share = 0.2, within_mission_s = 60 }
""",
        "a.toml",
    ).devices.values()
    assert (plain.missed, plain.silent_mission_s) == (MissRule(), None)
    assert (said.missed, said.silent_mission_s) == (MissRule(10, 0.2, 60.0), 5.0)


@pytest.mark.parametrize(
    ("keys", "named"),
    [
        ("missed = { in_a_row = 0 }", "in_a_row"),
        ("missed = { share = 1.5 }", "share"),
        ("missed = { share = 0 }", "share"),
        ("missed = { within_mission_s = -1 }", "within_mission_s"),
        ("missed = { in_row = 3 }", "in_row"),
        ("silent_mission_s = 0", "silent_mission_s"),
    ],
)
def test_what_makes_no_sense_is_named(keys, named):
    assert named in faults_of(f'[device.pose]\ndriver = "network.pose"\n{keys}\n')


def test_an_actuator_is_never_silent():
    assert "is for sensors" in faults_of('[device.motors]\ndriver = "null.motors"\nsilent_mission_s = 5\n')


@pytest.mark.parametrize(
    ("rate_hz", "silent_mission_s", "said"),
    [(0.05, 10, "must be longer than 20 s"), (1, 1, "must be longer than 1 s"), (0.05, 30, ""), (0, 10, "")],
)
def test_silence_is_longer_than_a_period(rate_hz, silent_mission_s, said):
    faults = faults_of(
        f'[device.load]\ndriver = "host.load"\nrate_hz = {rate_hz}\nsilent_mission_s = {silent_mission_s}\n'
    )
    assert said in faults and bool(said) == ("silent_mission_s" in faults)
