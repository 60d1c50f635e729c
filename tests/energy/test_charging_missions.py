"""Robots that share docks, in the simulated world: who is charged, and what happens if something is broken."""

from __future__ import annotations

import math
from typing import Any

import pytest
from energy.docks import NEED, start_docks, states_of

from pancakes.control import Create, Describe, Migrate, Start, Stop
from pancakes.devices import Dock, DockState, Reserve
from pancakes.energy.reserve import MOST_DOCKS, SILENT_S
from pancakes.packet import CTRL, NEIGHBOURS, SYSCTRL, SYSTEM, Packet, agent_of
from pancakes.task import Task
from pancakes.testing import Fleet
from pancakes.tools.cli.verbs.agent_checks import check_reserve
from pancakes.tools.cli.verbs.checks import Facts

ONE_DOCK = {"dock1": {"x_m": 0.0, "y_m": 0.0}}
TWO_DOCKS = {"dock1": {"x_m": 0.2, "y_m": 0.0}, "dock2": {"x_m": 1.0, "y_m": 0.0}}


def need(**battery: Any) -> dict[str, Any]:
    return {"battery": {**NEED, **battery}}


def test_the_robot_with_the_lowest_reserve_is_charged_first_and_the_dock_has_one_holder() -> None:
    with Fleet(1) as fleet:
        robots = {
            "a": {"x_m": 0.4, "y_m": 0.3, **need(level=0.4)},
            "b": {"x_m": -0.4, "y_m": 0.3, **need(level=0.25)},
        }
        homes = {"home_m": (0.0, 0.8), "enough": 0.9}
        start_docks(fleet, ONE_DOCK, robots, settings=homes)
        seen = states_of(fleet, "dock1")
        fleet.agents["a"].wait_for_event("charged", timeout_s=200.0)
        charged = [it for it in seen if it[0] != "free"]
        assert charged == [("taken", "b"), ("charging", "b"), ("taken", "b"), ("taken", "a"), ("charging", "a")]
        assert fleet.agents["b"].events("dock_chosen")[0]["bids"].keys() == {"a", "b"}


def test_a_battery_tells_that_it_is_charged_only_at_the_dock() -> None:
    with Fleet(1) as fleet:
        start_docks(fleet, ONE_DOCK, {"a": {"x_m": 0.3, "y_m": 0.0}})
        a = fleet.agents["a"]
        levels: list[tuple[float, bool]] = []
        a.kernel.stream.tap(SYSTEM, lambda it: levels.append((it.body.level, it.body.charging)), ("battery",))
        a.wait_for_event("left_dock", timeout_s=100.0)
        fleet.run_for(2.0)
        told = [charging for _, charging in levels]
        first, last = told.index(True), len(told) - told[::-1].index(True)
        assert first > 0 and last < len(told) and all(told[first:last])
        assert levels[last][0] > 0.9 > levels[first - 1][0]


def test_a_dock_whose_robot_is_lost_becomes_free_and_the_next_robot_gets_it() -> None:
    with Fleet(1) as fleet:
        robots = {
            "a": {"x_m": 0.4, "y_m": 0.3, **need(level=0.4)},
            "b": {"x_m": -0.6, "y_m": 0.3, **need(level=0.2)},
        }
        start_docks(fleet, ONE_DOCK, robots)
        seen = states_of(fleet, "dock1")
        fleet.agents["dock1"].wait_until(lambda: ("taken", "b") in seen, timeout_s=30.0)
        fleet.crash("b")
        fleet.agents["a"].wait_for_event("docked", timeout_s=60.0)
        assert seen[:4] == [("free", ""), ("taken", "b"), ("free", ""), ("taken", "a")]


def test_a_dock_obeys_only_the_robot_that_holds_it() -> None:
    with Fleet(1) as fleet:
        start_docks(fleet, ONE_DOCK, {"a": {"x_m": 0.3, "y_m": 0.0, **need(level=0.2)}})
        fleet.agents["a"].wait_for_event("docked", timeout_s=60.0)
        stranger = fleet.start("stranger")
        fleet.connect()
        stranger.publish(CTRL, Dock("dock1/device/dock"), to="dock1/device/dock")
        refused = fleet.agents["dock1"].wait_for_event("command_refused")
        assert (refused["by"].split("/")[0], refused["reason"]) == ("stranger", "it is held by a/device/dock")


def test_a_robot_that_stops_charging_lets_the_dock_go_at_once() -> None:
    with Fleet(1) as fleet:
        start_docks(fleet, ONE_DOCK, {"a": {"x_m": 0.3, "y_m": 0.0, **need(level=0.2)}})
        fleet.agents["a"].wait_for_event("docked", timeout_s=60.0)
        seen = states_of(fleet, "dock1")
        assert fleet.agents["a"].ask(Stop("Charge")).ok
        fleet.run_for(0.6)  # less than its `hold_after_mission_s`
        assert seen[-1] == ("free", "")


class Lamp(Task):
    """Holds the docks of its robot, and names one that is none."""

    requires = ("dock",)

    def on_start(self) -> None:
        self.publish(CTRL, Dock("somewhere"))


def test_a_command_that_names_no_dock_is_refused_with_a_sentence() -> None:
    with Fleet(1) as fleet:
        a = fleet.start("a", devices={"dock": {"type": "network.dock"}}, tasks={"Lamp": Lamp})
        assert a.wait_for_event("command_refused")["reason"].endswith("such as 'dock1/device/dock'")


def trouble_of(fleet: Fleet, robot: str) -> str:
    reserve = fleet.agents[robot].agent.host_state.describe()["reserve"]
    return str(reserve["trouble"]) if reserve is not None else ""


def test_a_dock_that_lies_is_named_and_left_for_another() -> None:
    with Fleet(1) as fleet:
        docks = {**TWO_DOCKS, "dock1": {**TWO_DOCKS["dock1"], "power_w": 0.0}}
        start_docks(fleet, docks, {"a": {"x_m": 0.0, "y_m": 0.0}})
        a = fleet.agents["a"]
        lost = a.wait_for_event("dock_lost", timeout_s=60.0)
        assert lost["reason"] == "dock1/device/dock does not charge it"
        assert trouble_of(fleet, "a") == "dock1 says that it charges, and the battery does not rise: check the dock"
        assert trouble_of(fleet, "a") in a.lines("warning")
        (found,) = check_reserve(a.ask(Describe()).result, Facts())
        assert (found.level, found.text) == ("warning", trouble_of(fleet, "a"))
        assert a.wait_for_event("docked", timeout_s=60.0, dock="dock2")
        a.wait_for_event("charged", timeout_s=60.0)
        assert trouble_of(fleet, "a").endswith("check the dock"), "the other dock shows that it is not the battery"


def test_a_battery_that_does_not_charge_is_named() -> None:
    with Fleet(1) as fleet:
        start_docks(fleet, TWO_DOCKS, {"a": {"x_m": 0.0, "y_m": 0.0, **need(level=0.6, charges=False)}})
        a = fleet.agents["a"]
        a.wait_until(lambda: trouble_of(fleet, "a").endswith("check the battery"), timeout_s=120.0)
        (found,) = check_reserve(a.ask(Describe()).result, Facts())
        assert found.text.endswith("check the battery")
        fleet.run_for(5.0)
        assert a.running() == ["Reserve", "Charge"], "it waits for a dock that may be good again"


class Work(Task):
    """Something to do for a robot."""

    requires = ("motors",)


def rule(**more: Any) -> dict[str, Any]:
    return {"when": "reserve", "below": 20, "cost": "reserve", "otherwise": "Charge", "again_s": 5, **more}


def work(**more: Any) -> dict[str, Any]:
    return {"Work": {"type": "test.Work", "migrate": rule(**more)}}


def test_a_robot_whose_reserve_runs_short_gives_its_task_away_and_goes_to_be_charged() -> None:
    with Fleet(1, classes={"test.Work": Work}) as fleet:
        robots = {"a": {"x_m": 0.4, "y_m": 0.3, **need(level=0.2)}, "b": {"x_m": -0.4, "y_m": 0.3, **need(level=0.9)}}
        start_docks(fleet, ONE_DOCK, robots, charges=False)
        start_work(fleet, "a", then="Charge")
        a, b = fleet.agents["a"], fleet.agents["b"]
        a.wait_for_event("charged", timeout_s=200.0)
        assert "Work" in b.running() and "Charge" not in b.running()
        (told,) = [it for it in a.events("migration") if it["outcome"] == "moved"]
        assert told["asked_by"] == "rule"


def start_work(fleet: Fleet, robot: str, **more: Any) -> None:
    """Create the task on a robot that runs, once its reserve is known."""
    agent = fleet.agents[robot]
    agent.wait_until(lambda: agent.agent.host_state.energy_reserve is not None, timeout_s=20.0)
    assert agent.ask(Create("Work", "test.Work", keys={"migrate": rule(**more)})).ok


@pytest.mark.parametrize(
    ("level", "stops", "reason"),
    [
        (0.15, False, "too near to the 20 s at which the task would move on"),
        (0.9, True, "its reserve is not known: a task of the type energy.reserve tells it"),
    ],
)
def test_a_robot_that_could_not_end_the_task_at_a_dock_refuses_it_whatever_the_cost(
    level: float, stops: bool, reason: str
) -> None:
    with Fleet(1, classes={"test.Work": Work}) as fleet:
        robots = {"a": {"x_m": 0.4, "y_m": 0.3, **need(level=0.9)}, "b": {"x_m": -0.4, "y_m": 0.3, **need(level=level)}}
        start_docks(fleet, ONE_DOCK, robots, charges=False)
        start_work(fleet, "a", cost="tasks")
        if stops:  # what it said before does not count for long
            assert fleet.agents["b"].ask(Stop("Reserve")).ok
            fleet.run_for(61.0)
        a = fleet.agents["a"]
        assert not a.ask(Migrate("Work", to="b")).ok
        (line,) = a.events("migration")[-1]["lines"]
        assert line["peer"] == "b" and reason in line["reason"]


def test_if_nobody_takes_the_task_its_robot_is_charged_and_continues_it() -> None:
    with Fleet(1, classes={"test.Work": Work}) as fleet:
        start_docks(
            fleet,
            ONE_DOCK,
            {"a": {"x_m": 0.4, "y_m": 0.3, **need(level=0.2)}},
            charges=False,
            settings={"then": ["Elsewhere", "Work"]},
        )
        start_work(fleet, "a")
        a = fleet.agents["a"]
        a.wait_for_event("left_dock", timeout_s=200.0)
        a.wait_until(lambda: a.running() == ["Reserve", "Work"], timeout_s=20.0)


def test_a_robot_that_is_charged_ends_alone_if_its_task_is_elsewhere() -> None:
    with Fleet(1, classes={"test.Work": Work}) as fleet:
        robots = {"a": {"x_m": 0.4, "y_m": 0.3, **need(level=0.2)}, "b": {"x_m": -0.4, "y_m": 0.3, **need(level=0.9)}}
        start_docks(fleet, ONE_DOCK, robots, charges=False, settings={"then": ["Work"]})
        start_work(fleet, "a", then="Charge")
        a = fleet.agents["a"]
        a.wait_for_event("left_dock", timeout_s=200.0)
        a.wait_until(lambda: a.running() == ["Reserve"], timeout_s=20.0)
        assert "Work" in fleet.agents["b"].running()


@pytest.mark.parametrize("works", [False, True])
def test_an_idle_robot_is_charged_and_one_that_works_is_left_to_its_rule(works: bool) -> None:
    with Fleet(1, classes={"test.Work": Work}) as fleet:
        robots = {"a": {"x_m": 0.4, "y_m": 0.3, **need(level=0.3)}}
        idle = {"idle": "Charge", "idle_below_s": 100.0}
        work = {"Work": {"type": Work}} if works else {}
        start_docks(fleet, ONE_DOCK, robots, charges=False, reserve=idle, tasks=work)
        fleet.run_for(40.0)
        a = fleet.agents["a"]
        assert bool(a.events("charged")) is not works
        assert a.running() == (["Reserve", "Work"] if works else ["Reserve"])
        assert a.lines("warning") == []


def test_an_idle_robot_waits_for_a_free_dock_without_holding_its_wheels() -> None:
    with Fleet(1) as fleet:
        robots = {"a": {"x_m": 0.4, "y_m": 0.3, **need(level=0.6)}, "b": {"x_m": 0.0, "y_m": 0.0, **need(level=0.2)}}
        idle = {"idle": "Charge", "idle_below_s": 300.0}
        start_docks(fleet, ONE_DOCK, robots, charges=False, reserve=idle, settings={"home_m": (-0.4, 0.0)})
        a, b = fleet.agents["a"], fleet.agents["b"]
        a.publish(SYSCTRL, Stop("Reserve"))
        b.wait_for_event("docked", timeout_s=30.0)
        a.publish(SYSCTRL, Start("Reserve"))
        fleet.run_for(4.0)
        assert "Charge" not in a.running() and not a.events("asked", what="start", task="Charge")
        b.wait_for_event("left_dock", timeout_s=100.0)
        a.wait_for_event("docked", timeout_s=60.0)


def test_an_idle_robot_goes_home_and_one_that_is_full_asks_for_no_dock() -> None:
    with Fleet(1) as fleet:
        robots = {"a": {"x_m": 0.4, "y_m": 0.3, **need(level=1.0, capacity_j=20000.0)}}
        idle = {"idle": "Charge", "idle_below_s": 1.0, "idle_home_m": (-0.4, 0.0)}
        start_docks(fleet, ONE_DOCK, robots, charges=False, reserve=idle, settings={"home_m": (-0.4, 0.0)})
        a = fleet.agents["a"]
        a.wait_for_event("left_dock", timeout_s=60.0)
        assert a.events("dock_chosen") == [] and a.events("docked") == []
        fleet.run_for(30.0)
        assert a.running() == ["Reserve"] and len(a.events("left_dock")) == 1, "at home it stays"


def test_a_missing_task_for_idle_robots_is_told_once() -> None:
    with Fleet(1) as fleet:
        idle = {"idle": "Charg", "idle_below_s": 500.0}
        start_docks(fleet, ONE_DOCK, {"a": {"x_m": 0.4, "y_m": 0.3}}, charges=False, reserve=idle)
        fleet.run_for(40.0)
        (line,) = fleet.agents["a"].lines("warning")
        assert line.startswith("an idle robot is not charged: ") and line.endswith("Correct `idle`")


def test_a_robot_that_hears_of_no_dock_has_no_reserve_and_says_so() -> None:
    with Fleet(1) as fleet:
        start_docks(fleet, {}, {"a": {"x_m": 0.4, "y_m": 0.3}}, charges=False)
        fleet.run_for(10.0)
        reserve = fleet.agents["a"].agent.host_state.describe()["reserve"]
        assert (reserve["seconds"], reserve["trouble"]) == (0.0, "knows no dock: none has been heard of")


def speed_mps(fleet: Fleet, robot: str) -> float:
    world = fleet.agents["world"].task("World")
    return float(next(it.v_mps for it in world.truth().bodies if it.name == robot))


def test_a_robot_whose_pose_is_old_stands_on_its_way_to_a_dock_and_says_so() -> None:
    with Fleet(1) as fleet:
        start_docks(fleet, ONE_DOCK, {"a": {"x_m": 1.5, "y_m": 0.0, **need(level=0.3)}})
        a = fleet.agents["a"]
        a.wait_for_event("dock_chosen", timeout_s=30.0)
        assert fleet.run_until(lambda: speed_mps(fleet, "a") > 0.05, 20.0)
        assert a.ask(Stop("pose")).ok
        fleet.run_for(3.0)
        assert speed_mps(fleet, "a") == 0.0 and a.running() == ["Reserve", "Charge"]
        fleet.run_for(10.0)
        assert trouble_of(fleet, "a") == "its pose is too old to know the way to a dock"
        assert a.agent.host_state.energy_reserve.seconds == 0.0, "it takes no task that it could not end at a dock"
        (found,) = check_reserve(a.ask(Describe()).result, Facts())
        assert found.text == trouble_of(fleet, "a")
        assert a.ask(Start("pose")).ok
        a.wait_for_event("charged", timeout_s=120.0)
        assert trouble_of(fleet, "a") == ""


def test_the_same_seed_gives_the_same_charging_to_the_byte() -> None:
    def run() -> list[Packet]:
        with Fleet(7) as fleet:
            robots = {"a": {"x_m": 0.4, "y_m": 0.3, **need(level=0.4)}, "b": {"x_m": -0.4, "y_m": 0.3}}
            start_docks(fleet, ONE_DOCK, robots)
            seen: list[Any] = []
            types = ("reserve", "dock_state", "dock_bid", "battery")
            for name in ("a", "b", "dock1"):
                stream = fleet.agents[name].kernel.stream
                stream.tap(SYSTEM, lambda it: seen.append((it.source, it.stamp_s, it.body)), types)
            fleet.run_for(25.0)
            return seen

    one = run()
    assert len(one) > 150 and one == run()


def test_a_dock_that_is_started_again_is_free_and_found_again() -> None:
    with Fleet(1) as fleet:
        start_docks(fleet, ONE_DOCK, {"a": {"x_m": 0.5, "y_m": 0.0, **need(level=0.2)}})
        a = fleet.agents["a"]
        a.wait_for_event("dock_chosen", timeout_s=30.0)
        fleet.crash("dock1")
        assert a.wait_for_event("dock_lost", timeout_s=20.0)["reason"] == "dock1/device/dock is silent"
        fleet.restart("dock1")
        fleet.connect()
        a.wait_for_event("charged", timeout_s=120.0)


def test_a_robot_asks_for_no_dock_before_somebody_starts_it() -> None:
    with Fleet(1) as fleet:
        start_docks(fleet, ONE_DOCK, {"a": {"x_m": 0.3, "y_m": 0.0}}, charges=False)
        seen = states_of(fleet, "dock1")
        fleet.run_for(10.0)
        assert seen == [("free", "")]
        assert fleet.agents["a"].ask(Start("Charge")).ok
        fleet.agents["a"].wait_for_event("docked", timeout_s=30.0)


def test_a_full_disk_makes_one_task_follow_and_not_the_next_one_too() -> None:
    with Fleet(1, classes={"test.Idle": Idle}) as fleet:
        follow = {"then": ["Gone", "First", "Second"]}
        tasks = {name: {"type": Idle, "start": False} for name in ("First", "Second")}
        start_docks(fleet, ONE_DOCK, {"a": {"x_m": 0.3, "y_m": 0.0, **need(level=0.2)}}, tasks=tasks, settings=follow)
        a = fleet.agents["a"]
        a.wait_for_event("docked", timeout_s=60.0)
        empty_disk = fleet.faults.fill_disk("a")
        a.wait_for_event("left_dock", timeout_s=60.0)
        fleet.run_for(30.0)
        empty_disk()
        a.wait_until(lambda: a.running() == ["Reserve", "First"], timeout_s=60.0)
        fleet.run_for(20.0)
        assert a.running() == ["Reserve", "First"]


class Idle(Task):
    """Something that two tasks can do at once."""


def test_a_task_that_could_not_end_asks_again(monkeypatch: pytest.MonkeyPatch) -> None:
    refused = iter(["Nothing"])
    monkeypatch.setattr("pancakes.energy.charge.Stop", lambda name, then: Stop(next(refused, name), then=then))
    with Fleet(1) as fleet:
        start_docks(fleet, ONE_DOCK, {"a": {"x_m": 0.3, "y_m": 0.0, **need(level=1.0)}}, charges=False)
        a = fleet.agents["a"]
        assert a.ask(Start("Charge")).ok
        assert fleet.run_until(lambda: a.running() == ["Reserve"], 30.0)


def test_a_reserve_that_is_no_number_is_bid_as_none() -> None:
    with Fleet(1) as fleet:
        start_docks(fleet, ONE_DOCK, {"a": {"x_m": 0.3, "y_m": 0.0}}, charges=False)
        a = fleet.agents["a"]
        assert a.ask(Stop("Reserve")).ok and a.ask(Start("Charge")).ok
        a.publish(SYSTEM, Reserve(math.nan, math.nan))
        assert a.wait_for_event("dock_chosen", timeout_s=30.0)["bids"] == {"a": 0.0}


def test_docks_that_a_peer_makes_up_do_not_hide_a_real_one_for_ever() -> None:
    with Fleet(1) as fleet:
        start_docks(fleet, {}, {"a": {"x_m": 0.3, "y_m": 0.0}}, charges=False)
        a, liar = fleet.agents["a"], fleet.start("liar", tasks={f"T{number}": Idle for number in range(MOST_DOCKS)})
        fleet.connect()
        for number in range(MOST_DOCKS):
            liar.task(f"T{number}").publish(SYSTEM, DockState("free", 2.0, 0.0), to=NEIGHBOURS)
        fleet.run_for(SILENT_S + 10.0)
        honest = fleet.start("honest")
        fleet.connect()
        honest.publish(SYSTEM, DockState("free", 0.4, 0.0), to=NEIGHBOURS)
        fleet.run_for(2.0)
        assert agent_of(a.agent.host_state.energy_reserve.dock) == "honest"


def test_an_allocation_by_the_reserve_leaves_a_robot_time_to_be_charged() -> None:
    with Fleet(1, classes={"test.Work": Work}) as fleet:
        robots = {"a": {"x_m": 0.4, "y_m": 0.3, **need(level=0.2)}, "b": {"x_m": -0.4, "y_m": 0.3, **need(level=0.9)}}
        part = {"network": {"settings": {"allocation": {"at_most": 1}}}}
        idle = {"idle": "Charge", "idle_below_s": 40.0}
        start_docks(fleet, ONE_DOCK, robots, charges=False, reserve=idle, services=part)
        a, b = fleet.agents["a"], fleet.agents["b"]
        told = {"when": "allocation", "cost": {"reserve": 10.0}}
        assert a.ask(Create("Work", "test.Work", keys={"migrate": told})).ok
        a.wait_for_event("charged", timeout_s=200.0)
        assert "Work" in b.running() and "Charge" not in b.running()
        fleet.run_for(20.0)
        assert sum("Work" in it.running() for it in (a, b)) == 1
