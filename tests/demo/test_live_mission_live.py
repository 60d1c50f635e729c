"""The experiment on real processes over TCP. What happens is checked, and not how fast this machine is."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from demo.flights import SCAN, read_flight
from demo.live_demo import AGENTS, LiveDemo

WEAK_BATTERY = "world:task.World.settings.robots.agent1.battery.capacity_j=130"
"""Agent 1's battery falls below 65 % after some 25 s, so that the task migrates soon."""


def test_live_mission_migrates_the_task_and_leaves_no_process(tmp_path: Path) -> None:
    out = tmp_path / "out"
    stale = out / "state" / "agent1"
    stale.mkdir(parents=True)
    (stale / "stale").touch()
    (out / "summary.json").write_text("{}", encoding="utf-8")
    with LiveDemo(out, "--speed", "5", "--duration", "60", "--seed", "3", "--set", WEAK_BATTERY) as demo:
        demo.wait_for("new centre")
        code = demo.ends()
        assert demo.left_after(0.0) == []
    flight = read_flight(out)
    summary = flight.summary
    # So short a mission leaves no time to settle or to park; that, and nothing else, it must say.
    assert code == (0 if summary["verdict"] == "PASS" else 1), demo.said
    assert f"verdict: {summary['verdict']}" in demo.said
    assert not any("broke off" in reason or "began" in reason for reason in summary["reasons"]), demo.said
    assert [holder["agent"] for holder in summary["holders"]] == ["agent1", "agent2"], demo.said
    assert summary["overlap_s"] == 0.0 and not flight.both_drove("agent1", "agent2")
    assert summary["gap_s"] == pytest.approx(flight.gap_s("agent1", "agent2"), abs=1e-6)
    assert [bid["agent"] for bid in summary["bids"]] == ["agent2"]
    assert [refusal["agent"] for refusal in summary["refusals"]] == ["sensor"]
    assert "motors" in summary["refusals"][0]["reason"]
    assert math.hypot(*summary["state_moved"]["centre_m"]) < 0.02
    asked = flight.told("migration_asked", "agent1")
    assert [event["by"] for event in asked] == ["rule"]
    assert flight.told("saving_power", "agent1")[0]["t_s"] < asked[0]["t_s"]
    assert flight.driven("agent1", "GoHome")[0].t_s > flight.driven("agent1", SCAN)[-1].t_s
    assert summary["collisions"] == 0 and summary["out_of_bounds"] == 0
    assert flight.way_m("mover") > 1.0
    assert flight.timing["mode"] == "live" and flight.timing["speed"] == 5.0
    assert flight.timing["wall_s"] == pytest.approx(12.0, abs=1.0)
    assert {"start_s", "behind_max_s"} <= flight.timing.keys()
    # Each agent kept its state and its log in the folder of the run, and began with nothing of an earlier one.
    assert not (stale / "stale").exists()
    assert {path.name for path in (out / "state").iterdir()} == set(AGENTS) - {"world"}, "a world has no state"
    for agent in AGENTS:
        log = (out / "logs" / f"{agent}.jsonl").read_text(encoding="utf-8").splitlines()
        assert all(json.loads(line) for line in log) and log
        assert (out / "logs" / f"{agent}.txt").read_text(encoding="utf-8") == "", "an agent wrote to its terminal"
    assert (out / "paths.png").read_bytes().startswith(b"\x89PNG")
