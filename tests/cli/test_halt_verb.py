"""`pancakes halt`: a person halts a fleet, sees that it is halted, and ends it."""

from __future__ import annotations

import json
from typing import Any

from cli.processes import Rig

MOTORS = '[device.motors]\ndriver = "null.motors"\n'


def rows(text: str) -> list[tuple[str, str, list[str]]]:
    return [(row["agent"], row["done"], row["stopped"]) for row in json.loads(text)]


def halt_of(rig: Rig, agent: str) -> Any:
    (found,) = json.loads(rig.pancakes("agent", "info", agent, "--format", "json").stdout)
    return found["halt"]


def test_halt_stays_over_a_restart_until_its_end(rig: Rig):
    first = rig.ready("a", MOTORS)
    rig.ready("b", MOTORS, agent=f'peers = ["{rig.address(first)}"]')
    result = rig.pancakes("halt", "--dry-run", "--format", "json")
    assert rows(result.stdout) == [("a", "dry run", ["motors"]), ("b", "dry run", ["motors"])]
    assert halt_of(rig, "a") is None
    result = rig.pancakes("halt", "--reason", "a child on the field", "--format", "json")
    assert (result.returncode, result.stderr) == (0, "")
    assert rows(result.stdout) == [("a", "halted", ["motors"]), ("b", "halted", ["motors"])]
    assert {row["reason"] for row in json.loads(result.stdout)} == {"a child on the field"}
    assert rig.pancakes("down", "b").returncode == 0
    rig.ready("b", MOTORS)
    table = rig.pancakes("task", "list", "b").stdout
    assert any("motors" in line and "halted" in line for line in table.splitlines())
    assert "a child on the field" in rig.pancakes("agent", "info", "b").stdout

    found = json.loads(rig.pancakes("doctor", "--no-machine", "--format", "json").stdout)
    about = [it for it in found if "is halted" in it["text"]]
    assert [(it["about"], it["level"]) for it in about] == [("a", "warning"), ("b", "warning")]
    assert "a child on the field" in about[0]["text"] and about[0]["advice"].endswith("pancakes halt --end")

    result = rig.pancakes("halt", "--end")
    assert result.returncode == 1 and "the actuators of a, b may move at once. Pass --yes" in result.stderr
    assert halt_of(rig, "a") and halt_of(rig, "b")
    result = rig.pancakes("halt", "--end", "--yes", "--format", "json")
    assert (result.returncode, rows(result.stdout)) == (0, [("a", "ended", ["motors"]), ("b", "ended", ["motors"])])
    assert halt_of(rig, "a") is None and halt_of(rig, "b") is None
    result = rig.pancakes("halt", "--end", "--yes")
    assert result.returncode == 1 and "a is not halted" in result.stderr
    assert rig.pancakes("halt", "--end", "--reason", "x").returncode == 2


def test_halt_of_one_agent_leaves_the_others(rig: Rig):
    first = rig.ready("a", MOTORS)
    rig.ready("b", MOTORS, agent=f'peers = ["{rig.address(first)}"]')
    result = rig.pancakes("halt", "b", "--format", "json")
    assert rows(result.stdout) == [("b", "halted", ["motors"])]
    assert halt_of(rig, "a") is None and halt_of(rig, "b") is not None
    result = rig.pancakes("halt", "c")
    assert result.returncode == 3 and "there is no agent 'c'" in result.stderr
