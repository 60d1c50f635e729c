"""Two owners of one task, after a restored backup or an early revival: what users see, and how they decide."""

from __future__ import annotations

import shutil

from cli.processes import Rig, Running, recovered, troubles

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


def all_counts(rig: Rig) -> dict[str, tuple[str, str]]:
    """Return how the task is on each agent that knows it."""
    return {row["agent"]: (row["state"], row["rest"]) for row in rig.listed("task", "list") if row["task"] == "Count"}


def two(rig: Rig) -> tuple[Running, Running, str]:
    """Return an agent that owns the task, its neighbour, and the first one's configuration about the second."""
    rig.install("count", "[pancakes.tasks]\ncount.Count = plugin_count:Count\n", SOURCE)
    b = rig.ready("b")
    peers = f'peers = ["{rig.address(b)}"]'
    a = rig.ready("a", TASK, agent=peers)
    heard(a, "task_started task=Count")
    return a, b, peers


def test_task_stays_where_it_is_after_a_backup_was_restored(rig: Rig):
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
    assert "warning" in heard(a, "b owns a/Count (epoch 1@b), and the disk of a is a copy. It stays there")
    assert all_counts(rig) == {"a": ("stopped", "old copy"), "b": ("running", "")}
    doctor = rig.pancakes("doctor")
    assert doctor.returncode == 1 and "pancakes task recover a/Count" in doctor.stdout, doctor.stdout
    assert troubles(rig) == {"a/Count": "copied disk"}
    code, row, said = recovered(rig, "a/Count", "--yes")
    assert (code, row["done"], troubles(rig)) == (0, "left", {}), said
    assert rig.pancakes("task", "migrate", "b/Count", "--to", "a").returncode == 0
    assert all_counts(rig)["a"] == ("running", "")


def test_task_recover_keeps_one_of_two_owners(rig: Rig):
    a, b, peers = two(rig)
    a.process.kill()
    a.process.wait()
    heard(b, "peer_down peer=a")
    words = ("b/Count", "--here", "--config", str(rig.directory / "a.toml"), "--yes")
    assert recovered(rig, *words)[1]["runs_on"] == "b"

    a = rig.ready("a", TASK, agent=peers)
    assert "error" in heard(a, "is owned by a (epoch 0@a) and by b (epoch 1000000@b)")
    rests = all_counts(rig)
    assert rests == {"a": ("stopped", "disputed"), "b": ("running", "")}
    doctor = rig.pancakes("doctor")
    assert doctor.returncode == 1 and "because another agent owns it too" in doctor.stdout, doctor.stdout

    assert "pancakes task recover a/Count" in doctor.stdout and troubles(rig) == {"a/Count": "two owners"}
    code, row, _ = recovered(rig, "a/Count", "--dry-run")
    proposal = row["proposal"]
    assert (code, proposal["act"], proposal["agent"], proposal["others"]) == (0, "keep", "b", ["a"]), "that which runs"
    assert proposal["lost"] == "the state of the copy on a"
    (other,) = row["choices"]
    assert other["command"] == "pancakes task recover a/Count --here" and other["lost"] == "the state of the copy on b"
    code, _, said = recovered(rig, "a/Count", "--here")
    assert code == 1 and "end the copy on b? Lost: the state of the copy on b. Pass --yes" in said
    assert rests == all_counts(rig)
    code, row, said = recovered(rig, "a/Count", "--here", "--yes")
    assert (code, row["done"], row["runs_on"]) == (0, "kept", "a"), said
    listed = [row for row in rig.listed("task", "list") if row["task"] == "Count" and row["state"] == "running"]
    assert [row["agent"] for row in listed] == ["a"]
    doctor = rig.pancakes("doctor")
    assert doctor.returncode == 0 and troubles(rig) == {}, doctor.stdout
    assert rig.pancakes("task", "migrate", "a/Count", "--to", "b").returncode == 0


def test_task_recover_sees_owners_without_a_link(rig: Rig):
    a, b, peers = two(rig)
    a.process.kill()
    a.process.wait()
    heard(b, "peer_down peer=a")
    words = ("b/Count", "--here", "--config", str(rig.directory / "a.toml"), "--yes")
    assert recovered(rig, *words)[1]["runs_on"] == "b"
    a = rig.ready("a", TASK)  # without its peers: neither knows of the other's copy
    heard(a, "task_started task=Count")
    assert troubles(rig) == {"a/Count": "two owners"}
    code, row, _ = recovered(rig, "a/Count", "--yes")
    assert code == 1 and row["done"] == "" and "a/Count runs on a and b" in row["what"]
    assert "link these agents" in row["proposal"]["text"]
    assert "pancakes task stop a/Count; pancakes task stop b/Count" in row["proposal"]["text"]
    a.process.terminate()
    assert a.ended() == 0
    heard(rig.ready("a", TASK, agent=peers), "it is paused here, and runs on b")
    assert recovered(rig, "a/Count", "--yes")[1]["runs_on"] == "b" and troubles(rig) == {}


def test_task_recover_decides_without_the_other_owner(rig: Rig):
    a, b, peers = two(rig)
    a.process.kill()
    a.process.wait()
    heard(b, "peer_down peer=a")
    words = ("b/Count", "--here", "--config", str(rig.directory / "a.toml"), "--yes")
    assert recovered(rig, *words)[1]["runs_on"] == "b"

    a = rig.ready("a", TASK, agent=peers)
    heard(a, "it is paused here, and runs on b")
    address = rig.address(b)
    b.process.kill()
    b.process.wait()
    heard(a, "peer_down peer=b")
    code, row, said = recovered(rig, "a/Count")
    assert (code, row["trouble"]) == (1, "two owners") and "b does not answer" in row["what"]
    assert "Only if b is off, or gone for good" in said
    assert recovered(rig, "a/Count", "--yes")[1]["runs_on"] == "a", "the other owner need not be there"
    back = rig.agent(rig.directory / "b.toml", "--set", f'agent.listen="{address}"')
    heard(back, "it is paused here, and runs on a")
    code, row, _ = recovered(rig, "b/Count", "--yes")
    assert (code, row["runs_on"]) == (0, "a") and troubles(rig) == {}
