"""However a live demo ends, it leaves no process behind; if an agent dies, the mission fails and names it."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path

import pytest
from demo.flights import read_flight
from demo.live_demo import AGENTS, PATIENCE_S, LiveDemo
from harness.programs import pancakes, run

UNDER_WAY = "agent1: new centre"
LIMIT_S = 2.0


def test_live_demo_stops_within_two_seconds_of_ctrl_c(tmp_path: Path) -> None:
    with LiveDemo(tmp_path / "out") as demo:
        demo.wait_for(UNDER_WAY)
        began_s = time.monotonic()
        demo.process.send_signal(signal.SIGINT)
        assert demo.ends() == 130
        assert time.monotonic() - began_s <= LIMIT_S
        assert demo.left_after(0.0) == []
        assert "no verdict" in demo.lines[-1]
    assert not (tmp_path / "out" / "summary.json").exists()


def test_live_demo_stops_at_sigterm_while_agents_start(tmp_path: Path) -> None:
    with LiveDemo(tmp_path / "out") as demo:
        demo.wait_for_agents()
        demo.process.send_signal(signal.SIGTERM)
        assert demo.ends() == 130
        assert demo.left_after(0.0) == []


def test_down_ends_a_live_demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The launcher ends the other agents as soon as one has ended: whoever ends them, all are reported as ended."""
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(tmp_path / "runtime"))
    with LiveDemo(tmp_path / "out") as demo:
        demo.wait_for(UNDER_WAY)
        down = run(pancakes("down", "--format", "json"), timeout_s=PATIENCE_S)
        assert down.returncode == 0, down.stderr
        assert {it["agent"]: it["done"] for it in json.loads(down.stdout)} == dict.fromkeys(AGENTS, "ended")
        demo.ends()


def test_live_agents_end_with_a_killed_launcher(tmp_path: Path) -> None:
    with LiveDemo(tmp_path / "out") as demo:
        demo.wait_for(UNDER_WAY)
        demo.process.kill()
        assert demo.left_after(LIMIT_S) == []


@pytest.mark.parametrize("victim", ["world", "agent1"])
def test_live_mission_fails_if_an_agent_dies(victim: str, tmp_path: Path) -> None:
    with LiveDemo(tmp_path / "out") as demo:
        demo.wait_for(UNDER_WAY)
        demo.agents[victim].kill()
        assert demo.ends(PATIENCE_S) == 1, demo.said
        assert demo.left_after(0.0) == []
    summary = read_flight(tmp_path / "out").summary
    assert summary["verdict"] == "FAIL"
    broke_off = [reason for reason in summary["reasons"] if reason.startswith("the mission broke off: ")]
    assert len(broke_off) == 1 and f"the agent {victim} " in broke_off[0]
    assert broke_off[0] in demo.said
