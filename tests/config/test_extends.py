"""Files that extend others, and variables: what a configuration comes to, and where each fault is."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from seeded import for_each

from pancakes.config import Config, load, parse
from pancakes.config.effective import origin
from pancakes.config.schema import allowing_variables, config_schema
from pancakes.config.toml_reader import MOST_FILES, self_contained
from pancakes.errors import ConfigError
from pancakes.util.toml import toml_values

COMMON = """\
schema = 1

[vars]
gateway = "10.0.0.5"
url = "tcp://${gateway}:7401"
hz = 5

[agent]
fleet = "field"
peers = ["${url}", "local://camera"]

[device.load]
driver = "host.load"
rate_hz = "${hz}"
restart = { at_most = 3, pause_s = 1.0 }
"""
ROBOT = """\
schema = 1
extends = "common.toml"

[agent]
name = "r1"

[device.load]
restart = { pause_s = 2.0 }
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "common.toml").write_text(COMMON)
    (tmp_path / "r1.toml").write_text(ROBOT)
    return tmp_path


def faults(folder: Path, text: str, *sets: str) -> list[str]:
    (folder / "x.toml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        load(folder / "x.toml", sets)
    return [str(fault).replace(f"{folder}/", "") for fault in caught.value.faults]


def places(config: Config, folder: Path, *keys: tuple[str, ...]) -> list[str]:
    return [origin(config, key).replace(f"{folder}/", "") for key in keys]


def test_tables_of_both_files_are_merged(folder: Path):
    config = load(folder / "r1.toml")
    assert (config.agent.name, config.agent.fleet) == ("r1", "field")
    assert config.agent.peers == ("tcp://10.0.0.5:7401", "local://field/camera")
    load_ = config.devices["load"]
    assert (load_.driver, load_.rate_hz) == ("host.load", 5.0)
    assert (load_.restart.at_most, load_.restart.pause_s) == (3, 2.0)


def test_list_of_the_own_file_replaces_the_other(folder: Path):
    text = ROBOT.replace('name = "r1"', 'name = "r1"\npeers = ["tcp://10.0.0.9:7401"]')
    (folder / "r1.toml").write_text(text)
    assert load(folder / "r1.toml").agent.peers == ("tcp://10.0.0.9:7401",)


def test_origin_names_file_and_variables(folder: Path):
    config = load(folder / "r1.toml", ("vars.hz=2",))
    assert config.devices["load"].rate_hz == 2.0
    assert places(
        config,
        folder,
        ("agent", "name"),
        ("agent", "fleet"),
        ("agent", "peers"),
        ("agent", "role"),
        ("device", "load", "rate_hz"),
        ("device", "load", "restart", "pause_s"),
        ("device", "load", "restart", "at_most"),
    ) == [
        "r1.toml:5",
        "common.toml:9",
        "common.toml:10 (url: common.toml:5, gateway: common.toml:4)",
        "default",
        "common.toml:14 (hz: --set vars.hz=2)",
        "r1.toml:8",
        "common.toml:15",
    ]


def test_faults_name_the_file_that_has_the_key(folder: Path):
    text = ROBOT.replace('name = "r1"', 'name = "r1"\nrolle = "agent"') + "[vars]\nhz = -1\n"
    (folder / "common.toml").write_text(COMMON.replace("pause_s = 1.0", 'policy = "permanent"'))
    assert faults(folder, text) == [
        "x.toml:6: [agent] rolle: unknown key, did you mean 'role'?",
        "common.toml:14 (hz: x.toml:11): [device.load] rate_hz: expected a number >= 0, not -1",
        (
            "common.toml:15: [device.load] restart.policy: expected one of 'no', 'on-failure', 'always',"
            " not 'permanent', did you mean 'always'?"
        ),
    ]


def test_broken_lines_of_both_files_are_told_at_once(folder: Path):
    (folder / "common.toml").write_text(COMMON.replace("hz = 5", "hz = five"))
    found = faults(folder, ROBOT.replace('name = "r1"', "name = r1"))
    assert [fault.partition(": ")[0] for fault in found] == ["x.toml:5", "common.toml:6"]


def test_replaced_list_of_tables_has_no_lines_of_the_other(folder: Path):
    (folder / "common.toml").write_text('schema = 1\n[[access.allow]]\nwho = ["a"]\nmay = ["look"]\n')
    own = '[[access.allow]]\nwho = ["b"]\n'
    assert faults(folder, ROBOT[: ROBOT.index("[device")] + own) == [
        "x.toml:7: [access] allow[0].may: is missing",
    ]


def test_extended_file_that_cannot_be_read_is_named(folder: Path):
    (folder / "d").mkdir()

    def check(case: tuple[str, str]) -> None:
        written, problem = case
        assert faults(folder, f"schema = 1\nextends = {written}\n") == [f"x.toml:2: extends: {problem}"]

    for_each(
        [
            ('"commn.toml"', "commn.toml: there is no such file, did you mean 'common.toml'?"),
            ('"d"', "d: is a directory, not a file"),
            ('""', "expected the path of a file, such as 'common.toml', not ''"),
            ('["common.toml"]', "expected the path of a file, such as 'common.toml', not ['common.toml']"),
            ('"x.toml"', "the files extend one another in a circle: x.toml → x.toml"),
            (
                '"$HOME/x.toml"',
                "has $HOME in it, which is not expanded: write `~` for the home folder, or the whole path",
            ),
        ],
        check,
    )


def test_circle_over_two_files_is_refused(folder: Path):
    (folder / "y.toml").write_text('schema = 1\nextends = "x.toml"\n')
    assert faults(folder, 'schema = 1\nextends = "y.toml"\n') == [
        "y.toml:2: extends: the files extend one another in a circle: x.toml → y.toml → x.toml"
    ]


def test_chain_of_files_has_an_end(folder: Path):
    for number in range(MOST_FILES + 1):
        (folder / f"{number}.toml").write_text(f'schema = 1\nextends = "{number + 1}.toml"\n')
    (found,) = faults(folder, 'schema = 1\nextends = "1.toml"\n')
    assert found.endswith(f"more than {MOST_FILES} files extend one another")


def test_extended_file_states_its_schema(folder: Path):
    (folder / "common.toml").write_text("[clock]\nspeed = 2.0\n")
    assert faults(folder, ROBOT[: ROBOT.index("[device")]) == ["common.toml: schema: is missing: write schema = 1"]


HEAD = 'schema = 1\n[agent]\nname = "a"\n'


def test_variable_keeps_its_type():
    text = HEAD + (
        '[vars]\nrate = 2.5\nflag = true\nlist = ["local://b"]\ntable = { at_most = 1 }\nn = 3\n'
        '[clock]\nhold = "${flag}"\nspeed = "${rate}"\n'
        '[task.T]\ntype = "x"\nrestart = "${table}"\nsettings = { file = "run-${n}-${flag}.csv", raw = "$${n} $n" }\n'
    )
    config = parse(text.replace('name = "a"', 'name = "a"\npeers = "${list}"'), "a.toml")
    assert (config.clock.hold, config.clock.speed, config.agent.peers) == (True, 2.5, ("local://b",))
    assert config.tasks["T"].restart.at_most == 1
    assert config.tasks["T"].settings == {"file": "run-3-true.csv", "raw": "${n} $n"}


def test_faults_of_variables_say_what_to_write():
    def check(case: tuple[str, str]) -> None:
        given, problem = case
        with pytest.raises(ConfigError) as caught:
            parse(HEAD + given, "a.toml")
        assert [str(fault) for fault in caught.value.faults] == problem.splitlines()

    only = "define it in [vars] (the environment is not read)"
    for_each(
        [
            ('fleet = "${HOME}"', f"a.toml:4: [agent] fleet: there is no variable 'HOME': {only}"),
            (
                'fleet = "${flet}"\n[vars]\nfleet = "x"',
                f"a.toml:4: [agent] fleet: there is no variable 'flet', only fleet: {only}, did you mean 'fleet'?",
            ),
            (
                'fleet = "x-${a"',
                "a.toml:4: [agent] fleet: has ${ without }: write ${NAME} for a variable, and $${ for the text ${",
            ),
            (
                'fleet = "${a b}"',
                "a.toml:4: [agent] fleet: ${a b} is no variable: write ${NAME}, and $${ for the text ${",
            ),
            (
                'fleet = "x${a}"\n[vars]\na = ["b"]',
                "a.toml:4 (a: a.toml:6): [agent] fleet: the variable 'a' is a list, which cannot be a part of text",
            ),
            (
                'fleet = "${a}"\n[vars]\na = "${b}"\nb = "${a}"',
                "a.toml:4 (a: a.toml:6, b: a.toml:7): [agent] fleet: needs the variable 'a', which has no value\n"
                "a.toml:6 (b: a.toml:7): [vars] a: needs the variable 'b', which has no value\n"
                "a.toml:7 (a: a.toml:6): [vars] b: its variables are defined by one another, in a circle: a → b → a",
            ),
            (
                '[vars]\n"a b" = 1',
                'a.toml:5: [vars] "a b": is no name of a variable: a letter or _, then letters, digits, _ and -',
            ),
            ("[clock]\nspeed = 2\n[[vars]]\na = 1", "a.toml:6: [vars]: expected a table: [vars]"),
        ],
        check,
    )


def test_self_contained_text_means_the_same(folder: Path):
    text = self_contained(str(folder / "r1.toml"), ('vars.gateway="10.0.0.7"',))
    assert "extends" not in toml_values(text)
    assert parse(text, "there.toml").agent.peers == ("tcp://10.0.0.7:7401", "local://field/camera")
    alone = parse(text, "there.toml").devices
    assert alone == load(folder / "r1.toml").devices


def test_text_that_extends_nothing_stays_as_it_is(folder: Path):
    (folder / "common.toml").write_text("# a comment\n" + COMMON)
    assert self_contained(str(folder / "common.toml")) == "# a comment\n" + COMMON


def test_schema_allows_variables_for_each_value():
    def takes(part: dict[str, Any]) -> bool:
        return {"type": "string", "pattern": r"\$\{"} in part.get("anyOf", ()) or part.get("type") == "string"

    tables = allowing_variables(config_schema())["properties"]
    assert all(takes(part) for part in tables["agent"]["properties"].values())
    assert all(takes(part) for part in tables["device"]["additionalProperties"]["properties"].values())


@pytest.mark.parametrize("mark", ["{}", "[{}]"])
def test_variables_that_would_fill_the_memory(folder: Path, mark: str):
    each = ['"' + f"${{a{i}}}" * 10 + '"' if mark == "{}" else "[" + f'"${{a{i}}}", ' * 10 + "]" for i in range(30)]
    lines = "\n".join(f"a{i + 1} = {value}" for i, value in enumerate(each))
    text = f'schema = 1\n[vars]\na0 = "aaaaaaaaaa"\n{lines}\n[agent]\nname = "${{a30}}"\n'
    assert any("come to more than 1,048,576 characters" in fault for fault in faults(folder, text))


def test_variables_that_are_nested_too_deeply(folder: Path):
    lines = "\n".join(f'a{i + 1} = "${{a{i}}}"' for i in range(2000))
    text = f'schema = 1\n[vars]\na0 = "r1"\n{lines}\n[agent]\nname = '
    assert any("more than 32 variables are nested" in it for it in faults(folder, text + '"${a2000}"'))
    (folder / "x.toml").write_text(text + '"${a31}"')
    assert load(folder / "x.toml").agent.name == "r1"


def test_extends_what_is_no_regular_file(folder: Path):
    os.mkfifo(folder / "pipe")
    for name in ("pipe", "/dev/zero"):
        (found,) = faults(folder, f'schema = 1\nextends = "{name}"\n[agent]\nname = "r1"\n')
        assert found == f"x.toml:2: extends: {name}: is not a regular file"


def test_file_without_end():
    with pytest.raises(ConfigError, match="/dev/zero: file: has more than 4,194,304 bytes"):
        load("/dev/zero")


def test_set_cannot_extend(folder: Path):
    (found,) = faults(folder, COMMON, "extends=r1.toml", "agent.name=r1")
    assert found == "--set extends=r1.toml: extends: belongs in a file: --set changes single values of it"
