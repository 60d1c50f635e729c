"""Poses that are old, jump, are no number, or are those of another robot: what the wheels do, and what doctor says."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pytest

from pancakes.control import Describe
from pancakes.devices import Pose, Twist
from pancakes.devices.driver import Actuator, Sensor
from pancakes.task import Task, every
from pancakes.testing import AgentHandle, Fleet
from pancakes.tools.cli.verbs.agent_checks import check_device, check_failures, check_filters
from pancakes.tools.cli.verbs.checks import Facts

BARRIER = {"type": "barrier", "device": "motors", "settings": {"radius_m": 0.1, "max_mps": 0.2, "max_radps": 3.0}}


class Camera(Sensor):
    """Says where each robot is, as the test tells it; None: nothing."""

    type = "pose"
    silent_s = 5.0
    told: dict[str, Pose | None] = {}

    def read(self) -> Pose | None:
        return self.told[self.context.agent]


class Wheels(Actuator):
    """Writes down the newest speed of each robot."""

    type = "motors"
    speed_mps: dict[str, float] = {}

    def write(self, command: Twist, ttl_s: float, source: str) -> None:
        self.speed_mps[self.context.agent] = command.v_mps

    def safe_stop(self) -> None:
        self.speed_mps[self.context.agent] = 0.0


class Driving(Task):
    requires = ("motors",)

    @every(hz=10)
    def drive(self, tick: Any) -> None:
        self.publish("ctrl", Twist(0.1, 0.0))


@pytest.fixture
def robots() -> Iterator[tuple[Fleet, AgentHandle]]:
    Wheels.speed_mps, Camera.told = {}, {"a": Pose(0.0, 0.0, 0.0), "b": Pose(5.0, 0.0, 0.0)}
    devices = {"pose": {"type": Camera, "rate_hz": 10}, "motors": Wheels}
    with Fleet(seed=3) as fleet:
        for name in "ab":
            fleet.start(name, devices=devices, filters={"apart": BARRIER}, tasks={"Driving": Driving})
        fleet.connect()
        fleet.run_for(2.0)
        assert Wheels.speed_mps == {"a": 0.1, "b": 0.1}
        yield fleet, fleet.agents["a"]


def said(agent: AgentHandle) -> dict[str, list[str]]:
    """Return what doctor says of each of the agent's devices."""
    rows = [task for task in agent.ask(Describe()).result["tasks"] if task["service"] == "device"]
    whole = {row["task"]: {**row, **agent.ask(Describe(row["task"])).result} for row in rows}
    checks = (check_device, check_filters, check_failures)
    return {name: [found.text for check in checks for found in check("a", row, Facts())] for name, row in whole.items()}


@pytest.mark.parametrize(
    ("pose", "what"),
    [(None, "has had no reading for 21 s"), (Pose(math.nan, 0.0, 0.0), ": x_m is nan")],
    ids=["silent", "no number"],
)
def test_robot_whose_pose_is_old_or_no_number_stands(
    robots: tuple[Fleet, AgentHandle], pose: Pose | None, what: str
) -> None:
    fleet, a = robots
    Camera.told["a"] = pose
    fleet.run_for(0.8)
    assert 0.0 < Wheels.speed_mps["a"] < 0.1, "it slows down first"
    fleet.run_for(20.0)
    assert Wheels.speed_mps["a"] == 0.0
    (held,) = said(a)["motors"]
    assert held.startswith("is held by its filter apart for ") and held.endswith(" s: its own pose is too old")
    (found,) = said(a)["pose"]
    assert what in found
    Camera.told["a"] = Pose(0.0, 0.0, 0.0)
    assert fleet.run_until(lambda: Wheels.speed_mps["a"] == 0.1, 70.0), "a device that was given up is tried again"
    fleet.run_for(2.0)
    assert said(a)["motors"] == []


def test_robot_whose_pose_jumps_stands_until_its_poses_agree(robots: tuple[Fleet, AgentHandle]) -> None:
    fleet, a = robots
    for number in range(20):
        Camera.told["a"] = Pose(number % 2, 0.0, 0.0)
        fleet.run_for(0.2)
    assert Wheels.speed_mps["a"] == 0.0
    (held,) = said(a)["motors"]
    assert held.endswith("its own pose has jumped")
    fleet.run_for(1.0)
    assert Wheels.speed_mps["a"] == 0.1


def test_two_robots_in_one_place_stand(robots: tuple[Fleet, AgentHandle]) -> None:
    fleet, a = robots
    Camera.told["b"] = Pose(0.02, 0.0, 0.0)
    fleet.run_for(2.0)
    assert Wheels.speed_mps == {"a": 0.0, "b": 0.0}
    (held,) = said(a)["motors"]
    assert held.endswith("its own pose and that of b are in one place")
