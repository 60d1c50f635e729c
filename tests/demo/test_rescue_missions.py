"""The rescue in virtual time with an early loss: what a page sees of it, and what is not rescued."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

from demo.flights import SCAN, fly

from pancakes.tools.demo import Loss
from pancakes.tools.demo.conductor import Mission
from pancakes.tools.demo.launcher import find_configs, fresh, make_plan, run_virtual
from pancakes.tools.web.virtual_watch import VirtualWatch
from pancakes.util.plugins import Plugins

EARLY = Loss(("agent1",), earliest_s=30.0, latest_s=30.0, away_s=15.0)
"""By then agent 1 has come to the circle, and has found the sensor node to be its centre."""
LENGTH_S = 55.0


def test_rescue_page_shows_the_returned_agent(tmp_path: Path) -> None:
    demo = replace(Plugins().get("pancakes.demos", "rescue"), loss=EARLY)
    plan = make_plan(demo, find_configs(demo), tmp_path, 2, 1.0, LENGTH_S, (), live=False)
    fresh(tmp_path)
    mission = Mission(demo.agents, LENGTH_S)
    watch = VirtualWatch(40.0, threading.Event())
    run_virtual(plan, mission, threading.Event(), None, watch)
    with watch.feed.lock:
        running = {(agent, task) for agent, _, task in watch.feed.model.running()}
        agent, motors = (watch.feed.model.board.get(key) for key in ("agent/agent1", "task/agent1/device/motors"))
    assert ("agent2", SCAN) in running and ("agent1", SCAN) not in running
    assert (agent["state"], motors["state"]) == ("ready", "running")
    assert mission.running["agent1"] == [] and mission.running["agent2"] == [SCAN]


def test_rescue_waits_if_a_person_must_be_asked(tmp_path: Path) -> None:
    sets = ['agent1:task.ScanTarget.guard.takeover="ask"']
    flight = fly("rescue", 2, tmp_path, faults=False, sets=sets, duration_s=LENGTH_S, loss=EARLY)
    assert flight.summary["verdict"] == "FAIL"
    assert not flight.told("task_started", "agent2", task=SCAN) and not flight.driven("agent2", SCAN)
    returned_s = flight.told("agent_returned", "agent1")[0]["t_s"]
    assert flight.driven("agent1", SCAN)[-1].t_s > returned_s, "the first robot continues from its own disk"
    assert not any("did not run" in reason for reason in flight.summary["reasons"])
