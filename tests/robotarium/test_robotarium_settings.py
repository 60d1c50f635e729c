"""What may be in the Robotarium, and what is refused before anything runs. Needs no simulator."""

from __future__ import annotations

from typing import Any

import pytest
from pancakes_robotarium.gternal import GTERNAL, RING
from pancakes_robotarium.settings import RobotariumSettings

from pancakes import CTRL, Simulation, Task, Tick, every
from pancakes.devices import Twist
from pancakes.settings import SettingsError, make_settings
from pancakes.worlds import robot_model

ONE = {"robots": {"a": {"x_m": 0.0, "y_m": 0.0}}}


def made(settings: dict[str, Any]) -> RobotariumSettings:
    return make_settings(RobotariumSettings, settings)


def test_robots_are_gternals_on_all_of_the_floor() -> None:
    settings = made(ONE)
    assert settings.robots["a"].model == "gternal"
    assert (settings.arena.width_m, settings.arena.height_m) == (3.2, 2.0)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({}, "1 to 50 robots, and here are 0"),
        ({"robots": {f"r{i}": {"x_m": 0.0, "y_m": 0.0} for i in range(51)}}, "1 to 50 robots, and here are 51"),
        ({**ONE, "arena": {"width_m": 4.0, "height_m": 2.0}}, "the floor of the Robotarium is 3.2 x 2 m"),
        ({"robots": {"a": {"x_m": 2.0, "y_m": 0.0}}}, "a stands outside the arena"),
        ({"robots": {"a": {"x_m": 1.59, "y_m": 0.0}}}, "a may start outside the arena"),
        ({"robots": {"a": {"x_m": 0.0, "y_m": 0.0, "model": "khepera3"}}}, "khepera3 is larger than the robots"),
        ({"robots": {"a": {"x_m": 0.0, "y_m": 0.0, "model": "gternel"}}}, "did you mean 'gternal'"),
        (
            {"robots": {"a": {"x_m": 0.0, "y_m": 0.0}}, "movers": {"b": {"x_m": 0.1, "y_m": 0.0}}},
            "a and b may start 0.04 m apart, and each is 0.11 m wide",
        ),
        ({**ONE, "movers": {"a": {"x_m": 1.0, "y_m": 0.0}}}, "several bodies of the name 'a'"),
        ({**ONE, "movers": {"b": {"x_m": 1.0, "y_m": 0.0, "waypoints": [[2.0, 0.0]]}}}, "b cannot drive to"),
        ({**ONE, "movers": {"b": {"x_m": 1.0, "y_m": 0.0, "speed_mps": 0.5}}}, "speed_mps"),
        ({**ONE, "state_steps": 0}, "state_steps"),
    ],
)
def test_contents_that_cannot_be_are_refused(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(SettingsError, match=said):
        made(settings)


def test_gternal_is_found_by_its_entry_point() -> None:
    assert robot_model("gternal") is GTERNAL
    assert (GTERNAL.diameter_m, GTERNAL.drive.wheel_base_m) == (0.11, 0.105)
    assert len(RING.sensors) == 7 and RING.max_range_m == 1.2


class Ahead(Task):
    requires = ("motors",)

    @every(hz=5)
    def ahead(self, tick: Tick) -> None:
        self.publish(CTRL, Twist(0.5, 0.0))


def test_gternal_drives_in_the_built_in_world_too() -> None:
    bus = "tcp://world:7499"
    world = {"bus": bus, "robots": {"a": {"x_m": 0.0, "y_m": 0.0, "theta_rad": 0.0, "model": "gternal"}}}
    with Simulation() as simulation:
        simulation.add("world", tasks={"World": {"type": "sim.world", "settings": world}}, role="environment")
        motors = {"type": "robotarium.motors", "settings": {"world": bus}}
        simulation.add("a", tasks={"Ahead": Ahead}, devices={"motors": motors})
        simulation.reset(seed=1)
        simulation.step(2.0)
        robot = simulation.body("a")
        assert robot.v_mps == pytest.approx(0.2, rel=0.05), "no GTernal is faster"
        assert robot.battery_v == pytest.approx(4.2, abs=0.01)
