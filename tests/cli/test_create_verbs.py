"""`pancakes task create|remove` and `config show AGENT`, on agents that run."""

import json
import signal
from typing import Any

from cli.processes import Rig

SOURCE = """
from dataclasses import dataclass
from pancakes.task import Task, every

class Count(Task):
    @dataclass
    class Settings:
        step: int = 1

    @dataclass
    class State:
        n: int = 0

    @every(hz=20)
    def tick(self, tick):
        self.state.n += self.settings.step
        self.event("counted", n=self.state.n)
"""
ENTRY_POINTS = "[pancakes.tasks]\ncount.Count = plugin_count:Count\n"


def rows(rig: Rig, *arguments: str) -> list[dict[str, Any]]:
    """Runs a command that does what it is asked, and returns what it printed as JSON."""
    result = rig.pancakes(*arguments, "--format", "json")
    assert result.returncode == 0, result.stderr
    found: list[dict[str, Any]] = json.loads(result.stdout)
    return found


def test_a_task_is_created_outlives_its_agent_is_kept_in_a_file_and_removed(rig: Rig):
    rig.install("count", ENTRY_POINTS, SOURCE)
    first = rig.ready("a")
    options = ("--type", "count.Count", "--set", "step=100", "--rate", "40", "--key", "restart.policy=temporary")
    (row,) = rows(rig, "task", "create", "a/Count", *options)
    assert (row["task_id"], row["epoch"], row["done"]) == ("a/Count", 1, "created")
    first.hear("counted n=200")
    again = rig.pancakes("task", "create", "a/Count", *options)
    assert (again.returncode, again.stderr) == (
        1,
        "a/client/Count is there already, and running: choose another name\n",
    )
    wrong = rig.pancakes("task", "create", "a/Other", "--type", "count.Count", "--set", "stepp=1", "--dry-run")
    assert (wrong.returncode, wrong.stderr) == (1, "[task.Other] settings.stepp: unknown key, did you mean 'step'?\n")

    first.signalled(signal.SIGKILL)
    second = rig.ready("a")
    second.hear("counted n=")
    (info,) = rows(rig, "task", "info", "a/Count")
    assert (info["settings"], info["rate_hz"], info["restart"]["policy"]) == ({"step": 100}, 40.0, "temporary")
    told = " ".join(rig.pancakes("task", "info", "a/Count").stdout.split())
    assert info["created"] and " in a file no: it was created " in told

    shown = rig.pancakes("config", "show", "a")
    assert f'name = "a" # {rig.directory}/a.toml:' in shown.stdout and "again_s = 0.0 # default" in shown.stdout
    assert '[task.Count]\ntype = "count.Count" # created on a\n' in shown.stdout, shown.stderr
    kept = rig.directory / "kept.toml"
    kept.write_text(shown.stdout)
    assert rig.pancakes("config", "check", str(kept)).returncode == 0
    second.signalled(signal.SIGTERM)
    third = rig.agent(kept)
    third.hear("counted n=")
    refused = rig.pancakes("task", "remove", "a/Count")
    assert refused.returncode == 1 and "take [task.Count] out of its file" in refused.stderr
    third.signalled(signal.SIGTERM)

    rig.ready("a")
    (row,) = rows(rig, "task", "remove", "a/Count")
    assert (row["task"], row["done"]) == ("Count", "removed")
    assert [row["task"] for row in rows(rig, "task", "list") if row["type"] == "count.Count"] == []
    assert "task.Count" not in rig.pancakes("config", "show", "a").stdout


def test_a_created_task_that_has_moved_is_removed_where_it_is(rig: Rig):
    rig.install("count", ENTRY_POINTS, SOURCE)
    first = rig.ready("a")
    rig.ready("b", agent=f'peers = ["{rig.address(first)}"]')
    first.hear("peer_up peer=b")
    assert rig.pancakes("task", "create", "a/Count", "--type", "count.Count").returncode == 0
    assert rig.pancakes("task", "migrate", "a/Count").returncode == 0
    refused = rig.pancakes("task", "remove", "a/Count")
    assert (refused.returncode, refused.stderr) == (1, "a/Count is on b: say b/Count\n")
    assert rig.pancakes("task", "remove", "b/Count").returncode == 0


def test_what_is_neither_a_file_nor_an_agent_is_said(rig: Rig):
    rig.ready("a")
    refused = rig.pancakes("config", "show", "b")
    assert refused.returncode == 3 and "there is no file 'b'" in refused.stderr
    assert "--set is for what a file says" in rig.pancakes("config", "show", "a", "--set", "clock.speed=2").stderr


def test_a_folder_may_bear_the_name_of_an_agent(rig: Rig):
    rig.ready("a")
    for name in ("a", "b"):
        (rig.directory / name).mkdir(exist_ok=True)
    shown = rig.pancakes("config", "show", "a")
    assert shown.returncode == 0 and 'name = "a"' in shown.stdout, shown.stderr
    refused = rig.pancakes("config", "show", "b")
    assert (refused.returncode, refused.stderr) == (3, "no agent 'b' answers, and that is a folder\n")


def test_a_key_that_has_an_option_is_said_once(rig: Rig):
    refused = rig.pancakes("task", "create", "a/Count", "--type", "count.Count", "--guard", "5", "--key", "guard=3")
    assert refused.returncode == 2 and "--guard and --key guard say the same: give one of them" in refused.stderr


def test_a_guarded_task_is_said_to_be_guarded_by_its_agent_alone_at_first(rig: Rig):
    rig.install("count", ENTRY_POINTS, SOURCE)
    rig.ready("a")
    made = rig.pancakes("task", "create", "a/Alone", "--type", "count.Count", "--guard", "3")
    assert made.returncode == 0, made.stderr
    assert "a alone guards it until other agents have agreed to: see pancakes task guards" in made.stderr
