"""The encirclement in the Robotarium, live: each agent a process, over real sockets, the task handed over."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from demo.flights import read_flight
from demo.live_demo import LiveDemo

WEAK_BATTERY = "world:task.World.settings.robots.agent1.battery.capacity_j=100"


class LiveRobotarium(LiveDemo):
    name = "robotarium"


@pytest.mark.usefixtures("robotarium")
def test_live_mission_hands_over_in_the_robotarium(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with LiveRobotarium(out, "--speed", "5", "--duration", "75", "--seed", "3", "--set", WEAK_BATTERY) as demo:
        demo.wait_for("new centre")
        demo.ends()
        assert demo.left_after(0.0) == []
    flight = read_flight(out)
    assert [holder["agent"] for holder in flight.summary["holders"]] == ["agent1", "agent2"], demo.said
    assert flight.summary["overlap_s"] == 0.0 and not flight.both_drove("agent1", "agent2")
    theirs = json.loads((out / "robotarium.json").read_text())
    counts = theirs["counts"]
    assert counts.pop("steps") == pytest.approx(75.0 / 0.033, rel=0.05)
    assert counts == {"collision": 0, "boundary": 0, "actuator": 0, "other": 0}, demo.said
    assert not any("Robotarium" in reason for reason in flight.summary["reasons"]), demo.said
