"""`pancakes task fence`, and `task recover` of a task that an actuator refuses, on a running agent."""

from __future__ import annotations

import signal

from cli.processes import Rig, recovered, troubles

from pancakes.journal import FileJournal, JournalEntry
from pancakes.util import codecs

SOURCE = """
from pancakes.devices import Twist
from pancakes.task import Task, every


class Circle(Task):
    requires = ("motors",)

    @every(hz=20)
    def drive(self, tick):
        self.publish("ctrl", Twist(0.1, 0.0))
"""
ENTRY_POINTS = "[pancakes.tasks]\ncircle.Circle = plugin_circle:Circle\n"
CONFIG = """
[device.wheels]
driver = "null.motors"
[device.load]
driver = "host.load"
rate_hz = 1
[task.Circle]
type = "circle.Circle"
"""


def test_task_fence_shows_and_corrects_a_high_epoch(rig: Rig):
    rig.install("circle", ENTRY_POINTS, SOURCE)
    agent = rig.ready("a", CONFIG)
    (row,) = rig.listed("task", "fence", "a/wheels")
    fine = {"actuator": "a/device/wheels", "task_id": "a/Circle", "brought_by": "a", "owner": "a", "owner_has": "0@a"}
    assert row == {**fine, "seen": "0@a", "obeyed": True, "reason": ""}
    assert rig.listed("task", "fence", "a/load") == []

    agent.signalled(signal.SIGTERM)
    journal = FileJournal(rig.directory / "state" / "pancakes" / "test" / "a")
    journal.write([JournalEntry("fence", "wheels", codecs.encode({"a/Circle": [7, "z", "z"]}))])
    journal.close()
    agent = rig.ready("a", CONFIG)
    agent.hear("epoch 0 of a/Circle has passed, 7 has been seen")
    (row,) = rig.listed("task", "fence", "a/device/wheels")
    assert row == {**fine, "seen": "7@z", "brought_by": "z", "obeyed": False, "reason": ""}

    doctor = rig.pancakes("doctor", "--no-machine")
    assert doctor.returncode == 1
    why = "refuses a/Circle, which a has under epoch 0@a: it has seen epoch 7@z, brought by z"
    assert f"error    a/device/wheels: {why}" in doctor.stdout

    assert "pancakes task recover a/Circle" in doctor.stdout and troubles(rig) == {"a/Circle": "disobeyed"}
    code, row, _ = recovered(rig, "a/Circle", "--dry-run")
    assert (code, row["proposal"]["act"], row["proposal"]["others"]) == (0, "obey", ["a/device/wheels"])
    assert rig.listed("task", "fence", "a/wheels")[0]["seen"] == "7@z"
    code, _, said = recovered(rig, "a/Circle")
    assert code == 1 and "after a safe hold? Lost: nothing. Only if a/Circle runs only on a" in said
    assert rig.listed("task", "fence", "a/wheels")[0]["seen"] == "7@z"
    assert recovered(rig, "a/Circle", "--yes")[1]["done"] == "obeyed"
    assert rig.listed("task", "fence", "a/wheels") == [{**fine, "seen": "0@a", "obeyed": True, "reason": ""}]
    assert "refuses a/Circle" not in rig.pancakes("doctor", "--no-machine").stdout and troubles(rig) == {}
    (account,) = rig.listed("task", "migrations", "a")
    assert (account["outcome"], account["winner"], account["task_id"]) == ("fenced", "a", "a/Circle")
    assert account["asked_by"].startswith("alice.")
    assert "fenced" in rig.pancakes("task", "migrations").stdout
