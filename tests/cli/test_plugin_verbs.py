"""`pancakes plugin list`: the installed plug-ins, and which of them are broken."""

import json

from cli.invoked import invoked
from cli.processes import Rig


def test_plugin_list_shows_distributions():
    result = invoked("plugin", "list", "--format", "json")
    assert result.exit_code == 0, result.output
    row = next(row for row in json.loads(result.stdout) if row["name"] == "host.load")
    assert row.pop("version")
    assert row == {
        "group": "drivers",
        "name": "host.load",
        "class": "pancakes.devices.builtin_drivers:HostProcessorLoad",
        "distribution": "pancakes-agents",
        "state": "ok",
        "reason": "",
    }

    some = invoked("plugin", "list", "--group", "services", "--group", "transports", "--format", "json")
    rows = json.loads(some.stdout)
    assert {row["group"] for row in rows} == {"services", "transports"}
    names = [row["name"] for row in rows if row["distribution"] == "pancakes-agents"]
    assert names == ["client", "device", "log", "metrics", "network", "traces", "local", "tcp"]


def test_plugin_list_shows_broken_plugins_with_reasons(rig: Rig):
    rig.install("broken", "[pancakes.tasks]\nbroken.Task = plugin_broken:Task\n", "import there_is_no_such_module\n")
    for name in ("one", "two"):
        rig.install(name, f"[pancakes.costs]\nsame = plugin_{name}:Cost\n", "class Cost: pass\n")

    result = rig.pancakes("plugin", "list", "--broken", "--format", "json")
    assert result.returncode == 1
    rows = {row["distribution"]: row for row in json.loads(result.stdout)}
    broken = rows["broken"]
    assert (broken["group"], broken["name"], broken["state"]) == ("tasks", "broken.Task", "broken")
    assert (broken["version"], broken["class"]) == ("1.0", "plugin_broken:Task")
    assert "ModuleNotFoundError: No module named 'there_is_no_such_module'" in broken["reason"]
    assert [rows[name]["name"] for name in ("one", "two")] == ["same", "same"], "offered twice, it is broken for both"
