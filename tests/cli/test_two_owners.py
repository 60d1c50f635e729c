"""Two owners of one task, after a restored backup or an early revival: what users see, and how they decide."""

from __future__ import annotations

import shutil

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
"""
TASK = '[task.Count]\ntype = "count.Count"\n'


def heard(agent: Running, text: str) -> str:
    """Return the line that contains a text, printed already or soon."""
    return next((line for line in agent.said if text in line), "") or agent.hear(text)


def two(rig: Rig) -> tuple[Running, Running, str]:
    """Return an agent that owns the task, its neighbour, and the first one's configuration about the second."""
    rig.install("count", "[pancakes.tasks]\ncount.Count = plugin_count:Count\n", SOURCE)
    b = rig.ready("b")
    peers = f'peers = ["{rig.address(b)}"]'
    a = rig.ready("a", TASK, agent=peers)
    heard(a, "task_started task=Count")
    return a, b, peers


def test_task_resolve_keeps_one_of_two_owners(rig: Rig):
    a, _, peers = two(rig)
    backup = rig.directory / "backup"
    state = next(path for path in (rig.directory / "state").rglob("a") if path.is_dir())
    shutil.copytree(state, backup)
    assert rig.pancakes("task", "migrate", "a/Count", "--to", "b").returncode == 0
    a.process.terminate()
    assert a.ended() == 0
    shutil.rmtree(state)
    shutil.copytree(backup, state)

    a = rig.ready("a", TASK, agent=peers)
    assert "error" in heard(a, "is owned by a (epoch 0@a) and by b (epoch 1@a)")
    rests = {row["agent"]: (row["state"], row["rest"]) for row in rig.listed("task", "list") if row["task"] == "Count"}
    assert rests == {"a": ("stopped", "disputed"), "b": ("running", "")}
    doctor = rig.pancakes("doctor")
    assert doctor.returncode == 1 and "because another agent owns it too" in doctor.stdout, doctor.stdout

    dry = rig.listed("task", "resolve", "a/Count", "--dry-run")
    assert [(row["agent"], row["was"], row["becomes"], row["done"]) for row in dry] == [
        ("b", "running", "given up", "dry run"),
        ("a", "at rest", "running", "dry run"),
    ]
    asked = rig.pancakes("task", "resolve", "a/Count")
    assert asked.returncode == 1 and "gives up a/Count on b, whose state is lost" in asked.stderr
    done = rig.pancakes("task", "resolve", "a/Count", "--force")
    assert done.returncode == 0, done.stderr
    listed = [row for row in rig.listed("task", "list") if row["task"] == "Count" and row["state"] == "running"]
    assert [row["agent"] for row in listed] == ["a"]
    assert rig.pancakes("doctor").returncode == 0
    again = rig.pancakes("task", "resolve", "a/Count")
    assert again.returncode == 1 and "is owned only by a" in again.stderr
    assert rig.pancakes("task", "migrate", "a/Count", "--to", "b").returncode == 0


def test_task_revive_accepts_a_configuration(rig: Rig):
    a, b, peers = two(rig)
    asked = ("task", "revive", "b/Count", "--config", str(rig.directory / "a.toml"))
    runs = rig.pancakes(*asked, "--force")
    assert runs.returncode == 1 and "Count is running on a: it is not lost" in runs.stderr
    a.process.kill()
    a.process.wait()
    heard(b, "peer_down peer=a")
    meaning = rig.pancakes(*asked)
    assert meaning.returncode == 1 and "its state is lost" in meaning.stderr
    assert [row["done"] for row in rig.listed(*asked, "--dry-run")] == ["dry run"]
    assert [row["done"] for row in rig.listed(*asked, "--force")] == ["revived"]
    listed = [row["state"] for row in rig.listed("task", "list", "b") if row["task"] == "Count"]
    assert listed == ["running"]
    other = rig.pancakes("task", "revive", "b/Nothing", "--config", str(rig.directory / "a.toml"))
    assert other.returncode == 1 and "has no [task.Nothing]. It has Count" in other.stderr

    a = rig.ready("a", TASK, agent=peers)
    heard(a, "goes on on b")
    address = rig.address(b)
    b.process.kill()
    b.process.wait()
    refused = rig.pancakes("task", "resolve", "a/Count")
    assert refused.returncode == 1 and "does not answer" in refused.stderr and "--force" in refused.stderr
    assert rig.pancakes("task", "resolve", "a/Count", "--force").returncode == 0, "the other owner need not be there"
    back = rig.agent(rig.directory / "b.toml", "--set", f'agent.listen="{address}"')
    heard(back, "goes on on a")
