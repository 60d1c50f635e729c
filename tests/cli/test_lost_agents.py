"""An agent with a guarded task is gone for good: what users see, and what they can do."""

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
    """Poll until there is an answer; a command has no event to wait for."""
    until_s = monotonic() + PATIENCE_S
    while not (it := found()):
        assert monotonic() < until_s
    return it


@pytest.fixture
def guarded(rig: Rig) -> Iterator[Guarded]:
    made = Guarded(rig)
    soon(lambda: [row for row in made.guards() if row["guardian"] == "c" and (row["checkpoint"] or 0) > 2])
    yield made


def test_task_revive_starts_from_the_remaining_checkpoint(guarded: Guarded):
    rig, asked = guarded.rig, ("task", "revive", "d/Count")
    (found,) = rig.listed("task", "info", "a/Count")
    guarding = found["guarding"]
    assert [row["agent"] for row in guarding["guardians"]] == ["a", "b", "c"] and guarding["guard"] == 3
    assert 0.0 < guarding["permit_s"] <= 1.8 and guarding["answering"] == 3 and guarding["age_s"] < 2.0
    shown = rig.pancakes("task", "info", "a/Count").stdout
    assert "3 of 3; 3 wanted" in shown and "guardians" in shown and "0@a/" in shown

    runs = rig.pancakes(*asked, "--force")
    assert runs.returncode == 1 and "Count is running on a: it is not lost" in runs.stderr
    nothing = rig.pancakes("task", "revive", "d/Nothing")
    assert nothing.returncode == 1
    assert "no agent that answers holds a checkpoint of Nothing. To start it from scratch" in nothing.stderr
    guarded.kill("a", "b")
    heard(guarded.agents["c"], "peer_down peer=a")
    heard(guarded.agents["d"], "peer_down peer=b")
    meaning = rig.pancakes(*asked)
    assert meaning.returncode == 1 and "s old, held by c: what it has done since is lost" in meaning.stderr
    (dry,) = rig.listed(*asked, "--dry-run")
    assert dry["done"] == "dry run" and dry["from"].startswith("0@a/")
    (done,) = rig.listed(*asked, "--force")
    assert (done["agent"], done["task_id"], done["done"]) == ("d", "a/Count", "revived")
    (state,) = rig.listed("task", "info", "d/Count")
    assert state["fence"]["epoch"] == 1_000_000 and state["state"] == "running"
    heard(guarded.back("a"), "goes on on d")
    rows = [row for row in rig.listed("task", "list") if row["task"] == "Count"]
    assert {row["agent"]: row["rest"] for row in rows} == {"a": "disputed", "d": ""}


def test_task_take_starts_a_waiting_take_over(rig: Rig):
    guarded = Guarded(rig, TASK + 'takeover = "ask"\n')
    soon(lambda: [row for row in guarded.guards() if row["guardian"] == "c" and row["checkpoint"]])
    guarded.kill("a")
    heard(guarded.agents["d"], "peer_down peer=a")
    refused = rig.pancakes("task", "revive", "d/Count", "--force")
    assert refused.returncode == 1 and "more than half of the guardians of a/Count answer" in refused.stderr
    soon(lambda: "waits for you" in "".join(guarded.agents["b"].so_far() + guarded.agents["c"].so_far()))
    (would,) = rig.listed("task", "take", "b/Count", "--dry-run")
    assert would["taker"] in "bcd" and would["done"] == "dry run"
    assert rig.pancakes("task", "take", "b/Count").returncode == 0
    accounts = soon(lambda: rig.listed("task", "migrations"))
    assert accounts[0]["source"] == "a" and accounts[0]["cause"].startswith("taken over from a, ")


def test_task_revive_resumes_without_guardians(guarded: Guarded):
    rig = guarded.rig
    guarded.kill("b", "c")
    heard(guarded.agents["a"], "its guardians do not answer")
    assert "none: the task is paused" in rig.pancakes("task", "info", "a/Count").stdout
    assert [row["rest"] for row in rig.listed("task", "list", "a") if row["task"] == "Count"] == ["stands still"]
    elsewhere = rig.pancakes("task", "revive", "d/Count", "--force")
    assert elsewhere.returncode == 1 and "Count is paused on a, with its state" in elsewhere.stderr
    assert rig.pancakes("task", "revive", "a/Count").returncode == 1, "it only says what that would mean"
    (done,) = rig.listed("task", "revive", "a/Count", "--force")
    assert done["done"] == "revived"
    assert soon(lambda: [row for row in guarded.guards() if row["guardian"] == "a" and row["permit_s"]])


def test_task_revive_works_on_copied_disks(guarded: Guarded):
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
    assert "none: the task is paused, because the disk is a copy" in rig.pancakes("task", "info", "a/Count").stdout
    doctor = rig.pancakes("doctor").stdout
    assert "the disk of a is a copy" in doctor and "pancakes task revive a/Count" in doctor
    assert rig.pancakes("task", "revive", "a/Count").returncode == 1
    (done,) = rig.listed("task", "revive", "a/Count", "--force")
    assert done["done"] == "revived"
    assert soon(lambda: [row for row in guarded.guards() if row["guardian"] == "a" and row["permit_s"]])
    now = [row["text"] for row in rig.listed("doctor") if not row["text"].startswith("warned ")]
    assert not [text for text in now if "is a copy" in text]
