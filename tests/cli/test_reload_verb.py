"""`pancakes task reload` on running agents, whose plug-in a person edits or upgrades."""

import json
import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from cli.processes import Rig, Running

SOURCE = """
from dataclasses import dataclass
from pancakes.task import Task, every

class Count(Task):
    @dataclass
    class State:
        n: int = 0

    @every(hz=20)
    def tick(self, tick):
        self.state.n += 1
        self.event("counted first", n=self.state.n)
"""
ENTRY_POINTS = "[pancakes.tasks]\ncount.Count = plugin_count:Count\ncount.Later = plugin_later:Later\n"
TASK = '[task.One]\ntype = "count.Count"\n'


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with closing(Rig(tmp_path)) as rig:
        rig.install("count", ENTRY_POINTS, SOURCE)
        yield rig


def edit(rig: Rig, old: str, new: str) -> None:
    path = rig.plugins / "plugin_count.py"
    written_s = path.stat().st_mtime
    path.write_text(path.read_text().replace(old, new))
    os.utime(path, (written_s, written_s))  # as if it were edited in the second of its last import


def count_in(line: str) -> int:
    return int(line.rpartition("n=")[2].split()[0])


def test_a_task_of_a_running_agent_goes_on_in_the_class_that_was_edited(rig: Rig) -> None:
    agent: Running = rig.ready("a", TASK)
    before = count_in(agent.hear("counted first"))
    edit(rig, "counted first", "counted other")  # as long as before: a compiled file seems to fit
    (tried,) = rig.listed("task", "reload", "count.Count", "--dry-run")
    assert (tried["task"], tried["done"]) == ("One", "dry run")
    agent.hear("counted first")
    (row,) = rig.listed("task", "reload", "count.Count")
    assert (row["agent"], row["task"], row["done"]) == ("a", "One", "reloaded")
    assert count_in(agent.hear("counted other")) > before

    edit(rig, "n: int = 0", "m: int = 0")
    refused = rig.pancakes("task", "reload", "count.Count")
    assert (refused.returncode, refused.stdout) == (1, "")
    assert "a/client/One: n: " in refused.stderr and "Traceback" not in refused.stderr
    edit(rig, "m: int = 0", "n: int = 1 / 0")
    refused = rig.pancakes("task", "reload", "count.Count", "a")
    assert refused.returncode == 1 and "plugin_count.py:8" in refused.stderr
    agent.hear("counted other")

    edit(rig, "n: int = 1 / 0", "m: int = 0")
    edit(rig, "state.n", "state.m")
    edit(rig, "counted other", "counted third")
    for verb in (("stop", "a/One"), ("reload", "count.Count"), ("restart", "a/One", "--drop-state", "--yes")):
        assert rig.pancakes("task", *verb).returncode == 0, "as the refusal says"
    assert count_in(agent.hear("counted third")) == 1


def test_a_distribution_that_was_upgraded_while_its_agent_runs_is_taken_at_a_reload(rig: Rig) -> None:
    agent = rig.ready("a", TASK)
    agent.hear("counted first")
    (rig.plugins / "count-1.0.dist-info").rename(rig.plugins / "count-1.1.dist-info")
    metadata = rig.plugins / "count-1.1.dist-info" / "METADATA"
    metadata.write_text(metadata.read_text().replace("1.0", "1.1"))
    (rig.plugins / "plugin_later.py").write_text(SOURCE.replace("Count", "Later").replace("first", "later"))
    refused = rig.pancakes("task", "create", "a/Two", "--type", "count.Later")
    assert refused.returncode == 1 and "1.1" in refused.stderr, "its modules would be of two versions"
    row = json.loads(rig.pancakes("task", "reload", "count.Count", "a", "--format", "json").stdout)[0]
    assert (row["before"], row["version"]) == ("1.0", "1.1")
    assert rig.pancakes("task", "create", "a/Two", "--type", "count.Later").returncode == 0
    agent.hear("counted later")


def test_a_type_that_no_agent_runs_is_told(rig: Rig) -> None:
    rig.ready("a", TASK)
    refused = rig.pancakes("task", "reload", "count.Coumt")
    assert refused.returncode == 1 and "did you mean 'count.Count'?" in refused.stderr
