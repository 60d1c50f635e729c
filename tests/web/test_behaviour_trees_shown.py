"""The behaviour tree of a task of a real agent: in `pancakes task info`, and on the page in a real browser."""

from __future__ import annotations

from typing import Any

import pytest
from cli.processes import Rig
from web.browsing import chip, expect, opened, view

PATROL = """
import py_trees
from py_trees.common import Status

from pancakes.trees import TaskBehaviour, TreeTask

class Go(TaskBehaviour):
    keeps = ("steps",)

    def __init__(self, name):
        super().__init__(name)
        self.steps = 0

    def update(self):
        self.steps += 1
        if self.steps == 1:
            self.task.log("info", "the first step")
        self.feedback_message = f"{self.steps} steps"
        return Status.RUNNING

class Patrol(TreeTask):
    def make_tree(self):
        ready = py_trees.behaviours.Success("Is ready")
        hurt = py_trees.behaviours.Failure("Is hurt")
        go = py_trees.composites.Sequence("Patrol", memory=True, children=[ready, Go("Go"), Go("Come back")])
        return py_trees.composites.Selector("Mission", memory=False, children=[hurt, go])
"""


@pytest.fixture
def patrolling(rig: Rig) -> Rig:
    rig.install("patrol", "[pancakes.tasks]\npatrol.Patrol = plugin_patrol:Patrol\n", PATROL)
    rig.ready("a", '[task.Patrol]\ntype = "patrol.Patrol"\n').hear("the first step")
    return rig


def test_tree_is_listed_with_the_state(patrolling: Rig):
    told = patrolling.pancakes("task", "info", "a/Patrol", "--state").stdout
    lines = told.partition("behaviour tree\n")[2].splitlines()
    words = [line.split() for line in lines if line.strip() and "──" not in line]
    assert words[0] == ["node", "kind", "status", "message"]
    assert words[1][:3] == ["Mission", "Selector", "RUNNING"]
    assert words[2][:5] == [".", "Is", "hurt", "Failure", "FAILURE"]
    assert words[5][:5] == [".", ".", "Go", "Go", "RUNNING"]
    assert words[6][-2:] == ["Go", "INVALID"]
    (row,) = patrolling.listed("task", "info", "a/Patrol", "--state")
    assert [node["name"] for node in row["kept_state"]["nodes"]][:2] == ["Mission", "Is hurt"]


def test_tree_is_drawn_and_followed(patrolling: Rig, browser: Any, faults: list[str]):
    page = opened(browser, view(patrolling), faults)
    expect(chip(page, "a", "Patrol")).to_have_attribute("data-state", "running")
    chip(page, "a", "Patrol").get_by_role("button").press("Enter")
    tree = page.get_by_role("dialog").get_by_role("region", name="Behaviour tree")
    nodes = tree.get_by_role("listitem")
    expect(nodes).to_have_count(6)
    assert [it.get_attribute("data-status") for it in nodes.all()] == [
        *("RUNNING", "FAILURE", "RUNNING", "SUCCESS", "RUNNING", "INVALID")
    ]
    expect(nodes.nth(4).get_by_role("img", name="running")).to_have_text("▶")
    expect(nodes.nth(4)).to_contain_text("Go")
    before = nodes.nth(4).locator(".message").inner_text()
    expect(nodes.nth(4).locator(".message")).not_to_have_text(before)
    left = [it.locator(".mark").bounding_box()["x"] for it in nodes.all()]
    assert left[0] < left[1] < left[4], "a child stands to the right of its parent"
    assert faults == []
