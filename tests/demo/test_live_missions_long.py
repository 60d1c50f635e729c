"""Live missions beyond the one of `test_live_mission_live`: local sockets, a slow machine, two at once."""

from __future__ import annotations

from pathlib import Path

from demo.flights import read_flight
from demo.live_demo import AGENTS, LiveDemo

WEAK_BATTERY = "world:task.World.settings.robots.agent1.battery.capacity_j=130"


def test_live_mission_migrates_the_task_over_local_sockets(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with LiveDemo(out, "--speed", "5", "--duration", "60", "--seed", "3", "--set", WEAK_BATTERY, "--local") as demo:
        demo.wait_for("new centre")
        demo.ends()
        assert demo.left_after(0.0) == []
    flight = read_flight(out)
    assert not any("broke off" in reason or "began" in reason for reason in flight.summary["reasons"]), demo.said
    assert [holder["agent"] for holder in flight.summary["holders"]] == ["agent1", "agent2"], demo.said
    assert flight.summary["overlap_s"] == 0.0 and not flight.both_drove("agent1", "agent2")


def test_live_verdict_names_a_machine_that_fell_behind(tmp_path: Path) -> None:
    with LiveDemo(tmp_path / "out", "--duration", "30") as demo:
        demo.wait_for("new centre")
        demo.agents["world"].suspend()
        demo.wait_for("pose: no reading has come for 2")
        demo.agents["world"].resume()
        demo.ends()
        (verdict,) = [line for line in demo.lines if line.startswith("verdict: ")]
    assert "this machine was too slow: the world fell behind the clock by up to" in verdict
    assert "world/client/World" in verdict and "ticks" in verdict
    timing = read_flight(tmp_path / "out").timing
    assert timing["behind_max_s"] > 0.25
    assert "world/client/World" in [it["task"] for it in timing["late_tasks"]]


def test_live_demos_run_side_by_side(tmp_path: Path) -> None:
    """The ports of the files are one demo's; the other takes free ones, even if both start at once."""
    with LiveDemo(tmp_path / "one", "--duration", "10") as one, LiveDemo(tmp_path / "two", "--duration", "10") as two:
        for demo in (one, two):
            assert demo.ends() == 1, demo.said
            assert "verdict: FAIL" in demo.said and "broke off" not in demo.said
    ports = []
    for out in (tmp_path / "one", tmp_path / "two"):
        flight = read_flight(out)
        assert {event["agent"] for event in flight.told("roster")} == set(AGENTS)
        assert flight.paths["agent1"][-1].t_s > 8.0
        log = (out / "logs" / "world.jsonl").read_text(encoding="utf-8")
        ports.append(next(line for line in log.splitlines() if "hardware bus listens" in line).rpartition(":")[2])
    assert ports[0] != ports[1]
