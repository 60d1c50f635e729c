"""Which robot gets which dock, and what a robot does until it is charged."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest

from pancakes.devices import DockBid, DockState, Pose
from pancakes.energy.docking import (
    AVOID_S,
    CONFIRM_S,
    CONTACT_S,
    FRESH_S,
    MOST_HEARD,
    STUCK_S,
    WINDOW_S,
    ChargeSettings,
    Docking,
    Step,
    allocate,
    drive_to,
)

HERE = Pose(0.0, 0.0, 0.0)
ONE, TWO = "dock1/device/dock", "dock2/device/dock"


def bid(seconds: float, x_m: float = 0.0, *avoids: str) -> DockBid:
    return DockBid(seconds, x_m, 0.0, avoids)


def dock(x_m: float, state: Any = "free", robot: str = "") -> DockState:
    return DockState(state, x_m, 0.0, robot)


def test_the_lowest_reserve_gets_the_only_dock() -> None:
    assert allocate({"a": bid(50.0), "b": bid(20.0)}, {ONE: dock(0.0)}) == {"b": ONE}


def test_of_equal_reserves_the_lower_name_comes_first() -> None:
    assert allocate({"b": bid(20.0), "a": bid(20.0)}, {ONE: dock(0.0)}) == {"a": ONE}


def test_each_gets_the_nearest_dock_that_is_left() -> None:
    docks = {ONE: dock(1.0), TWO: dock(2.0)}
    assert allocate({"a": bid(20.0, 0.0), "b": bid(10.0, 0.0), "c": bid(30.0)}, docks) == {"b": ONE, "a": TWO}
    assert allocate({"a": bid(20.0, 3.0)}, docks) == {"a": TWO}


def test_a_dock_that_is_taken_or_avoided_is_not_given() -> None:
    docks = {ONE: dock(1.0, "taken", "c"), TWO: dock(2.0)}
    assert allocate({"a": bid(20.0)}, docks) == {"a": TWO}
    assert allocate({"a": bid(20.0, 0.0, TWO), "b": bid(30.0)}, docks) == {"b": TWO}


def test_the_order_in_which_bids_came_does_not_count() -> None:
    bids = {"a": bid(20.0, 1.0), "b": bid(20.0, -1.0), "c": bid(5.0)}
    docks = {ONE: dock(1.0), TWO: dock(-1.0)}
    given = [allocate(dict(order), docks) for order in itertools.permutations(bids.items())]
    assert all(it == given[0] for it in given) and given[0]["c"] in docks and len(given[0]) == 2


class Robot:
    """Robot a, which is told what docks and others say, and where it is."""

    def __init__(self, **settings: Any) -> None:
        self.docking = Docking("a", ChargeSettings(**settings))
        self.now_s = 0.0
        self.pose, self.level = HERE, 0.2
        self.docks: dict[str, DockState] = {}
        self.others: dict[str, DockBid] = {}

    def run(self, seconds: float) -> Step:
        """Let time pass; return the last step that had news, else the last one."""
        told, end_s = None, self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += 0.5
            for address, state in self.docks.items():
                self.docking.dock_told(address, state, self.now_s)
            for name, other in self.others.items():
                self.docking.bid_told(name, other, self.now_s)
            own = self.docking.bid(self.now_s, self.pose, 10.0, ())
            step = self.docking.decide(self.now_s, self.pose, self.level, own)
            told = step if step.news else told
        return told or step

    def won(self, address: str = ONE, x_m: float = 1.0) -> None:
        """It gets a dock, and the dock says so."""
        self.docks[address] = dock(x_m)
        assert self.run(WINDOW_S + 0.5).news == "dock_chosen"
        self.docks[address] = dock(x_m, "taken", "a")
        assert self.run(0.5).goal == (x_m, 0.0)


def test_a_robot_hears_the_others_before_it_takes_a_dock() -> None:
    robot = Robot()
    robot.docks[ONE] = dock(1.0)
    assert robot.run(WINDOW_S - 0.5).dock == ""
    step = robot.run(1.0)
    assert (step.news, step.dock, step.bids) == ("dock_chosen", ONE, {"a": 10.0})


def test_a_robot_waits_while_another_needs_the_dock_more_until_that_is_silent() -> None:
    robot = Robot()
    robot.docks[ONE], robot.others["b"] = dock(1.0), bid(5.0)
    assert robot.run(10.0) == Step("asks")
    robot.others.clear()
    assert robot.run(FRESH_S + 1.0).dock == ONE


def test_it_sets_out_once_the_dock_is_its_own_and_stands_there() -> None:
    robot = Robot()
    robot.docks[ONE] = dock(1.0)
    assert robot.run(WINDOW_S + 0.5).goal is None
    assert robot.run(1.0) == Step("goes", ONE)
    robot.docks[ONE] = dock(1.0, "taken", "a")
    assert robot.run(0.5).goal == (1.0, 0.0)
    robot.pose = Pose(1.0, 0.0, 0.0)
    assert robot.run(0.5) == Step("charges", ONE, news="docked")


@pytest.mark.parametrize(
    ("happens", "seconds", "reason"),
    [
        ("is silent", FRESH_S + 1.0, f"{ONE} is silent"),
        ("is taken", 0.5, f"{ONE} is taken by b"),
        ("is out of reach", STUCK_S + 1.0, f"it comes no nearer to {ONE}"),
    ],
)
def test_it_asks_for_another_dock_if_its_own(happens: str, seconds: float, reason: str) -> None:
    robot = Robot()
    robot.won()
    if happens == "is silent":
        robot.docks.clear()
    elif happens == "is taken":
        robot.docks[ONE] = dock(1.0, "taken", "b")
    step = robot.run(seconds)
    assert (step.phase, step.dock, step.news, step.why) == ("asks", "", "dock_lost", reason)


def test_a_robot_that_stands_at_a_dock_and_is_not_charged_asks_for_another() -> None:
    robot = Robot()
    robot.won()
    robot.pose = Pose(1.0, 0.0, 0.0)
    robot.docks[ONE] = dock(1.0, "charging", "a")
    robot.run(0.5)
    assert robot.run(2 * CONTACT_S) == Step("charges", ONE)
    robot.docks[ONE] = dock(1.0, "taken", "a")
    step = robot.run(CONTACT_S + 1.0)
    assert (step.phase, step.why) == ("asks", f"it stands at {ONE}, which does not charge it")


def test_a_dock_that_does_not_obey_is_left_out_for_some_time() -> None:
    robot = Robot()
    robot.docks[ONE] = dock(1.0)
    assert robot.run(WINDOW_S + CONFIRM_S + 1.0).why == f"{ONE} does not obey"
    assert robot.run(AVOID_S - 5.0) == Step("asks")
    assert robot.run(7.0).news == "dock_chosen"


def test_a_robot_that_is_full_leaves_home_and_lets_the_dock_go_on_its_way() -> None:
    robot = Robot(home_m=(3.0, 0.0))
    robot.won()
    robot.pose, robot.level = Pose(1.0, 0.0, 0.0), 0.99
    step = robot.run(0.5)
    assert (step.phase, step.news) == ("leaves", "charged")
    assert (robot.run(0.5).dock, robot.run(0.5).goal) == (ONE, (3.0, 0.0))
    robot.pose = Pose(1.5, 0.0, 0.0)
    assert robot.run(0.5).dock == ""
    robot.pose = Pose(3.0, 0.0, 0.0)
    assert robot.run(0.5) == Step("done", news="left_dock")


def test_a_robot_with_enough_makes_room_only_for_one_that_finds_no_free_dock() -> None:
    robot = Robot(enough=0.5)
    robot.won()
    robot.pose, robot.level = Pose(1.0, 0.0, 0.0), 0.6
    robot.docks[TWO] = dock(5.0)
    robot.others["b"] = bid(5.0)
    assert robot.run(5.0).news == "docked"
    robot.docks[TWO] = dock(5.0, "taken", "c")
    assert robot.run(0.5).news == "charged"


def test_a_robot_that_is_full_asks_for_no_dock() -> None:
    robot = Robot()
    robot.level = 0.99
    assert robot.run(0.5).phase == "done"


def test_a_robot_that_is_full_drives_home() -> None:
    robot = Robot(home_m=(3.0, 0.0))
    robot.level = 0.99
    assert (robot.run(0.5).news, robot.run(0.5).goal, robot.run(0.5).dock) == ("charged", (3.0, 0.0), "")
    robot.pose = Pose(3.0, 0.0, 0.0)
    assert robot.run(0.5) == Step("done", news="left_dock")


def test_numbers_that_are_none_do_not_count() -> None:
    robot = Robot()
    robot.docks[ONE] = dock(math.nan)
    robot.others["b"] = bid(math.nan)
    assert robot.run(5.0) == Step("asks")


def test_it_turns_before_it_drives() -> None:
    assert drive_to(HERE, (-1.0, 0.1), 0.1, 0.5).v_mps == 0.0
    ahead = drive_to(HERE, (1.0, 0.0), 0.1, 0.5)
    assert (ahead.v_mps, ahead.omega_radps) == (0.1, 0.0)


def test_a_flood_of_docks_and_bids_is_bounded() -> None:
    docking = Docking("a", ChargeSettings())
    docking.dock_told(ONE, dock(1.0), 0.0)
    for number in range(3 * MOST_HEARD):
        docking.dock_told(f"x{number}/device/dock", dock(0.0), 0.0)
        docking.bid_told(f"x{number}", bid(50.0), 0.0)
    step = [docking.decide(now_s, HERE, 0.2, bid(10.0, 0.0)) for now_s in (0.0, WINDOW_S)][-1]
    assert step.news == "dock_chosen" and len(step.bids) == MOST_HEARD + 1
