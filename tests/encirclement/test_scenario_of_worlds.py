"""The scenario of a mission is read of any world, by the contents in its settings."""

from __future__ import annotations

from typing import Any

import pytest

from pancakes.errors import PancakesError
from pancakes_encirclement.scenario import read_scenario

SCAN = {"type": "encirclement.ScanTarget", "settings": {"radius_m": 0.4}}
PLACES = {"one": {"x_m": 1.0, "y_m": 0.5}, "two": {"x_m": 1.0, "y_m": -0.5}}


def configs(world: str, **settings: Any) -> dict[str, Any]:
    """Returns the configurations of a world and of a robot that circles."""
    return {
        "world": {"tasks": {"World": {"type": world, "settings": {"robots": PLACES, **settings}}}},
        "one": {"tasks": {"ScanTarget": SCAN}},
    }


@pytest.mark.parametrize(
    ("world", "half_m", "full_v"),
    [("sim.world", (2.5, 2.0), 8.4), ("ros2.arena", (2.5, 2.0), 8.4), ("robotarium.world", (1.6, 1.0), 4.2)],
)
def test_scenario_has_the_defaults_of_its_world(world: str, half_m: tuple[float, float], full_v: float) -> None:
    scenario = read_scenario(configs(world, sensors={"sensor": {}}))
    assert (scenario.half_width_m, scenario.half_height_m) == half_m
    assert scenario.battery_v["one"][0] == full_v
    assert (scenario.first, scenario.second, scenario.sensor, scenario.radius_m) == ("one", "two", "sensor", 0.4)


def test_scenario_of_another_version_is_read() -> None:
    assert read_scenario(configs("sim.world", gravity=9.81)).robots == ("one", "two")


def test_mission_without_a_world_is_named() -> None:
    with pytest.raises(PancakesError, match="none of the agents world, one simulates a world that is installed here"):
        read_scenario(configs("not.installed"))


def test_mission_without_a_circle_is_named() -> None:
    only_world = {"world": configs("sim.world")["world"]}
    with pytest.raises(PancakesError, match=r"no task is of the type 'encirclement\.ScanTarget'"):
        read_scenario(only_world)
