"""`pancakes what-if allocate` at a terminal."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest
from cli.processes import Rig

SOURCE = "from pancakes.task import Task\n\n\nclass Watch(Task):\n    pass\n"
PART = "[service.network]\nsettings = { allocation = { at_most = 2 } }\n"
TASKS = "".join(
    f'[task.{name}]\ntype = "watching.Watch"\nmigrate = {{ when = "allocation", move_price = 1e3, value = 1010.0 }}\n'
    for name in ("Gate", "Pond")
)


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    rig = Rig(tmp_path_factory.mktemp("allocate"))
    try:
        rig.install("watching", "[pancakes.tasks]\nwatching.Watch = plugin_watching:Watch\n", SOURCE)
        first = rig.ready("a", PART + TASKS, agent="birth_wait_s = 0")
        rig.ready("b", PART, agent=f'birth_wait_s = 0\npeers = ["{rig.address(first)}"]')
        first.hear("peer_up peer=b")
        rig.ready("plain", agent="birth_wait_s = 0")
        yield rig
    finally:
        rig.close()


def test_each_task_has_its_robot_now_and_then_with_all_bids(rig: Rig) -> None:
    done = rig.pancakes("what-if", "allocate", "a")
    assert done.returncode == 0, done.stderr
    for text in ("a/Gate", "a/Pond", "a 1010, b 10", "worth 2019", "if nothing is migrated, 2019"):
        assert text in done.stdout, done.stdout
    told = json.loads(rig.pancakes("what-if", "allocate", "a", "--format", "json").stdout)
    assert told["dry_run"] and [line["winner"] for line in told["lines"]] == ["a", "a"]


def test_an_agent_that_takes_no_part_says_what_to_write(rig: Rig) -> None:
    done = rig.pancakes("what-if", "allocate", "plain")
    assert done.returncode == 1 and "[service.network]" in done.stderr and done.stdout == ""


def test_agents_in_real_time_migrate_what_another_one_has_room_for(rig: Rig) -> None:
    """Its own pair of agents: c takes one task, and begins with two."""
    one = PART.replace("at_most = 2", "at_most = 1")
    tasks = TASKS.replace("move_price = 1e3, value = 1010.0", "move_price = 1.0").replace("task.", "task.Other")
    first = rig.ready("c", one + tasks, agent="birth_wait_s = 0")
    second = rig.ready("d", PART, agent=f'birth_wait_s = 0\npeers = ["{rig.address(first)}"]')
    second.hear("task_started task=Other")
    first.hear("task_handed_over task=Other")
    rows = {row["task"]: row["agent"] for row in rig.listed("task", "list") if row["state"] == "running"}
    assert sorted(agent for task, agent in rows.items() if task.startswith("Other")) == ["c", "d"]
