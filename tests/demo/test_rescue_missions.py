"""The mission in which the robot that circles is killed: in virtual time, and with real processes.

Each mission is judged twice: by its demo, and by what these tests make of its files with code of their own.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from demo.flights import SCAN, Flight, fly, read_flight
from demo.live_demo import LiveDemo

from pancakes.runtime.plugins import Plugins
from pancakes.tools.demo.conductor import Mission
from pancakes.tools.demo.demo_plan import find_configs, make_plan
from pancakes.tools.demo.launcher import fresh, run_virtual
from pancakes.tools.web.virtual_watch import VirtualWatch

FILES = ("events.jsonl", "trajectory.csv", "summary.json")
HOLD_S = 0.6
"""A command is good for half a second, and a row comes every twentieth."""


@pytest.mark.timeout(300)
@pytest.mark.parametrize("seed", range(1, 6))
def test_another_robot_goes_on_with_latency_and_broken_links(seed: int, tmp_path: Path) -> None:
    flight = fly("rescue", seed, tmp_path, faults=True)
    assert flight.summary["reasons"] == []
    assert flight.summary["verdict"] == "PASS"
    lost_s = flight.told("agent_lost", "agent1")[0]["t_s"]
    assert lost_s == pytest.approx(Plugins().get("pancakes.demos", "rescue").loss.at_s(seed), abs=1e-3)
    assert flight.driven("agent2", SCAN)[0].t_s - lost_s == pytest.approx(flight.summary["without_s"], abs=1e-6)
    assert 1.0 < flight.summary["without_s"] <= 3.5
    the_copy_is_the_only_one(flight, HOLD_S)
    the_copy_goes_on_where_the_first_was(flight)
    # The robot that was killed stands where its last command ended, to the end.
    stood = [moment.place for moment in flight.paths["agent1"] if moment.t_s > lost_s + HOLD_S]
    assert len(set(stood)) == 1
    assert flight.told("agent_returned", "agent1")[0]["t_s"] == pytest.approx(lost_s + 60.0, abs=1e-3)
    assert flight.told("ready", "agent1")[-1]["t_s"] > lost_s + 60.0, "what it says when it is back, it says now"
    assert flight.summary["collisions"] == 0


def the_copy_is_the_only_one(flight: Flight, hold_s: float) -> None:
    """Never do the wheels of two robots follow the task; those of the first do so never again."""
    lost_s = flight.told("agent_lost", "agent1")[0]["t_s"]
    assert not flight.both_drove("agent1", "agent2")
    assert flight.driven("agent1", SCAN)[-1].t_s <= lost_s + hold_s
    assert [event["agent"] for event in flight.told("task_started", task=SCAN)] == ["agent2"]
    assert not flight.told("task_stopped", task=SCAN) and not flight.told("command_refused")


def the_copy_goes_on_where_the_first_was(flight: Flight, newer_s: float = 0.0) -> None:
    """The revolutions do not begin anew, and no motion has to be sensed before the second robot drives.

    Args:
        flight: the mission.
        newer_s: what the first robot told in so many seconds before its end, the second one may tell again.
    """
    (arrived,) = flight.told("task_arrived", "agent2", task=SCAN)
    kept = math.floor(arrived["state"]["revolutions"])
    kept_s = flight.told("agent_lost", "agent1")[0]["t_s"] - newer_s
    before = [it["count"] for it in flight.told("revolution", "agent1") if it["count"] <= kept or it["t_s"] < kept_s]
    after = [event["count"] for event in flight.told("revolution", "agent2")]
    assert arrived["source_agent"] == "agent1"
    assert kept == before[-1]
    assert before + after == list(range(1, after[-1] + 1))
    assert math.hypot(*arrived["state"]["centre_m"]) < 0.02


def begin(out: Path, hash_seed: int, *more: str) -> subprocess.Popen[str]:
    """Starts a mission as a person would, in a process of its own."""
    command = [sys.executable, "-m", "pancakes.tools.cli.main", "demo", "rescue", "--virtual", "--faults"]
    return subprocess.Popen(
        [*command, "--seed", "2", "--duration", "170", "--out", str(out), *more],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONHASHSEED": str(hash_seed)},
    )


@pytest.mark.timeout(300)
def test_the_same_seed_gives_the_same_bytes_also_where_it_is_recorded(tmp_path: Path) -> None:
    # It is shorter than it should be: that, and nothing else, the verdict says.
    begun = [begin(tmp_path / "one", 1), begin(tmp_path / "again", 2, "--record")]
    try:
        for process in begun:
            said, _ = process.communicate(timeout=300)
            assert process.returncode == 1 and "of the circle was covered" in said, said
    finally:
        for process in begun:
            process.kill()
            process.communicate()
    assert len(read_flight(tmp_path / "one").summary["reasons"]) == 1
    for name in FILES:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    assert (tmp_path / "one" / "paths.png").read_bytes().startswith(b"\x89PNG")
    recordings = [path for path in (tmp_path / "again" / "recording").iterdir() if path.name.startswith("agent1")]
    assert len(recordings) == 2, "one of each life"


def test_a_page_sees_the_killed_agent_again_when_it_is_back(tmp_path: Path) -> None:
    demo = Plugins().get("pancakes.demos", "rescue")
    duration_s = demo.loss.at_s(2) + demo.loss.away_s + 10.0
    plan = make_plan(demo, find_configs(demo), tmp_path, 2, 1.0, duration_s, (), live=False)
    fresh(tmp_path)
    mission = Mission(demo.agents, duration_s)
    watch = VirtualWatch(40.0, threading.Event())
    run_virtual(plan, mission, threading.Event(), None, watch)
    with watch.feed.lock:
        running = {(agent, task) for agent, _, task in watch.feed.model.running()}
        agent, motors = (watch.feed.model.board.get(key) for key in ("agent/agent1", "task/agent1/device/motors"))
    assert ("agent2", SCAN) in running and ("agent1", SCAN) not in running
    assert (agent["state"], motors["state"]) == ("ready", "running")
    assert mission.running["agent1"] == [] and mission.running["agent2"] == [SCAN]


def test_a_task_that_waits_for_a_person_is_not_rescued(tmp_path: Path) -> None:
    flight = fly("rescue", 2, tmp_path, faults=False, sets=['agent1:task.ScanTarget.takeover="ask"'])
    assert flight.summary["verdict"] == "FAIL"
    assert "no agent went on with ScanTarget after agent1 was killed" in flight.summary["reasons"]
    assert "agent1 ran ScanTarget after agent1 came back" in flight.summary["reasons"], "it goes on from its own disk"
    assert not any("did not run" in reason for reason in flight.summary["reasons"])


class LiveRescue(LiveDemo):
    """`pancakes demo rescue --headless`."""

    name = "rescue"


def test_a_live_agent_that_is_killed_comes_back_to_a_task_that_another_has(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with LiveRescue(out, "--speed", "8", "--duration", "200", "--seed", "2", "--local") as demo:
        demo.wait_for("new centre")
        first = demo.agents["agent1"].pid
        demo.wait_for("agent1 is started again, on its disk")
        assert demo.agents["agent1"].pid != first
        demo.ends()
        assert demo.left_after(0.0) == []
    flight = read_flight(out)
    summary = flight.summary
    # How soon it is taken over is the machine's; so short a mission leaves the circle uncovered. It says nothing else.
    assert all("first command" in reason or "was covered" in reason for reason in summary["reasons"]), demo.said
    lost_s = flight.told("agent_lost", "agent1")[0]["t_s"]
    assert lost_s >= Plugins().get("pancakes.demos", "rescue").loss.at_s(2)
    assert [holder["agent"] for holder in summary["holders"]] == ["agent1", "agent2"]
    assert summary["taken_by"] == "agent2" and summary["without_s"] > 0.0
    assert flight.told("agent_returned", "agent1")[0]["t_s"] < flight.told("ready", "agent1")[-1]["t_s"] < 200.0
    the_copy_is_the_only_one(flight, 8.0)
    # A checkpoint may be a second old, of which a mission at this speed has eight.
    the_copy_goes_on_where_the_first_was(flight, 8.0)
    assert "agent1 is killed" in demo.said and "ended with exit code" not in demo.said
