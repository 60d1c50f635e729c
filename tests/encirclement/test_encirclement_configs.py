"""The configurations of the demos: sound, and true to what the paper says of who runs what."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pancakes.config import Config, load
from pancakes.util.plugins import Plugins
from pancakes_encirclement.demos import AGENTS, ENCIRCLEMENT, INTRUDER, PIONEER, RESCUE

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def read(demo: str) -> dict[str, Config]:
    return {agent: load(CONFIGS / demo / f"{agent}.toml", plugins=Plugins()) for agent in AGENTS}


@pytest.mark.parametrize("demo", ["encirclement", "pioneer", "intruder", "rescue"])
def test_they_are_sound_and_find_each_other(demo: str) -> None:
    configs = read(demo)
    addresses = {address for config in configs.values() for address in config.agent.listen}
    for agent, config in configs.items():
        assert config.agent.name == agent
        assert set(config.agent.peers) == addresses, "an agent skips its own"
        assert config.clock.hold, "the mission waits until all are ready"
    bus = configs["world"].tasks["World"].settings["bus"]
    simulated = [device for config in configs.values() for device in config.devices.values() if "sim." in device.driver]
    assert {device.settings["world"] for device in simulated} == {bus}


@pytest.mark.parametrize("demo", ["encirclement", "pioneer"])
def test_agent_2_runs_nothing_at_first_and_the_sensor_has_no_motors(demo: str) -> None:
    configs = read(demo)
    assert [task.name for task in configs["agent2"].tasks.values() if task.start] == []
    assert sorted(configs["sensor"].devices) == ["motion", "pose"]
    assert configs["agent1"].tasks["ScanTarget"].migrate is not None


def test_two_guardians_are_left_where_the_robot_that_circles_is_lost() -> None:
    configs = read("rescue")
    (guarded,) = configs["agent1"].tasks.values()
    rule = guarded.guard
    assert rule is not None and (rule.copies, rule.lease_s, guarded.migrate) == (3, 2.0, None)
    assert set(rule.guardians) == set(AGENTS) - {"world", "agent1"}
    assert configs["agent2"].tasks == {}, "it runs nothing until it goes on"
    assert RESCUE.loss is not None and RESCUE.loss.agents == ("agent1",)
    assert (rule.lease_s + 1.5) * RESCUE.fastest <= RESCUE.loss.away_s, "it comes back after the take-over"


def test_the_pioneers_run_the_same_tasks_as_the_kheperas() -> None:
    kheperas, pioneers = read("encirclement"), read("pioneer")
    for agent in AGENTS:
        types = [[(task.name, task.type) for task in fleet[agent].tasks.values()] for fleet in (kheperas, pioneers)]
        assert types[0] == types[1]


@pytest.mark.parametrize("demo", [ENCIRCLEMENT, PIONEER, INTRUDER, RESCUE], ids=lambda demo: demo.name)
def test_each_demo_shows_the_circle_that_is_configured(demo: Any) -> None:
    configs = read(demo.name)
    assert configs["agent1"].tasks["ScanTarget"].settings["radius_m"] == demo.radius_m
    world = configs["world"].tasks["World"].settings
    assert demo.circled in {**world["sensors"], **world["movers"]}


@pytest.mark.parametrize("demo", ["encirclement", "pioneer", "intruder"])
def test_home_is_where_the_robots_are_put_at_the_start(demo: str) -> None:
    configs = read(demo)
    robots = configs["world"].tasks["World"].settings["robots"]
    for agent, robot in robots.items():
        assert configs[agent].tasks["GoHome"].settings["home_m"] == [robot["x_m"], robot["y_m"]]
        assert robot["spread_m"] <= 0.03
