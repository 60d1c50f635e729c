"""Checks of missions in virtual time that are independent of the demos' own judges.

Each function flies one mission over a network with latency, jitter and links that break, and judges it twice: by its
demo, and by what is computed here from its files.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import pytest
from demo.flights import SCAN, Flight, fly

from pancakes.util.plugins import Plugins

KHEPERA_RADIUS_M, BUG_RADIUS_M, MOVER_RADIUS_M = 0.065, 0.06, 0.1
KHEPERA_BASE_M, KHEPERA_WHEEL_MPS = 0.0885, 48_000 / 144.01 / 1000
FULL_V, EMPTY_V = 8.4, 6.6
HOLD_S = 0.6
"""A command is good for half a second, and a row comes every twentieth."""


def passed(demo: str, seed: int, out: Path) -> Flight:
    """Flies a mission with faults of the network, which must pass by its demo's own judgement."""
    flight = fly(demo, seed, out, faults=True)
    assert flight.summary["reasons"] == []
    assert flight.summary["verdict"] == "PASS"
    return flight


def check_encirclement(seed: int, out: Path) -> Flight:
    """Flies the experiment of the paper, and checks all of it."""
    flight = passed("encirclement", seed, out)
    assert flight.told("peer_down"), "no link broke, so this shows nothing"
    check_paper_story(flight)
    check_summary_against_files(flight)
    check_distances(flight)
    check_kinematics(flight)
    check_batteries(flight)
    return flight


def check_paper_story(flight: Flight) -> None:
    """Agent 1 circles the sensor, asks its neighbours, hands over to agent 2, and drives home (Figures 4 to 6)."""
    summary = flight.summary
    assert [holder["agent"] for holder in summary["holders"]] == ["agent1", "agent2"]
    assert 120.0 <= summary["holders"][0]["end_s"] <= 180.0
    assert {bid["agent"] for bid in summary["bids"]} == {"agent2"}
    assert [refusal["agent"] for refusal in summary["refusals"]] == ["sensor"]
    assert "motors" in summary["refusals"][0]["reason"]
    # The sensor really was asked, and said so itself.
    assert [event["reason"] for event in flight.told("migration_refused", "sensor")] == [
        summary["refusals"][0]["reason"]
    ]
    saving = flight.told("saving_power", "agent1")
    slowed = {event["task"]: event["rate_hz"] for event in flight.told("rate_changed", "agent1")}
    assert len(saving) == 1
    assert set(slowed) == {"PoseSharing", "Discovery"} and max(slowed.values()) <= 1.0
    assert not flight.told("rate_changed", "agent2")
    # The state that arrived is the one that agent 1 had: the centre that it learnt, and its revolutions.
    state = summary["state_moved"]
    learnt = flight.told("new_centre", "agent1")[-1]
    assert state["centre_m"] == pytest.approx([learnt["x_m"], learnt["y_m"]], abs=1e-6)
    counted = [event["count"] for event in flight.told("revolution", "agent1")]
    assert counted == list(range(1, len(counted) + 1))
    assert counted[-1] <= state["revolutions"] < counted[-1] + 1
    assert flight.told("revolution", "agent2")[0]["count"] == counted[-1] + 1
    # Each robot is driven by one task after the other, and the reserve by none before its time.
    tasks = [moment.driven_by for moment in flight.paths["agent1"] if moment.driven_by]
    assert [one for one, before in zip(tasks, ["", *tasks], strict=False) if one != before] == [SCAN, "GoHome"]
    assert {moment.driven_by for moment in flight.paths["agent2"]} == {"", SCAN}
    assert all(moment.driven_by == "" for name in ("sensor", "mover") for moment in flight.paths[name])


def check_summary_against_files(flight: Flight) -> None:
    """Radius errors, gap, overlap and home error follow from `trajectory.csv`."""
    summary = flight.summary
    circle = summary["circle"]
    centre = (circle["x_m"], circle["y_m"])
    assert centre == flight.paths["sensor"][0].place and circle["radius_m"] == 0.55
    for robot in ("agent1", "agent2"):
        errors = flight.radius_errors(robot, centre, circle["radius_m"])
        told = summary["radius_error_m"][robot]
        assert told["mean"] == pytest.approx(sum(errors) / len(errors), abs=0.001)
        assert told["max"] == pytest.approx(max(errors), abs=0.002)
        assert told["mean"] <= 0.02
    gap_s = flight.gap_s("agent1", "agent2")
    assert summary["gap_s"] == pytest.approx(gap_s, abs=1e-6) and 0.0 < gap_s <= 0.5
    assert summary["overlap_s"] == 0.0 and not flight.both_drove("agent1", "agent2")
    start, end = flight.paths["agent1"][0], flight.paths["agent1"][-1]
    assert summary["homes"]["agent1"] == {"x_m": start.x_m, "y_m": start.y_m}
    assert summary["home_error_m"] == pytest.approx(math.dist(start.place, end.place), abs=1e-6)
    assert summary["home_error_m"] <= 0.10 and end.v_mps == 0.0


def check_distances(flight: Flight) -> None:
    """All bodies are solid discs: how near they came is geometry."""
    assert flight.summary["collisions"] == 0 and flight.summary["out_of_bounds"] == 0
    for robot in ("agent1", "agent2"):
        assert flight.clearance_m(robot, "sensor", KHEPERA_RADIUS_M + BUG_RADIUS_M) > 0.0
        assert flight.clearance_m(robot, "mover", KHEPERA_RADIUS_M + MOVER_RADIUS_M) > 0.1
        for moment in flight.paths[robot]:
            assert abs(moment.x_m) <= 2.0 - KHEPERA_RADIUS_M and abs(moment.y_m) <= 1.5 - KHEPERA_RADIUS_M
    assert flight.clearance_m("agent1", "agent2", 2 * KHEPERA_RADIUS_M) > 0.0
    # The mover walks, and not among the robots on the circle.
    assert flight.way_m("mover") > 10.0
    assert min(math.hypot(*moment.place) for moment in flight.paths["mover"]) > 0.55 + KHEPERA_RADIUS_M
    assert flight.told("motion_detected", "sensor")


def check_kinematics(flight: Flight) -> None:
    """Wheels keep to their limits, and a robot goes where its wheels take it: along its heading, at their speed."""
    for robot in ("agent1", "agent2"):
        for row, after in pairwise(flight.paths[robot]):
            turn_mps = 0.5 * KHEPERA_BASE_M * abs(row.omega_radps)
            assert abs(row.v_mps) + turn_mps <= KHEPERA_WHEEL_MPS + 1e-6
            step_s = after.t_s - row.t_s
            assert 0.0 < step_s <= 0.1 + 1e-6, "rows come at 10 Hz or more"
            assert math.dist(row.place, after.place) <= max(abs(row.v_mps), abs(after.v_mps)) * step_s + 0.002
            if not row.driven_by:
                assert row.v_mps == 0.0 and row.omega_radps == 0.0, "in safe hold the wheels stand"


def check_batteries(flight: Flight) -> None:
    """The true voltage only falls; what the agents do at 90 % and 65 % happens where it is 90 % and 65 %."""
    for robot in ("agent1", "agent2"):
        volts = [moment.battery_v for moment in flight.paths[robot] if moment.battery_v is not None]
        assert len(volts) == len(flight.paths[robot])
        assert all(later <= earlier for earlier, later in pairwise(volts))
        assert all(EMPTY_V < volt <= FULL_V for volt in volts)
    for (event,), level in (
        (flight.told("saving_power", "agent1"), 0.90),
        (flight.told("migration_asked", "agent1"), 0.65),
    ):
        then = next(moment for moment in flight.paths["agent1"] if moment.t_s >= event["t_s"])
        assert then.battery_v is not None
        assert (then.battery_v - EMPTY_V) / (FULL_V - EMPTY_V) == pytest.approx(level, abs=0.01)
    assert all(moment.battery_v is None for name in ("sensor", "mover") for moment in flight.paths[name])


def check_pioneer(seed: int, out: Path) -> None:
    """Flies the same tasks on other robots, by configuration only."""
    flight = passed("pioneer", seed, out)
    assert [holder["agent"] for holder in flight.summary["holders"]] == ["agent1", "agent2"]
    base_m, radius_m = 0.33, flight.summary["circle"]["radius_m"]
    for robot in ("agent1", "agent2"):
        errors = flight.radius_errors(robot, (0.0, 0.0), radius_m)
        assert sum(errors) / len(errors) <= 0.03
        fastest_mps = max(abs(moment.v_mps) for moment in flight.paths[robot])
        assert fastest_mps > 0.2, "it is no Khepera"
        for moment in flight.paths[robot]:
            assert abs(moment.v_mps) + 0.5 * base_m * abs(moment.omega_radps) <= 0.7 * 1.05
    assert 0.0 < flight.gap_s("agent1", "agent2") <= 0.5 and not flight.both_drove("agent1", "agent2")


def check_intruder(seed: int, out: Path) -> None:
    """Flies the mission in which motion starts the task, and the circle follows the intruder."""
    flight = passed("intruder", seed, out)
    detected_s = flight.told("motion_detected", "sensor")[0]["t_s"]
    started_s = flight.told("task_started", "agent1", task=SCAN)[0]["t_s"]
    first_s = flight.driven("agent1", SCAN)[0].t_s
    assert detected_s <= started_s <= first_s + 0.1 and started_s - detected_s < 1.0
    assert not any(moment.driven_by for moment in flight.paths["agent1"] if moment.t_s < detected_s)
    assert len(flight.told("new_centre", "agent1")) >= 3
    # From when it had time to settle, agent 1 keeps the radius of its circle from where the intruder really is.
    pairs = zip(flight.paths["agent1"], flight.paths["intruder"], strict=True)
    off_m = [abs(math.dist(one.place, other.place) - 0.55) for one, other in pairs if one.t_s > started_s + 30.0]
    assert sum(off_m) / len(off_m) <= 0.15
    assert flight.clearance_m("agent1", "intruder", KHEPERA_RADIUS_M + MOVER_RADIUS_M) > 0.0


def check_rescue(seed: int, out: Path) -> None:
    """Flies the mission in which the robot that circles is killed, and another one continues."""
    flight = passed("rescue", seed, out)
    lost_s = flight.told("agent_lost", "agent1")[0]["t_s"]
    assert lost_s == pytest.approx(Plugins().get("pancakes.demos", "rescue").loss.times(seed, 300.0)[0].at_s, abs=1e-3)
    assert flight.driven("agent2", SCAN)[0].t_s - lost_s == pytest.approx(flight.summary["without_s"], abs=1e-6)
    assert 1.0 < flight.summary["without_s"] <= 3.5
    check_only_copy(flight, HOLD_S)
    check_copy_continues(flight)
    # The robot that was killed stands where its last command ended, to the end.
    stood = [moment.place for moment in flight.paths["agent1"] if moment.t_s > lost_s + HOLD_S]
    assert len(set(stood)) == 1
    assert flight.told("agent_returned", "agent1")[0]["t_s"] == pytest.approx(lost_s + 60.0, abs=1e-3)
    assert flight.told("ready", "agent1")[-1]["t_s"] > lost_s + 60.0, "what it says when it is back, it says now"
    assert flight.summary["collisions"] == 0


def check_only_copy(flight: Flight, hold_s: float) -> None:
    """Never do the wheels of two robots follow the task; those of the first do so never again."""
    lost_s = flight.told("agent_lost", "agent1")[0]["t_s"]
    assert not flight.both_drove("agent1", "agent2")
    assert flight.driven("agent1", SCAN)[-1].t_s <= lost_s + hold_s
    assert [event["agent"] for event in flight.told("task_started", task=SCAN)] == ["agent2"]
    assert not flight.told("task_stopped", task=SCAN) and not flight.told("command_refused")


def check_copy_continues(flight: Flight, newer_s: float = 0.0) -> None:
    """The revolutions do not start again, and no motion has to be sensed before the second robot drives.

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
