"""Docks of the simulated world: whom they charge, and for how long they are held."""

from __future__ import annotations

import random
from typing import Any

import pytest

from pancakes.errors import PancakesError
from pancakes.settings import SettingsError, make_settings
from pancakes.sim.bodies import ContentSettings
from pancakes.sim.world import Physics

PACK = {"capacity_j": 100.0, "level": 0.5, "idle_w": 0.0, "noise_v": 0.0}


def world(**dock: Any) -> Physics:
    at = {"y_m": 0.0, "spread_m": 0.0, "spread_rad": 0.0, "battery": PACK}
    robots = {"here": {"x_m": 0.0, **at}, "near": {"x_m": 0.3, **at}}
    contents = {"robots": robots, "docks": {"dock": {"x_m": 0.05, "y_m": 0.0, "power_w": 5.0, **dock}}}
    return Physics(make_settings(ContentSettings, contents), random.Random(1))


def test_a_dock_charges_the_robot_that_holds_it_while_that_is_there() -> None:
    physics = world()
    physics.dock("dock", 2.0, "here")
    assert physics.sample("dock", "dock_state").state == "taken"
    physics.advance(1.0)
    state, battery = physics.sample("dock", "dock_state"), physics.sample("here", "battery")
    assert (state.state, state.robot, state.x_m) == ("charging", "here", 0.05)
    assert battery.charging and battery.level == pytest.approx(0.55)


def test_a_robot_that_stands_at_a_dock_and_does_not_hold_it_is_not_charged() -> None:
    physics = world()
    physics.dock("dock", 2.0, "near")
    physics.advance(1.0)
    assert physics.sample("dock", "dock_state").state == "taken"
    for name in ("here", "near"):
        battery = physics.sample(name, "battery")
        assert not battery.charging and battery.level == pytest.approx(0.5)


def test_a_dock_that_hears_no_command_any_more_is_free_also_if_its_agent_is_gone() -> None:
    physics = world()
    physics.dock("dock", 1.0, "here")
    physics.advance(3.0)
    assert physics.sample("dock", "dock_state").state == "free"
    battery = physics.sample("here", "battery")
    assert not battery.charging and 0.55 <= battery.level < 0.57


def test_a_dock_is_released_at_once() -> None:
    physics = world()
    physics.dock("dock", 10.0, "here")
    physics.advance(0.5)
    physics.hold("dock")
    assert physics.sample("dock", "dock_state").robot == ""


def test_a_dock_without_power_says_that_it_charges_and_the_battery_does_not() -> None:
    physics = world(power_w=0.0)
    physics.dock("dock", 2.0, "here")
    physics.advance(1.0)
    battery = physics.sample("here", "battery")
    assert physics.sample("dock", "dock_state").state == "charging"
    assert not battery.charging and battery.level == pytest.approx(0.5)


def test_what_is_no_dock_or_no_robot_is_refused_with_a_sentence() -> None:
    physics = world()
    with pytest.raises(PancakesError, match="has no dock 'door', only dock"):
        physics.check("door", "dock")
    with pytest.raises(PancakesError, match="has no robot 'stranger'"):
        physics.dock("dock", 1.0, "stranger")


@pytest.mark.parametrize(
    ("docks", "fault"),
    [
        ({"here": {"x_m": 0.0, "y_m": 0.0}}, "several bodies of the name 'here'"),
        ({"dock": {"x_m": 9.0, "y_m": 0.0}}, "dock lies outside the arena"),
        ({"one": {"x_m": 0.3, "y_m": 0.0}, "two": {"x_m": 0.35, "y_m": 0.0}}, "one and two are at the same place"),
    ],
)
def test_docks_are_checked(docks: dict[str, Any], fault: str) -> None:
    with pytest.raises(SettingsError, match=fault):
        make_settings(ContentSettings, {"robots": {"here": {"x_m": 0.0, "y_m": 0.0}}, "docks": docks})
