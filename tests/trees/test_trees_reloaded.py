"""The class of a tree is reloaded while its agent runs."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from services.plugin_on_disk import PluginOnDisk, written

from pancakes.control import Reload
from pancakes.testing import Fleet

TREE = """
from py_trees.common import Status
from py_trees.composites import Sequence
from pancakes.trees import TaskBehaviour, Timer, TreeTask

class Go(TaskBehaviour):
    keeps = ("steps",)

    def __init__(self, name):
        super().__init__(name)
        self.steps = 0

    def update(self):
        self.steps += 1
        return Status.RUNNING

class Walk(TreeTask):
    def make_tree(self):
        return Sequence("walk", memory=True, children=[Timer("wait", 1.0), Go("go")])
"""
POINTS = "[pancakes.tasks]\nwalk_in_test.Walk = walk_in_test.walk:Walk\n"


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PluginOnDisk]:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    plugin = written(tmp_path)
    plugin.write("walk", TREE)
    plugin.install("0.1.0", POINTS)
    yield plugin
    for name in [name for name in sys.modules if name.partition(".")[0] == "walk_in_test"]:
        del sys.modules[name]


@pytest.mark.parametrize(
    ("old", "new", "steps", "warnings"),
    [("self.steps += 1", "self.steps += 100", 1015, 0), ('Go("go")', 'Go("run")', 0, 1)],
)
def test_a_tree_goes_on_in_its_new_class_and_begins_at_its_root_if_its_shape_is_another(
    plugin: PluginOnDisk, old: str, new: str, steps: int, warnings: int
) -> None:
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"Walk": "walk_in_test.Walk"})
        fleet.run_for(2.55)
        task = a.task("Walk")
        assert task.tree.tip().steps == 15
        task.blackboard["goal"] = 3
        plugin.edit("walk", old, new)
        reply = a.ask(Reload("walk_in_test.Walk"))
        assert reply.ok, reply.reason
        fleet.run_for(0.95)
        now = a.task("Walk")
        assert type(now) is not type(task)
        assert now.tree.children[1].steps == steps
        assert now.blackboard["goal"] == 3
        assert len(a.lines("warning")) == warnings
