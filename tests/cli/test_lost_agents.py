"""An agent with a guarded task is gone for good: what users see, and what they can do."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Callable, Iterator
from time import monotonic
from typing import Any

import pytest
from cli.processes import PATIENCE_S, Rig, Running, recovered, troubles
from cli.test_two_owners import SOURCE, heard

TASK = """
[task.Count]
type = "count.Count"
guard = { copies = 3, lease_s = 2.0, checkpoint_s = 0.2, guardians = ["b", "c"] }
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
        heard(self.agents["a"], "a/Count will be guarded by a, b, c")

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


def listed(rig: Rig) -> dict[str, str]:
    """Return why Count does not run, by agent."""
    return {row["agent"]: row["rest"] for row in rig.listed("task", "list") if row["task"] == "Count"}


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


def test_task_recover_starts_from_the_remaining_checkpoint(guarded: Guarded):
    rig = guarded.rig
    (found,) = rig.listed("task", "info", "a/Count")
    guarding = found["guarding"]
    assert [row["agent"] for row in guarding["guardians"]] == ["a", "b", "c"] and guarding["guard"] == 3
    assert 0.0 < guarding["permit_s"] <= 1.8 and guarding["answering"] == 3 and guarding["age_s"] < 2.0
    shown = rig.pancakes("task", "info", "a/Count").stdout
    assert "3 of 3; 3 wanted" in shown and "guardians" in shown and "0@a/" in shown

    code, row, _ = recovered(rig, "d/Count", "--here", "--yes")
    assert code == 1 and "because it runs on a: pancakes task migrate a/Count --to d" in row["proposal"]["text"]
    guarded.kill("a", "b")
    heard(guarded.agents["c"], "peer_down peer=a")
    heard(guarded.agents["d"], "peer_down peer=b")
    assert soon(lambda: troubles(rig) == {"a/Count": "guardians gone"}), "once the lease of a is over"
    code, row, said = recovered(rig, "d/Count", "--here")
    assert code == 1 and row["proposal"]["act"] == "revive" and "s old, held by c? Lost: what it did since" in said
    assert recovered(rig, "a/Count")[1]["proposal"]["act"] == "revive", "the lost agent names the task too"
    assert recovered(rig, "d/Count", "--here", "--dry-run")[1]["done"] == "dry run"
    code, row, _ = recovered(rig, "d/Count", "--here", "--yes")
    assert (code, row["task_id"], row["runs_on"]) == (0, "a/Count", "d")
    (state,) = rig.listed("task", "info", "d/Count")
    assert state["state"] == "running" and troubles(rig) == {}
    heard(guarded.back("a"), "it is paused here, and runs on d")
    assert listed(rig) == {"a": "disputed", "d": ""}
    code, row, _ = recovered(rig, "a/Count", "--yes")
    assert (code, row["trouble"], row["runs_on"]) == (0, "two owners", "d")
    assert soon(lambda: troubles(rig) == {}) and listed(rig)["d"] == ""


def test_task_recover_starts_a_waiting_take_over(rig: Rig):
    guarded = Guarded(rig, TASK.replace(" }", ', takeover = "ask" }'))
    soon(lambda: [row for row in guarded.guards() if row["guardian"] == "c" and row["checkpoint"]])
    guarded.kill("a")
    heard(guarded.agents["d"], "peer_down peer=a")
    soon(lambda: "waits for you" in "".join(guarded.agents["b"].so_far() + guarded.agents["c"].so_far()))
    assert soon(lambda: troubles(rig)) == {"a/Count": "silent owner"}
    code, row, _ = recovered(rig, "d/Count", "--here", "--yes")
    assert code == 1 and "have its guardians take over" in row["proposal"]["text"]
    code, row, _ = recovered(rig, "a/Count", "--dry-run")
    assert (code, row["proposal"]["act"], row["done"]) == (0, "take", "dry run")
    code, row, _ = recovered(rig, "a/Count", "--yes")
    assert code == 0 and row["runs_on"] in "bcd"
    accounts = soon(lambda: rig.listed("task", "migrations"))
    assert accounts[0]["source"] == "a" and accounts[0]["cause"].startswith("taken over from a, ")
    assert soon(lambda: troubles(rig) == {})


def test_task_recover_resumes_without_guardians(guarded: Guarded):
    rig = guarded.rig
    guarded.kill("b", "c")
    heard(guarded.agents["a"], "its guardians do not answer")
    assert "none: the task is paused" in rig.pancakes("task", "info", "a/Count").stdout
    assert [row["rest"] for row in rig.listed("task", "list", "a") if row["task"] == "Count"] == ["paused"]
    assert troubles(rig) == {"a/Count": "guardians gone"}
    code, row, _ = recovered(rig, "d/Count", "--here", "--yes")
    assert (
        code == 1
        and "where it is paused, with its state: pancakes task recover a/Count --here" in row["proposal"]["text"]
    )
    code, row, said = recovered(rig, "a/Count")
    assert code == 1 and "Lost: nothing. Only if b and c are off, or gone for good" in said, "nothing was done"
    code, row, _ = recovered(rig, "a/Count", "--yes")
    assert (code, row["done"], row["runs_on"]) == (0, "goes on", "a")
    assert soon(lambda: [row for row in guarded.guards() if row["guardian"] == "a" and row["permit_s"]])


def test_task_recover_works_on_copied_disks(guarded: Guarded):
    rig = guarded.rig
    guarded.kill("a", "b", "c", "d")
    for name in "abcd":
        (state,) = (path for path in (rig.directory / "state").rglob(name) if path.is_dir())
        shutil.copytree(state, rig.directory / "copy")
        shutil.rmtree(state)
        (rig.directory / "copy").rename(state)
    for name in "dcba":
        guarded.back(name)
    heard(guarded.agents["a"], "a/Count is paused on a, whose disk is a copy")
    (row,) = (row for row in rig.listed("task", "list") if row["task"] == "Count")
    assert row["rest"] == "paused"
    assert "none: the task is paused, because the disk is a copy" in rig.pancakes("task", "info", "a/Count").stdout
    doctor = rig.pancakes("doctor").stdout
    assert "the disk of a is a copy" in doctor and "pancakes task recover a/Count" in doctor
    code, row, _ = recovered(rig, "a/Count")
    assert (code, row["trouble"]) == (1, "copied disk")
    code, row, _ = recovered(rig, "a/Count", "--yes")
    assert (code, row["runs_on"]) == (0, "a")
    assert soon(lambda: [row for row in guarded.guards() if row["guardian"] == "a" and row["permit_s"]])
    now = [row["text"] for row in rig.listed("doctor") if not row["text"].startswith("warned ")]
    assert not [text for text in now if "is a copy" in text]
