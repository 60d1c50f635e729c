"""`pancakes task fence`, on a running agent."""

from __future__ import annotations

import signal

from cli.processes import Rig

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

    told = {"actuator": "a/device/wheels", "task_id": "a/Circle", "owner": "a", "before": "7@z", "now": "0@a"}
    (tried,) = rig.listed("task", "fence", "a/wheels", "--set", "a/Circle", "--dry-run")
    assert {**tried, "number": 0} == {**told, "done": "dry run", "number": 0}
    assert rig.listed("task", "fence", "a/wheels")[0]["seen"] == "7@z"
    unmeant = rig.pancakes("task", "fence", "a/wheels", "--set", "a/Circle")
    assert unmeant.returncode == 1 and "a/device/wheels would go to its safe hold" in unmeant.stderr
    assert rig.listed("task", "fence", "a/wheels")[0]["seen"] == "7@z"
    (done,) = rig.listed("task", "fence", "a/wheels", "--set", "a/Circle", "--force")
    assert {**done, "number": 0} == {**told, "done": "set", "number": 0}
    assert rig.listed("task", "fence", "a/wheels") == [{**fine, "seen": "0@a", "obeyed": True, "reason": ""}]
    assert "refuses a/Circle" not in rig.pancakes("doctor", "--no-machine").stdout
    (account,) = rig.listed("task", "migrations", "a")
    assert (account["outcome"], account["winner"], account["task_id"]) == ("fenced", "a", "a/Circle")
    assert account["asked_by"].startswith("alice.")
    assert "fenced" in rig.pancakes("task", "migrations").stdout

    refused = rig.pancakes("task", "fence", "a/wheels", "--set", "b/Circle")
    assert (refused.returncode, refused.stdout) == (1, "") and "adopt the task first" in refused.stderr
    assert rig.pancakes("task", "fence", "a/load", "--set", "a/Circle").returncode == 1
