"""The model that a page shows, made from packets and descriptions of agents, without a socket."""

import math
from typing import Any

import numpy as np
import pytest
from web.samples import agent, describe, packet, record, task, world

from pancakes.client.rates import RateMeter
from pancakes.devices import Battery, DockState, Infrared, LaserScan, Motion, Pose
from pancakes.events import Event
from pancakes.tools.web.fleet_model import MOST_RAYS, TRAIL, FleetModel


@pytest.fixture
def model() -> FleetModel:
    return FleetModel()


def test_world_state_shows_bodies_and_mission_time(model: FleetModel):
    describe(model, agent("world", role="environment", speed=5.0))
    model.hear("world", world(40.0, a=(1.0, 2.0)), t=8.0)

    assert model.board.get("body/a") == [1.0, 2.0, 0.5, "Drive"]
    assert model.board.get("shape/a") == {"kind": "robot"}
    assert model.mission_s(8.0) == 40.0
    assert model.mission_s(9.0) == 45.0  # it goes on five times as fast


def test_without_a_world_own_poses_are_shown(model: FleetModel):
    model.hear("a", packet("a/device/pose", "system", "pose", Pose(1.0, 2.0, 0.3)), 0.0)
    model.hear("a", packet("a/client/Guess", "system", "pose", Pose(9.0, 9.0, 0.0)), 0.0)

    assert model.board.get("body/a") == [1.0, 2.0, 0.3, ""]


def test_world_state_replaces_poses(model: FleetModel):
    model.hear("world", world(0.0, a=(1.0, 2.0)), 0.0)
    model.hear("a", packet("a/device/pose", "system", "pose", Pose(1.1, 2.1, 0.3)), 0.0)

    assert model.board.get("body/a")[:2] == [1.0, 2.0]


def test_trail_points_are_spaced_and_limited(model: FleetModel):
    for number in range(3 * TRAIL):
        model.hear("world", world(0.0, a=(0.01 * number, 0.0)), 0.0)

    trail = model.trails["a"]
    assert len(trail) == TRAIL
    assert min(other[0] - one[0] for one, other in zip(trail, list(trail)[1:], strict=False)) >= 0.02 - 1e-9


def test_battery_and_range_readings_are_shown(model: FleetModel):
    model.hear("a", packet("a/device/battery", "system", "battery", Battery(7.987, 0.6543)), 0.0)
    model.hear("a", packet("a/device/ir", "system", "ir", Infrared((0.0, 1.0), (0.1, 0.2), 0.2)), 0.0)
    model.hear("s", packet("s/device/motion", "system", "motion", Motion(True, 0.5, None)), 0.0)

    assert model.board.get("battery/a") == [7.99, 0.654]
    assert model.board.get("ring/a/ir") == {"bearings_rad": [0.0, 1.0], "max_m": 0.2}
    assert model.board.get("rays/a/ir") == [0.1, 0.2]
    assert model.board.get("motion/s") == [True, 0.5, None]


def test_a_laser_scan_is_drawn_by_its_nearest_rays(model: FleetModel):
    ranges_mm = tuple(4000 if ray % 4 else 1000 + ray for ray in range(4 * MOST_RAYS - 2)) + (0, 0)
    scan = LaserScan(-1.0, 0.01, ranges_mm, 4.0)
    model.hear("a", packet("a/device/laser", "system", "laser_scan", scan), 0.0)

    bearings = model.board.get("ring/a/laser_scan")["bearings_rad"]
    assert len(bearings) == MOST_RAYS
    assert bearings[:2] == [-1.0, -0.96]
    assert model.board.get("rays/a/laser_scan")[:2] == [1.0, 1.004]


def test_rays_that_measured_nothing_are_not_drawn(model: FleetModel):
    model.hear("a", packet("a/device/laser", "system", "laser_scan", LaserScan(0.0, 0.5, (0, 500, 4000), 4.0)), 0.0)

    assert model.board.get("ring/a/laser_scan") == {"bearings_rad": [0.5, 1.0], "max_m": 4.0}
    assert model.board.get("rays/a/laser_scan") == [0.5, 4.0]


def test_card_shows_rates_lateness_and_drops(model: FleetModel):
    rates = RateMeter()
    describe(model, agent("a", task("a", "T", rate_hz=10.0), mission_s=0.0), rates=rates)
    late = task("a", "T", rate_hz=10.0, ticks=45, lateness_sum_s=0.09, missed=5, dropped=3)
    describe(model, agent("a", late, mission_s=5.0), rates=rates)

    row = model.board.get("task/a/client/T")
    assert (row["rate_hz"], row["achieved_hz"], row["late_ms"]) == (10.0, 9.0, 2.0)
    assert (row["missed"], row["dropped"]) == (5, 3)
    assert model.board.get("agent/a")["dropped"] == 3


def test_card_shows_the_version(model: FleetModel):
    process = {"version": "0.1.0", "build": "", "processor_s": 1.0, "memory_mib": 50.0, "threads": 5, "uptime_s": 9.0}
    deployed = agent("a", process={**process, "build": "0.1.0-aa"})
    describe(model, deployed, agent("b", process=process), agent("c"))
    assert [model.board.get(f"agent/{name}")["version"] for name in "abc"] == ["0.1.0-aa", "0.1.0", None]


def test_resting_task_shows_the_reason(model: FleetModel):
    describe(model, agent("a", task("a", "T", state="stopped", rest="moved → b"), task("a", "R")))
    assert model.board.get("task/a/client/T")["rest"] == "moved → b"
    assert "rest" not in model.board.get("task/a/client/R")

    model.tell(record("a", "task_started", 1.0, task="T", service="client"), 1.0)
    assert model.board.get("task/a/client/T")["state"] == "running"
    assert "rest" not in model.board.get("task/a/client/T")


def test_task_without_a_robot_is_shown(model: FleetModel):
    """The allocation has found no robot for it, or its agent takes no part in it."""
    described = agent("a", task("a", "Walk"), task("a", "Wait"), unplaced={"b/Walk": "no robot has the energy"})
    describe(model, described)
    assert model.board.get("task/a/client/Walk")["unplaced"] == "no robot has the energy"
    assert "unplaced" not in model.board.get("task/a/client/Wait")


def test_halted_agent_and_filters_are_shown(model: FleetModel):
    held = {"filter": "apart", "doing": "holds", "why": "no pose", "passed": 3, "for_s": 1.0}
    motors = task("a", "motors", "device", device="motors", rest="halted", filters=[held])
    halt = {"number": 1, "origin": "b", "by": "alice.1/x", "reason": "a child", "spread": True}
    describe(model, agent("a", motors, halt=halt), agent("b", halt=None))
    assert model.board.get("agent/a")["halt"] == "halted by alice.1: a child"
    assert "halt" not in model.board.get("agent/b")
    row = model.board.get("task/a/device/motors")
    assert (row["rest"], row["filters"]) == ("halted", [{"filter": "apart", "doing": "holds", "why": "no pose"}])


def test_links_appear_and_disappear_with_agents(model: FleetModel):
    describe(model, agent("b", peers={"a": 0.0021}), agent("a", peers={"b": 0.0019}))
    assert model.board.keys("link/") == ["link/a/b"]
    assert model.board.get("link/a/b") == 1.9  # as the one of the lower name measured it

    describe(model, agent("a"))
    assert model.board.keys("link/") == []


def test_silent_agent_keeps_its_tasks(model: FleetModel):
    rates = RateMeter()
    describe(model, agent("a", task("a", "T")), rates=rates)
    describe(model, rates=rates)

    assert model.board.get("agent/a")["state"] == "no answer"
    assert model.board.get("task/a/client/T") is not None


def test_migration_is_shown_before_the_next_description(model: FleetModel):
    describe(model, agent("a", task("a", "T")), agent("b"))
    model.tell(record("a", "task_stopped", 1.0, task="T", service="client", reason="handed over to b"), 1.0)
    assert model.board.get("task/a/client/T")["state"] == "stopped"
    model.tell(record("b", "task_started", 1.01, task="T", service="client", type="x.T"), 1.01)
    model.tell(record("a", "task_handed_over", 1.02, task="T", to="b"), 1.02)

    assert model.board.get("task/a/client/T") is None
    assert model.board.get("task/b/client/T") == {"type": "x.T", "state": "running"}


def test_removed_task_leaves_the_card(model: FleetModel):
    describe(model, agent("a", task("a", "T")))
    describe(model, agent("a"))

    assert model.board.keys("task/") == []


def test_circle_is_shown_while_its_task_runs(model: FleetModel):
    describe(model, agent("a", task("a", "T")))
    detail: dict[str, Any] = {"service": "client", "task": "T", "settings": {"radius_m": 0.5}, "requires": ["motors"]}
    model.detail("a", {**detail, "state": {"centre_m": None}})
    assert model.board.get("circle/a/T") is None

    model.detail("a", {**detail, "state": {"centre_m": [1.0, 2.0]}})
    assert model.board.get("circle/a/T") == [1.0, 2.0, 0.5]
    assert model.board.get("task/a/client/T")["requires"] == ["motors"]

    model.detail("a", {**detail, "state": {"centre_m": np.array([3.0, 4.0])}})
    assert model.board.get("circle/a/T") == [3.0, 4.0, 0.5]

    model.tell(record("a", "task_stopped", task="T", reason="asked"), 0.0)
    assert model.board.get("circle/a/T") is None


def test_world_settings_give_arena_and_sizes(model: FleetModel):
    describe(model, agent("world", task("world", "World"), role="environment"))
    settings = {
        "arena": {"width_m": 4.0, "height_m": 3.0},
        "robots": {"a": {"model": "khepera3"}, "p": {"model": "pioneer3dx"}},
        "sensors": {"s": {"radius_m": 0.06, "motion": {"range_m": 2.5}}},
        "movers": {"m": {"radius_m": 0.1}},
    }
    model.detail("world", {"service": "client", "task": "World", "settings": settings, "state": {}})

    assert model.board.get("arena") == [4.0, 3.0]
    assert model.board.get("shape/a") == {"kind": "robot", "radius_m": 0.065}
    assert model.board.get("shape/p")["laser_m"] == 0.02, "its laser scanner is ahead of its middle"
    assert model.board.get("shape/s") == {"kind": "sensor", "radius_m": 0.06, "range_m": 2.5}
    assert model.board.get("shape/m") == {"kind": "mover", "radius_m": 0.1}


def test_world_of_an_unknown_simulator_is_shown_without_sizes(model: FleetModel):
    describe(model, agent("world", task("world", "World"), role="environment"))
    settings = {
        "arena": {"width_m": 4.0, "height_m": 3.0},
        "robots": {"a": {"model": "not-installed-here"}, "b": {"radius_m": 0.2}, "c": {}},
        "sensors": {"s": {}},
        "movers": "none",
    }
    model.detail("world", {"service": "client", "task": "World", "settings": settings, "state": {}})

    assert model.board.get("arena") == [4.0, 3.0]
    assert model.board.get("shape/a") == model.board.get("shape/c") == {"kind": "robot"}
    assert model.board.get("shape/b") == {"kind": "robot", "radius_m": 0.2}
    assert model.board.get("shape/s") == {"kind": "sensor"}


def test_bids_and_refusals_are_events(model: FleetModel):
    bid = Event("migration_bid", {"task": "T", "source_agent": "a", "cost": 2.0, "terms": {}})
    model.hear("b", packet("b/network/TaskMigrator", "log", "event", bid, 3.0), 1.0)
    refusal = Event("migration_refused", {"task": "T", "source_agent": "a", "reason": "lacks motors"})
    model.hear("s", packet("s/network/TaskMigrator", "log", "event", refusal, 3.0), 1.0)

    events = model.events.since(0)
    assert [it["text"] for it in events] == ["b bids 2 for T", "s refuses T: lacks motors"]
    assert (events[0]["source_agent"], events[0]["cost"], events[0]["t"], events[0]["m"]) == ("a", 2.0, 1.0, 3.0)


def test_earlier_records_are_placed_in_the_past_once(model: FleetModel):
    describe(model, agent("a", speed=2.0, mission_s=20.0), t=5.0)
    model.tell(record("a", "ready", t_s=16.0), 4.9)
    model.recall([record("a", "saved", t_s=10.0), record("a", "ready", t_s=16.0)], 5.0)

    assert [(it["kind"], it["t"]) for it in model.events.since(0)] == [("ready", 4.9), ("saved", 0.0)]


def test_only_the_newest_events_are_kept():
    from pancakes.tools.web.fleet_model import EventLog

    events = EventLog(limit=3)
    for number in range(5):
        events.add(record("a", f"kind{number}", float(number)), 0.0)

    assert [it["n"] for it in events.since(0)] == [3, 4, 5]
    assert [it["n"] for it in events.since(4)] == [5]


def test_new_rate_replaces_the_achieved_rate(model: FleetModel):
    rates = RateMeter()
    describe(model, agent("a", task("a", "T", rate_hz=10.0)), rates=rates)
    describe(model, agent("a", task("a", "T", rate_hz=10.0, ticks=50), mission_s=5.0), rates=rates)
    assert model.board.get("task/a/client/T")["achieved_hz"] == 10.0
    model.tell(record("a", "rate_changed", task="T", rate_hz=2.0, by="cli"), 5.0)

    row = model.board.get("task/a/client/T")
    assert (row["rate_hz"], row["achieved_hz"]) == (2.0, None)


def guarding(permit_s: float, *silent_s: float) -> dict[str, Any]:
    """Return an owner's report on its guardians b, c, ..., each with the time that it has been silent."""
    members = [
        {"agent": name, "checkpoint": 7, "age_s": 0.4321, "silent_s": it}
        for name, it in zip("bcd", silent_s, strict=False)
    ]
    about = {"epoch": "0@a", "guard": 3, "lease_s": 2.0, "checkpoint": 7, "age_s": 0.4321, "answering": 2}
    return {**about, "permit_s": permit_s, "guardians": members}


def test_guarded_task_shows_guardians_and_permit(model: FleetModel):
    describe(model, agent("a", task("a", "T", guarding=guarding(1.234, 0.1, 0.2, 9.0)), task("a", "R")))
    shown = model.board.get("task/a/client/T")["guards"]
    assert shown == {
        "wanted": 3,
        "permit_s": 1.2,
        "age_s": 0.43,
        "by": [["b", 0.43, True], ["c", 0.43, True], ["d", 0.43, False]],
    }
    assert "guards" not in model.board.get("task/a/client/R")


def test_guarded_task_without_a_permit_is_shown_paused(model: FleetModel):
    stands = task("a", "T", rest="paused", guarding=guarding(0.0, 9.0, 9.0))
    describe(model, agent("a", stands))
    row = model.board.get("task/a/client/T")
    assert (row["state"], row["rest"], row["guards"]["permit_s"]) == ("running", "paused", 0.0)
    describe(model, agent("a", task("a", "T", guarding=guarding(1.0, 0.1, 0.1))))
    assert "rest" not in model.board.get("task/a/client/T")


def test_a_battery_that_is_charged_and_the_dock_that_does_it_are_shown(model: FleetModel):
    model.hear("a", packet("a/device/battery", "system", "battery", Battery(7.987, 0.6543, charging=True)), 0.0)
    dock = packet("d/device/dock", "system", "dock_state", DockState("charging", 1.0, -0.5, "a"))
    model.hear("d", dock, 0.0)
    model.hear("a", dock, 0.0)  # as a neighbour of the dock it hears it as well

    assert model.board.get("battery/a") == [7.99, 0.654, True]
    assert model.board.keys("dock/") == ["dock/d"] and model.board.get("dock/d") == [1.0, -0.5, "charging", "a"]


def test_a_reserve_and_its_trouble_are_shown(model: FleetModel):
    describe(model, agent("a", reserve={"seconds": 81.4, "trouble": "knows no dock"}))
    assert {"reserve_s": 81, "charge_trouble": "knows no dock"}.items() <= model.board.get("agent/a").items()
    describe(model, agent("a", reserve={"seconds": math.nan, "trouble": ""}))
    assert "reserve_s" not in model.board.get("agent/a")
    describe(model, agent("a", reserve=None))
    assert "reserve_s" not in model.board.get("agent/a")
