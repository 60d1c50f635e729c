"""`--set table.key=value`: a launcher or a person overrides one key of a file."""

import pytest

from pancakes.config import Config, parse
from pancakes.errors import ConfigError

TEXT = """schema = 1
[agent]
name = "agent1"
[task.ScanTarget]
type = "encirclement.ScanTarget"
settings = { radius_m = 0.55, speed_mps = 0.1 }
[task.Other]
type = "x"
"""


def with_sets(*sets: str) -> Config:
    return parse(TEXT, "a.toml", sets)


def faults(*sets: str) -> list[str]:
    with pytest.raises(ConfigError) as error:
        with_sets(*sets)
    return [str(fault) for fault in error.value.faults]


def test_it_replaces_what_the_file_says():
    assert with_sets("agent.name=other").agent.name == "other"


def test_it_adds_what_the_file_leaves_out():
    config = with_sets("clock.speed=5", "clock.hold=true", "agent.seed=3")

    assert (config.clock.speed, config.clock.hold, config.agent.seed) == (5.0, True, 3)


def test_it_reaches_into_settings_and_leaves_the_others():
    config = with_sets("task.ScanTarget.settings.radius_m=0.6")

    assert config.tasks["ScanTarget"].settings == {"radius_m": 0.6, "speed_mps": 0.1}


def test_a_whole_table_is_replaced_as_a_whole():
    config = with_sets("task.ScanTarget.settings={ radius_m = 0.6 }")

    assert config.tasks["ScanTarget"].settings == {"radius_m": 0.6}


def test_a_value_that_is_no_toml_is_a_string():
    config = with_sets("agent.listen=tcp://127.0.0.1:7401", "agent.state_dir = /tmp/x y", 'agent.fleet="7"')

    assert config.agent.listen == ("tcp://127.0.0.1:7401",)
    assert config.agent.state_dir == "/tmp/x y"
    assert config.agent.fleet == "7"


def test_lists_are_written_as_in_toml():
    assert with_sets('agent.peers=["tcp://127.0.0.1:1"]').agent.peers == ("tcp://127.0.0.1:1",)


def test_keys_with_dots_are_quoted():
    assert with_sets('task.Other.settings."a.b"=2').tasks["Other"].settings == {"a.b": 2}


def test_the_last_one_counts():
    assert with_sets("agent.seed=1", "agent.seed=2").agent.seed == 2


def test_the_rest_of_a_value_cannot_smuggle_in_another_key():
    assert with_sets("agent.state_dir=1\nseed = 9").agent.seed is None


def test_a_fault_names_the_override_and_not_the_line():
    assert faults("agent.seed=-4", "task.ScanTarget.strat=true") == [
        "--set agent.seed=-4: [agent] seed: expected an integer >= 0, not -4",
        "--set task.ScanTarget.strat=true: [task.ScanTarget] strat: unknown key, did you mean 'start'?",
    ]


def test_a_mistyped_name_is_answered_with_the_one_in_the_file():
    assert faults("task.ScanTargt.start=false") == [
        "--set task.ScanTargt.start=false: [task.ScanTargt] type: is missing, did you mean 'ScanTarget'?"
    ]
    assert faults("service.netwrk.settings.sleep=1") == [
        "--set service.netwrk.settings.sleep=1: [service.netwrk] type: is missing, did you mean 'network'?"
    ]


def test_a_table_that_was_replaced_has_no_lines_any_more():
    assert faults("task.ScanTarget={ typ = 'x' }") == [
        "--set task.ScanTarget={ typ = 'x' }: [task.ScanTarget] typ: unknown key, did you mean 'type'?",
        "--set task.ScanTarget={ typ = 'x' }: [task.ScanTarget] type: is missing",
    ]


def test_the_file_is_still_named_for_what_it_says():
    with pytest.raises(ConfigError) as error:
        parse(TEXT + "rate_hz = -1\n", "a.toml", ["agent.seed=x"])
    assert [fault.where for fault in error.value.faults] == ["a.toml:9", "--set agent.seed=x"]


@pytest.mark.parametrize("text", ["", "agent.name", "=1", "agent..name=1", "agent.name:1", 'agent."\\q"=1'])
def test_what_is_no_override(text: str):
    wanted = "is not an override: write it as table.key=value, such as clock.speed=5"
    assert faults(text) == [f"--set {text}: --set: {wanted}"]


def test_a_value_has_no_keys_in_it():
    assert faults("agent.name.first=x") == [
        "--set agent.name.first=x: [agent] name.first: [agent] name is a value and has no keys in it"
    ]
