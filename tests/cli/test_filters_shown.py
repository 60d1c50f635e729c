"""Filters on the command line: they are shown, changed while they run, and reported if they hold an actuator."""

from __future__ import annotations

import json

from cli.processes import Rig
from cli.test_two_owners import heard

DRIVING = """
from pancakes.devices import Twist
from pancakes.task import Task, Tick, every

class Drive(Task):
    requires = ("motors",)

    @every(hz=20)
    def drive(self, tick: Tick) -> None:
        self.publish("ctrl", Twist(0.5, 0.0))
"""
CONFIG = """
[device.motors]
driver = "null.motors"
[filter.slow]
type = "limit"
device = "motors"
settings = { max_mps = 0.2 }
[filter.apart]
type = "barrier"
device = "motors"
settings = { radius_m = 0.1, max_mps = 0.2, max_radps = 3 }
[task.Drive]
type = "drive.Drive"
"""


def test_filters_are_shown_changed_and_reported(rig: Rig):
    rig.install("drive", "[pancakes.tasks]\ndrive.Drive = plugin_drive:Drive\n", DRIVING)
    heard(rig.ready("a", CONFIG), "it does not know its own pose yet")  # the first command has passed both
    told = rig.pancakes("task", "info", "a/motors").stdout
    assert "it does not know its own pose yet" in told and "too fast" in told
    (found,) = json.loads(rig.pancakes("task", "info", "a/motors", "--format", "json").stdout)
    assert [(it["filter"], it["doing"]) for it in found["filters"]] == [("slow", "changes"), ("apart", "holds")]
    assert found["settings"]["filters"]["apart"]["gap_m"] == 0.02

    findings = json.loads(rig.pancakes("doctor", "--no-machine", "--format", "json").stdout)
    (finding,) = [it for it in findings if "filter" in it["text"]]
    assert (finding["about"], finding["level"]) == ("a/motors", "warning")
    assert "its filter apart" in finding["text"] and "it does not know its own pose yet" in finding["text"]

    assert rig.pancakes("param", "set", "a/motors", "filters.slow.max_mps=1").returncode == 0
    (found,) = json.loads(rig.pancakes("task", "info", "a/motors", "--format", "json").stdout)
    assert found["settings"]["filters"]["slow"]["max_mps"] == 1.0
    refused = rig.pancakes("param", "set", "a/motors", "filters.slow.max_mps=-1")
    assert refused.returncode == 1 and "filters.slow.max_mps" in refused.stderr

    shown = rig.pancakes("config", "show", "a").stdout
    assert "[filter.apart]" in shown and 'type = "barrier"' in shown
