"""`pancakes plugin list`: everything that is installed for agents, and what of it is broken."""

import json

from cli.processes import Rig


def test_every_plugin_is_listed_with_who_offers_it(rig: Rig):
    result = rig.pancakes("plugin", "list", "--format", "json")

    assert result.returncode == 0, result.stdout
    row = next(row for row in json.loads(result.stdout) if row["name"] == "host.load")
    assert row.pop("version")
    assert row == {
        "group": "drivers",
        "name": "host.load",
        "class": "pancakes.bodies.devices.host:HostProcessorLoad",
        "distribution": "pancakes-agents",
        "state": "ok",
        "reason": "",
    }


def test_what_is_broken_is_named_with_the_reason(rig: Rig):
    rig.install("broken", "[pancakes.tasks]\nbroken.Task = plugin_broken:Task\n", "import there_is_no_such_module\n")

    result = rig.pancakes("plugin", "list", "--broken", "--format", "json")

    assert result.returncode == 1
    (row,) = json.loads(result.stdout)
    assert (row["group"], row["name"], row["state"]) == ("tasks", "broken.Task", "broken")
    assert (row["distribution"], row["version"], row["class"]) == ("broken", "1.0", "plugin_broken:Task")
    assert "ModuleNotFoundError: No module named 'there_is_no_such_module'" in row["reason"]


def test_what_two_distributions_offer_is_broken_for_both(rig: Rig):
    for name in ("one", "two"):
        rig.install(name, f"[pancakes.costs]\nsame = plugin_{name}:Cost\n", "class Cost: pass\n")

    rows = json.loads(rig.pancakes("plugin", "list", "--group", "costs", "--broken", "--format", "json").stdout)

    assert [(row["name"], row["distribution"]) for row in rows] == [("same", "one"), ("same", "two")]
    assert all("is offered twice, by one (plugin_one:Cost) and two (plugin_two:Cost)" in row["reason"] for row in rows)


def test_only_some_groups(rig: Rig):
    result = rig.pancakes("plugin", "list", "--group", "services", "--group", "transports", "--format", "json")

    rows = json.loads(result.stdout)
    assert {row["group"] for row in rows} == {"services", "transports"}
    names = [row["name"] for row in rows if row["distribution"] == "pancakes-agents"]
    assert names == ["client", "device", "log", "metrics", "network", "local", "tcp"]
    assert rig.pancakes("plugin", "list", "--group", "thing").returncode == 2


def test_its_help_has_an_example(rig: Rig):
    assert "pancakes plugin list" in rig.pancakes("plugin", "list", "--help").stdout.partition("Example:")[2]
