"""`pancakes config ...`: check files before anything runs, and show the effective configuration."""

import json
import tomllib

import msgspec
import pytest
from cli.invoked import invoked
from cli.processes import Rig

from pancakes.supervision.restart import RestartSpec

BAD = "[clock]\nsped = 1\n[device.x]\ndriver = 'host.lod'\n"


@pytest.fixture(autouse=True)
def in_its_directory(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(rig.directory)


def test_config_check_takes_files_and_folders(rig: Rig):
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

    shown = json.loads(invoked("config", "check", str(good), str(bad), "--format", "json").stdout)
    assert (shown[0]["agent"], shown[0]["fleet"], shown[0]["faults"]) == ("a", "test", [])
    assert [(fault["key"], fault["suggestion"]) for fault in shown[1]["faults"]] == [
        ("[clock] sped", "speed"),
        ("[device.x] driver", "host.load"),
    ]
    assert invoked("config", "check", str(good)).exit_code == 0


def test_config_check_of_a_fleet_file_checks_its_agents(rig: Rig):
    rig.config("a")
    (rig.directory / "fleet.toml").write_text(
        "schema = 1\n[fleet]\nname = 'f'\n[agent.a]\n[agent.b]\nconfig = 'a.toml'\n"
    )
    result = invoked("config", "check", "fleet.toml")
    assert result.exit_code == 0
    assert result.stdout.splitlines() == [
        "a.toml is sound: the agent a of the fleet f",
        "a.toml is sound: the agent b of the fleet f",
    ]


TASKS = {
    "module": ("import there_is_no_such_module\n", "ModuleNotFoundError: No module named 'there_is_no_such_module'"),
    "attribute": ("class Others: pass\n", "AttributeError: module 'plugin_attribute' has no attribute 'Task'"),
    "chain": (
        "try:\n    import there_is_no_such_module\nexcept ImportError as error:\n"
        "    raise RuntimeError('no camera') from error\n",
        "RuntimeError: no camera (plugin_chain.py:4), because of ModuleNotFoundError: No module named"
        " 'there_is_no_such_module' (plugin_chain.py:2)",
    ),
    "kind": ("class Task: pass\n", "'kind.Task' is not a task but the class Task"),
    "class": (
        "from pancakes import task\nclass Task(task.Task):\n    @task.every(hz=1)\n    def go(self): ...\n",
        "plugin_class.py:4: Task.go takes (self)",
    ),
}


def test_config_check_reports_plugins_that_cannot_be_loaded(rig: Rig):
    """A broken plug-in that the file names is a fault, also for `pancakes-agent --check`; others are warnings."""
    rig.install("broken", "[pancakes.packets]\nbroken = plugin_broken\n", "import there_is_no_such_module\n")
    other = rig.pancakes("config", "check", str(rig.config("b")))
    assert other.returncode == 0 and "warning: the packet module 'broken' of broken 1.0" in other.stderr

    for name, (source, _) in TASKS.items():
        rig.install(name, f"[pancakes.tasks]\n{name}.Task = plugin_{name}:Task\n", source)
    path = rig.config("a", "".join(f'[task.X{name}]\ntype = "{name}.Task"\n' for name in TASKS))
    checked = rig.pancakes("config", "check", str(path))
    agent = rig.agent(path, "--check")
    assert checked.returncode == agent.ended() == 4
    for said in (checked.stderr, agent.everything()):
        assert "Traceback" not in said
        for name, (_, reason) in TASKS.items():
            (line,) = [line for line in said.splitlines() if f"[task.X{name}] type: " in line]
            assert reason in line and "warning" not in line


def test_config_show_prints_a_valid_configuration(rig: Rig):
    path = rig.config("a", '[device.load]\ndriver = "host.load"\nrate_hz = 2\n')
    result = rig.pancakes("config", "show", str(path), "--set", "clock.speed=5")
    shown = tomllib.loads(result.stdout)
    assert shown["clock"] == {"speed": 5.0, "hold": False, "join_s": 1.0}
    assert shown["device"]["load"]["restart"] == msgspec.structs.asdict(RestartSpec(again_s=60.0))
    assert "speed = 5.0 # --set clock.speed=5" in result.stdout.splitlines()
    assert f"rate_hz = 2.0 # {path}:10" in result.stdout.splitlines()
    (rig.directory / "shown.toml").write_text(result.stdout)
    assert invoked("config", "check", "shown.toml").exit_code == 0

    rows = json.loads(invoked("config", "show", str(path), "--format", "json").stdout)
    found = {row["key"]: (row["value"], row["from"]) for row in rows}
    assert found["agent.name"] == ("a", f"{path}:4")
    assert found["clock.speed"] == (1.0, "default")
    assert "agent.seed" not in found, "it has no value"
    missing = rig.pancakes("config", "show", "lmp")
    assert missing.returncode == 3 and missing.stderr.endswith("\nthe file 'lmp' does not exist either\n")
    bad = invoked("config", "show", str(rig.config("b", BAD)))
    assert (bad.exit_code, bad.stdout) == (4, "")


def test_config_schema_is_json_or_a_table():
    schema = json.loads(invoked("config", "schema").stdout)
    assert schema["required"] == ["schema"] and schema["then"]["required"] == ["agent"]
    assert "enum" not in schema["properties"]["task"]["additionalProperties"]["properties"]["type"]
    schema = json.loads(invoked("config", "schema", "--plugins").stdout)
    driver = schema["properties"]["device"]["additionalProperties"]["properties"]["driver"]
    assert "host.load" in driver["anyOf"][0]["enum"], "a variable may stand there too"
    assert json.loads(invoked("config", "schema", "--fleet").stdout)["then"]["required"] == ["fleet", "agent"]

    lines = [line.split() for line in invoked("config", "schema", "--format", "table").stdout.splitlines()]
    assert next(line for line in lines if line[:2] == ["[clock]", "speed"])[2:4] == ["number", "1.0"]
    assert ["[task.NAME]", "migrate.below", "number"] in [line[:3] for line in lines]
    assert next(line for line in lines if line[:2] == ["[device.NAME]", "driver"])[2:4] == ["text", "required"]
    assert ["extends", "text"] in [line[:2] for line in lines]


def test_config_check_of_remote_agents_skips_missing_plugins(rig: Rig):
    fleet = rig.directory / "fleet.toml"
    fleet.write_text('schema = 1\n[fleet]\nname = "test"\n[agent.a]\nhost = "pi@robot1"\n')
    known = '[device.load]\ndriver = "host.load"\nrate_hz = 2\nsettings = { wrong = 1 }\n'
    unknown = '[task.Walk]\ntype = "yard.Walk"\nsettings = { legs = 4 }\n[device.x]\ndriver = "host.lod"\n'
    path = rig.config("a", known + unknown, agent='peers = ["carrier://b:1"]')
    result = rig.pancakes("config", "check", str(fleet))
    assert (result.returncode, result.stdout) == (4, "")
    assert f"{path}" in result.stderr and "[device.load] settings.wrong: unknown key" in result.stderr
    assert len(result.stderr.splitlines()) == 1

    rig.config("a", unknown, agent='peers = ["carrier://b:1"]')
    result = rig.pancakes("config", "check", str(fleet))
    but = "except carrier://, host.lod, yard.Walk (not installed here, so not checked)"
    assert (result.returncode, result.stdout.splitlines()) == (
        0,
        [f"{path} is sound, {but}: the agent a of the fleet test"],
    )
