"""An agent that had a guarded task is gone for good: what people see of that, and how they help."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Callable, Iterator
from time import monotonic
from typing import Any

import pytest
from cli.processes import PATIENCE_S, Rig, Running
from cli.test_two_owners import SOURCE, heard

TASK = """
[task.Count]
type = "count.Count"
guard = 3
lease_s = 2.0
checkpoint_s = 0.2
guardians = ["b", "c"]
"""


class Guarded:
    """Agents a, b and c, which guard the task that runs on a; d, which does not."""

    def __init__(self, rig: Rig, task: str = TASK) -> None:
        self.rig = rig
        rig.install("count", "[pancakes.tasks]\ncount.Count = plugin_count:Count\n", SOURCE)
        self.agents: dict[str, Running] = {}
        self.addresses: dict[str, str] = {}
        for name, rest in (("d", ""), ("c", ""), ("b", ""), ("a", task)):
            peers = ", ".join(f'"{address}"' for address in self.addresses.values())
            self.agents[name] = rig.ready(name, rest, agent=f"peers = [{peers}]")
            self.addresses[name] = rig.address(self.agents[name])
        heard(self.agents["a"], "a/Count is to be guarded by a, b, c")

    def kill(self, *names: str) -> None:
        for name in names:
            self.agents[name].process.send_signal(signal.SIGKILL)
            self.agents[name].process.wait()

    def back(self, name: str) -> Running:
        file = self.rig.directory / f"{name}.toml"
        self.agents[name] = self.rig.agent(file, "--set", f'agent.listen="{self.addresses[name]}"')
        return self.agents[name]

    def guards(self) -> list[dict[str, Any]]:
        return self.rig.listed("task", "guards")


def soon(found: Callable[[], Any]) -> Any:
    """Asks again and again until there is an answer; a command has no event that one could wait for."""
    until_s = monotonic() + PATIENCE_S
    while not (it := found()):
        assert monotonic() < until_s
    return it


@pytest.fixture
def guarded(rig: Rig) -> Iterator[Guarded]:
    made = Guarded(rig)
    soon(lambda: [row for row in made.guards() if row["guardian"] == "c" and (row["checkpoint"] or 0) > 2])
    yield made


def test_a_task_goes_on_from_the_checkpoint_of_the_guardian_that_is_left(guarded: Guarded):
    rig, asked = guarded.rig, ("task", "revive", "d/Count")
    runs = rig.pancakes(*asked, "--force")
    assert runs.returncode == 1 and "Count is running on a: it is not lost" in runs.stderr
    guarded.kill("a", "b")
    heard(guarded.agents["c"], "peer_down peer=a")
    heard(guarded.agents["d"], "peer_down peer=b")
    meaning = rig.pancakes(*asked)
    assert meaning.returncode == 1 and "s old, held by c: what it has done since is lost" in meaning.stderr
    assert "Nothing was done" in meaning.stderr
    (dry,) = rig.listed(*asked, "--dry-run")
    assert dry["done"] == "dry run" and dry["from"].startswith("0@a/")
    (done,) = rig.listed(*asked, "--force")
    assert (done["agent"], done["task_id"], done["done"]) == ("d", "a/Count", "revived")
    (state,) = rig.listed("task", "info", "d/Count")
    assert state["fence"]["epoch"] == 1_000_000 and state["state"] == "running"
    back = guarded.back("a")
    heard(back, "it stands still here, and goes on on d")
    rows = [row for row in rig.listed("task", "list") if row["task"] == "Count"]
    assert {row["agent"]: row["rest"] for row in rows} == {"a": "disputed", "d": ""}


def test_without_a_checkpoint_it_says_what_it_needs(guarded: Guarded):
    rig = guarded.rig
    nothing = rig.pancakes("task", "revive", "d/Nothing")
    assert nothing.returncode == 1
    assert "no agent that answers holds a checkpoint of Nothing: with --config FILE" in nothing.stderr
    alone = rig.pancakes("task", "revive", "d/Count", "--set", "x=1")
    assert alone.returncode == 2 and "say --config FILE too" in alone.stderr


def test_where_more_than_half_of_its_guardians_answer_it_is_theirs(rig: Rig):
    guarded = Guarded(rig, TASK + 'takeover = "ask"\n')
    soon(lambda: [row for row in guarded.guards() if row["guardian"] == "c" and row["checkpoint"]])
    guarded.kill("a")
    heard(guarded.agents["d"], "peer_down peer=a")
    refused = rig.pancakes("task", "revive", "d/Count", "--force")
    assert refused.returncode == 1 and "more than half of the guardians of a/Count answer" in refused.stderr
    soon(lambda: "waits for you" in "".join(guarded.agents["b"].so_far() + guarded.agents["c"].so_far()))
    (would,) = rig.listed("task", "take", "b/Count", "--dry-run")
    assert would["taker"] in "bcd" and would["done"] == "dry run"


def test_a_task_whose_guardians_are_gone_goes_on_as_it_stands(guarded: Guarded):
    rig = guarded.rig
    guarded.kill("b", "c")
    heard(guarded.agents["a"], "a/Count stands still: its guardians do not answer")
    elsewhere = rig.pancakes("task", "revive", "d/Count", "--force")
    assert elsewhere.returncode == 1 and "Count stands still on a, with its state" in elsewhere.stderr
    meaning = rig.pancakes("task", "revive", "a/Count")
    assert meaning.returncode == 1 and "a alone guards it until others are chosen" in meaning.stderr
    (done,) = rig.listed("task", "revive", "a/Count", "--force")
    assert done["done"] == "revived"
    assert soon(lambda: [row for row in guarded.guards() if row["guardian"] == "a" and row["permit_s"]])


def test_a_task_whose_agents_all_have_copied_disks_is_named_and_goes_on_once_a_person_says_so(guarded: Guarded):
    rig = guarded.rig
    guarded.kill("a", "b", "c", "d")
    for name in "abcd":
        (state,) = (path for path in (rig.directory / "state").rglob(name) if path.is_dir())
        shutil.copytree(state, rig.directory / "copy")
        shutil.rmtree(state)
        (rig.directory / "copy").rename(state)
    for name in "dcba":
        guarded.back(name)
    heard(guarded.agents["a"], "a/Count stands still on a, whose disk is a copy")
    (row,) = (row for row in rig.listed("task", "list") if row["task"] == "Count")
    assert row["rest"] == "stands still"
    assert "none: it stands still, as the disk is a copy" in rig.pancakes("task", "info", "a/Count").stdout
    doctor = rig.pancakes("doctor").stdout
    assert "the disk of a is a copy" in doctor and "pancakes task revive a/Count" in doctor
    meaning = rig.pancakes("task", "revive", "a/Count")
    assert meaning.returncode == 1 and "more than half do not answer" in meaning.stderr
    (done,) = rig.listed("task", "revive", "a/Count", "--force")
    assert done["done"] == "revived"
    assert soon(lambda: [row for row in guarded.guards() if row["guardian"] == "a" and row["permit_s"]])
    assert "is a copy" not in rig.pancakes("doctor").stdout


def test_what_is_known_of_a_guarded_task_is_shown(guarded: Guarded):
    rig = guarded.rig
    (found,) = rig.listed("task", "info", "a/Count")
    guarding = found["guarding"]
    assert [row["agent"] for row in guarding["guardians"]] == ["a", "b", "c"] and guarding["guard"] == 3
    assert 0.0 < guarding["permit_s"] <= 1.8 and guarding["answering"] == 3 and guarding["age_s"] < 2.0
    shown = rig.pancakes("task", "info", "a/Count").stdout
    assert "3 of 3, 3 are wanted" in shown and "guardians" in shown and "0@a/" in shown
    guarded.kill("b", "c")
    heard(guarded.agents["a"], "stands still: its guardians do not answer")
    assert "none: it stands still" in rig.pancakes("task", "info", "a/Count").stdout
    assert [row["rest"] for row in rig.listed("task", "list", "a") if row["task"] == "Count"] == ["stands still"]


def test_a_take_over_is_accounted_for_as_a_sentence(guarded: Guarded):
    guarded.kill("a")
    accounts = soon(lambda: guarded.rig.listed("task", "migrations"))
    assert accounts[0]["source"] == "a" and accounts[0]["cause"].startswith("taken over from a, silent for ")
