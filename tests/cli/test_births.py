"""A lost disk, as users see it, with real processes."""

from __future__ import annotations

import shutil
from pathlib import Path

from cli.processes import Rig, Running, recovered, troubles
from cli.test_two_owners import SOURCE, TASK, heard

TASKS = TASK + '[task.Stays]\ntype = "count.Count"\n'


def begun(rig: Rig) -> tuple[Running, Running, str]:
    """Return an agent with two tasks, an agent that it has met, and the configuration of that one and of a third."""
    rig.install("count", "[pancakes.tasks]\ncount.Count = plugin_count:Count\n", SOURCE)
    b = rig.ready("b")
    c = rig.ready("c", agent=f'peers = ["{rig.address(b)}"]')
    peers = f'peers = ["{rig.address(b)}", "{rig.address(c)}"]\nbirth_wait_s = 300'
    a = rig.ready("a", TASKS, agent=peers)
    heard(a, "task_started task=Count")
    heard(a, "task_started task=Stays")
    return a, b, peers


def states(rig: Rig) -> dict[tuple[str, str], tuple[str, str]]:
    return {(row["agent"], row["task"]): (row["state"], row["rest"]) for row in rig.listed("task", "list")}


def end(agent: Running) -> None:
    agent.process.terminate()
    assert agent.ended() == 0


def disk_of(rig: Rig, agent: str = "a") -> Path:
    return next(path for path in (rig.directory / "state").rglob(agent) if path.is_dir())


def test_birthplace_with_an_empty_disk_asks_first(rig: Rig):
    a, b, peers = begun(rig)
    assert rig.pancakes("task", "migrate", "a/Count", "--to", "b").returncode == 0
    end(a)
    shutil.rmtree(disk_of(rig))
    address = rig.address(b)
    end(b)

    a = rig.ready("a", TASKS, agent=peers)
    heard(a, "c (agent")
    said = heard(a, "not started yet: Count, Stays")
    assert "warning" in said and address in said
    found = states(rig)
    assert found["a", "Count"] == found["a", "Stays"] == ("stopped", f"waits → {address}")
    assert troubles(rig) == {"a/Count": "waits", "a/Stays": "waits"}
    code, row, _ = recovered(rig, "a/Count")
    assert code == 1 and row["proposal"]["text"] == f"start {address}, or correct peers in [agent] of a"
    code, row, _ = recovered(rig, "a/Stays", "--not-here", "--yes")
    assert (code, row["done"]) == (1, "") and "pancakes task stop a/Stays" in row["proposal"]["text"]
    assert rig.pancakes("task", "stop", "a/Stays").returncode == 0
    assert states(rig)["a", "Stays"] == ("stopped", "") and troubles(rig) == {"a/Count": "waits"}
    assert rig.pancakes("task", "start", "a/Stays").returncode == 0
    doctor = rig.pancakes("doctor", "--no-machine")
    assert "a/Count: is not born yet: a/Count is new here" in " ".join(doctor.stdout.split()), doctor.stdout

    b = rig.agent(rig.directory / "b.toml", "--set", f'agent.listen="{address}"')
    heard(a, "not_born task=Count owner=b")
    heard(a, "task_started task=Stays")
    heard(b, "task_started task=Count")
    assert states(rig)["a", "Count"] == ("stopped", "disk lost")
    doctor = rig.pancakes("doctor", "--no-machine")
    assert doctor.returncode == 1 and "b owns a/Count (epoch 1@b)" in " ".join(doctor.stdout.split()), doctor.stdout
    assert rig.pancakes("task", "migrate", "b/Count", "--to", "a").returncode == 0
    assert states(rig)["a", "Count"] == ("running", "")
