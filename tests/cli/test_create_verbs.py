"""`pancakes task create|remove` and `config show AGENT`, on running agents."""

import signal

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


def test_created_task_survives_a_restart_and_fits_a_file(rig: Rig):
    rig.install("count", ENTRY_POINTS, SOURCE)
    first = rig.ready("a")
    options = ("--type", "count.Count", "--set", "step=100", "--rate", "40", "--key", "restart.policy=no")
    (row,) = rig.listed("task", "create", "a/Count", *options)
    assert (row["task_id"], row["epoch"], row["done"]) == ("a/Count", 1, "created")
    first.hear("counted n=200")
    again = rig.pancakes("task", "create", "a/Count", *options)
    assert again.returncode == 1 and "choose another name" in again.stderr
    wrong = rig.pancakes("task", "create", "a/Other", "--type", "count.Count", "--set", "stepp=1", "--dry-run")
    assert wrong.returncode == 1 and "[task.Other] settings.stepp" in wrong.stderr

    first.signalled(signal.SIGKILL)
    second = rig.ready("a")
    second.hear("counted n=")
    (info,) = rig.listed("task", "info", "a/Count")
    assert (info["settings"], info["rate_hz"], info["restart"]["policy"]) == ({"step": 100}, 40.0, "no")
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
    asked = rig.pancakes("task", "remove", "a/Count")
    assert (
        asked.returncode == 1 and "this ends a/client/Count for good, and its state is lost. Pass --yes" in asked.stderr
    )
    (row,) = rig.listed("task", "remove", "a/Count", "--yes")
    assert (row["task"], row["done"]) == ("Count", "removed")
    assert [row["task"] for row in rig.listed("task", "list") if row["type"] == "count.Count"] == []
    assert "task.Count" not in rig.pancakes("config", "show", "a").stdout


def test_task_remove_needs_the_present_agent(rig: Rig):
    rig.install("count", ENTRY_POINTS, SOURCE)
    first = rig.ready("a")
    rig.ready("b", agent=f'peers = ["{rig.address(first)}"]')
    first.hear("peer_up peer=b")
    made = rig.pancakes("task", "create", "a/Alone", "--type", "count.Count", "--guard", "3")
    assert made.returncode == 0 and "see pancakes task guards" in made.stderr
    assert rig.pancakes("task", "create", "a/Count", "--type", "count.Count").returncode == 0
    assert rig.pancakes("task", "migrate", "a/Count").returncode == 0
    refused = rig.pancakes("task", "remove", "a/Count")
    assert (refused.returncode, refused.stderr) == (1, "a/Count is on b: use b/Count\n")
    assert rig.pancakes("task", "remove", "b/Count", "--yes").returncode == 0


def test_config_show_accepts_a_file_or_an_agent(rig: Rig):
    rig.ready("a")
    for name in ("a", "c"):
        (rig.directory / name).mkdir()
    shown = rig.pancakes("config", "show", "a")
    assert shown.returncode == 0 and 'name = "a"' in shown.stdout, "a folder may bear the name of an agent"
    for words, code, said in (
        (("b",), 3, "the file 'b' does not exist"),
        (("c",), 3, "there is no agent 'c', only a\n'c' is a folder\n"),
        (("a", "--set", "clock.speed=2"), 2, "--set overrides keys of a file"),
    ):
        refused = rig.pancakes("config", "show", *words)
        assert refused.returncode == code and said in refused.stderr
