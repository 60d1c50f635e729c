"""`pancakes config ...`: files are checked before anything runs, and shown as an agent will take them."""

import json
import tomllib

import msgspec
import pytest
from cli.processes import Rig

from pancakes.runtime.life.restart import RestartSpec

BAD = "[clock]\nsped = 1\n[device.x]\ndriver = 'host.lod'\n"


def test_several_files_and_folders_are_checked_at_once(rig: Rig):
    good, bad = rig.config("a"), rig.config("b", BAD)
    (rig.directory / "folder").mkdir()
    rig.config("c", file="folder/c.toml")

    result = rig.pancakes("config", "check", str(good), str(bad), "folder", "xyz")

    assert result.returncode == 4
    assert result.stdout.splitlines() == [
        f"{good} is sound: the agent a of the fleet test",
        "folder/c.toml is sound: the agent c of the fleet test",
    ]
    assert result.stderr.splitlines() == [
        f"{bad}:9: [clock] sped: unknown key, did you mean 'speed'?",
        f"{bad}:11: [device.x] driver: unknown driver 'host.lod', did you mean 'host.load'?",
        "xyz: file: there is no such file",
    ]


def test_the_result_for_programs(rig: Rig):
    result = rig.pancakes("config", "check", str(rig.config("a")), str(rig.config("b", BAD)), "--format", "json")

    good, bad = json.loads(result.stdout)
    assert (good["agent"], good["fleet"], good["faults"]) == ("a", "test", [])
    assert [(fault["key"], fault["suggestion"]) for fault in bad["faults"]] == [
        ("[clock] sped", "speed"),
        ("[device.x] driver", "host.load"),
    ]


def test_what_is_sound_is_exit_code_0(rig: Rig):
    assert rig.pancakes("config", "check", str(rig.config("a"))).returncode == 0


def test_a_fleet_file_is_checked_with_the_files_that_it_names(rig: Rig):
    rig.config("a")
    (rig.directory / "fleet.toml").write_text(
        "schema = 1\n[fleet]\nname = 'f'\n[agent.a]\n[agent.b]\nconfig = 'a.toml'\n"
    )

    result = rig.pancakes("config", "check", "fleet.toml")

    assert result.returncode == 0
    assert result.stdout.splitlines() == [
        "a.toml is sound: the agent a of the fleet f",
        "a.toml is sound: the agent b of the fleet f",
    ]


TASKS = {
    "module": ("import there_is_no_such_module\n", "ModuleNotFoundError: No module named 'there_is_no_such_module'"),
    "attribute": ("class Others: pass\n", "AttributeError: module 'plugin_broken' has no attribute 'Task'"),
    "chain": (
        "try:\n    import there_is_no_such_module\nexcept ImportError as error:\n"
        "    raise RuntimeError('no camera') from error\n",
        "RuntimeError: no camera (plugin_broken.py:4), because of ModuleNotFoundError: No module named"
        " 'there_is_no_such_module' (plugin_broken.py:2)",
    ),
    "kind": ("class Task: pass\n", "'broken.Task' is no task but the class Task"),
    "class": (
        "from pancakes import task\nclass Task(task.Task):\n    @task.every(hz=1)\n    async def go(self, t): ...\n",
        "plugin_broken.py:4: Task.go is `async def`",
    ),
}


@pytest.mark.parametrize(("source", "reason"), TASKS.values(), ids=TASKS)
def test_a_plugin_that_the_file_names_and_that_cannot_be_loaded_is_wrong(rig: Rig, source: str, reason: str):
    rig.install("broken", "[pancakes.tasks]\nbroken.Task = plugin_broken:Task\n", source)
    path = str(rig.config("a", '[task.X]\ntype = "broken.Task"\n'))

    checked = rig.pancakes("config", "check", path)
    agent = rig.agent(path, "--check")

    assert checked.returncode == agent.ended() == 4
    for said in (checked.stderr, agent.everything()):
        (line,) = [line for line in said.splitlines() if "broken.Task" in line]
        assert "[task.X] type: " in line
        assert reason in line
        assert "Traceback" not in said
        assert "warning" not in said


def test_a_plugin_that_no_file_names_is_a_warning(rig: Rig):
    rig.install("broken", "[pancakes.packets]\nbroken = plugin_broken\n", "import there_is_no_such_module\n")

    result = rig.pancakes("config", "check", str(rig.config("a")))

    assert result.returncode == 0
    assert "warning: the packet module 'broken' of broken 1.0" in result.stderr


def test_a_plugin_that_is_not_installed_is_told_so_and_nothing_far_away_is_suggested(rig: Rig):
    result = rig.pancakes("config", "check", str(rig.config("a", '[task.X]\ntype = "foo.Bar"\n')))

    assert result.returncode == 4
    assert result.stderr.splitlines()[0].endswith(
        "[task.X] type: unknown task type 'foo.Bar': no installed distribution provides tasks under 'foo.'"
    )


def test_the_effective_configuration_can_be_run(rig: Rig):
    path = rig.config("a", '[device.load]\ndriver = "host.load"\nrate_hz = 2\n')

    result = rig.pancakes("config", "show", str(path), "--set", "clock.speed=5")

    shown = tomllib.loads(result.stdout)
    assert shown["clock"] == {"speed": 5.0, "hold": False, "join_s": 1.0}
    assert shown["device"]["load"]["restart"] == msgspec.structs.asdict(RestartSpec(again_s=60.0))
    assert "speed = 5.0 # --set clock.speed=5" in result.stdout.splitlines()
    assert f"rate_hz = 2.0 # {path}:10" in result.stdout.splitlines()
    (rig.directory / "shown.toml").write_text(result.stdout)
    assert rig.pancakes("config", "check", "shown.toml").returncode == 0


def test_where_each_value_was_said_for_programs(rig: Rig):
    rows = json.loads(rig.pancakes("config", "show", str(rig.config("a")), "--format", "json").stdout)

    found = {row["key"]: (row["value"], row["from"]) for row in rows}
    assert found["agent.name"] == ("a", f"{rig.directory}/a.toml:4")
    assert found["clock.speed"] == (1.0, "default")
    assert "agent.seed" not in found  # it has no value


def test_a_bad_configuration_is_not_shown(rig: Rig):
    result = rig.pancakes("config", "show", str(rig.config("b", BAD)))

    assert (result.returncode, result.stdout) == (4, "")


def test_the_schema(rig: Rig):
    schema = json.loads(rig.pancakes("config", "schema").stdout)
    assert schema["required"] == ["schema", "agent"]
    assert "enum" not in schema["properties"]["task"]["additionalProperties"]["properties"]["type"]

    schema = json.loads(rig.pancakes("config", "schema", "--plugins").stdout)
    assert "host.load" in schema["properties"]["device"]["additionalProperties"]["properties"]["driver"]["enum"]

    assert json.loads(rig.pancakes("config", "schema", "--fleet").stdout)["required"] == ["schema", "fleet", "agent"]
    assert rig.pancakes("config", "schema", "--fleet", "--plugins").returncode == 2


def test_all_keys_as_a_table(rig: Rig):
    lines = [line.split() for line in rig.pancakes("config", "schema", "--format", "table").stdout.splitlines()]

    assert next(line for line in lines if line[:2] == ["[clock]", "speed"])[2:4] == ["number", "1.0"]
    assert ["[task.NAME]", "migrate.below", "number"] in [line[:3] for line in lines]


@pytest.mark.parametrize("verb", ["check", "schema", "show"])
def test_each_verb_has_help_with_an_example(rig: Rig, verb: str):
    assert f"pancakes config {verb}" in rig.pancakes("config", verb, "--help").stdout.partition("Example:")[2]
