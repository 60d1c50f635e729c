"""A simulator that the core does not know: a world, a robot model and devices of a distribution of its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pytest
from msgspec import Meta, Struct

from pancakes import CTRL, PancakesError, Simulation, Task, Tick, every, packet_type
from pancakes.control import Stop
from pancakes.devices import Pose, Twist
from pancakes.errors import RemoteProtocolError
from pancakes.sim.hardware_bus import Command, RawCommand, RequestReader, encode
from pancakes.sim.robot_models import UnknownRobotModelError
from pancakes.simulation import SimulationError
from pancakes.util.plugins import installed
from pancakes.worlds import BodyState, SimulatedActuator, SimulatedWorld, Wheels, WorldState, robot_model

BUS = "tcp://world:7499"
CRAWLER = """
from pancakes.worlds import DriveKinematics, RobotModel
WHEELS = DriveKinematics(0.1, 0.5, 0.5, 2.0, 1e6)
CRAWLER = RobotModel("crawler", 0.2, 1.0, WHEELS, 12.0, 10.0)
OTHER = RobotModel("other", 0.2, 1.0, WHEELS, 12.0, 10.0)
"""


@packet_type("rail.grip")
class Grip(Struct, frozen=True):
    """How firmly a gripper holds, from 0 to 1."""

    force: Annotated[float, Meta(ge=0, le=1)]


class Rail(SimulatedWorld):
    """A simulator of one's own: robots on a straight rail, with grippers. It needs no physics of Pancakes."""

    @dataclass
    class Settings(SimulatedWorld.Settings):
        """The rail."""

    def on_start(self) -> None:
        self.x_m = {name: robot.x_m for name, robot in self.settings.robots.items()}
        self.v_mps = dict.fromkeys(self.x_m, 0.0)
        self.grip = dict.fromkeys(self.x_m, 0.0)
        self.told: list[str] = []
        self.at_s = self.now()
        super().on_start()

    def truth(self) -> WorldState:
        bodies = (BodyState(name, "robot", x_m, 0.0, 0.0, self.v_mps[name], 0.0) for name, x_m in self.x_m.items())
        return WorldState(self.at_s, tuple(bodies))

    def advance(self) -> None:
        for name, v_mps in self.v_mps.items():
            self.x_m[name] += v_mps * (self.now() - self.at_s)
        self.at_s = self.now()

    @every(hz=10)
    def go_on(self, tick: Tick) -> None:
        self.advance()
        self.publish_truth()

    def check(self, body: str, device_type: str, model: str) -> None:
        if body not in self.x_m:
            raise PancakesError(f"there is no {body!r} on the rail")

    def sample(self, body: str, device_type: str) -> Any:
        return Pose(self.x_m[body], 0.0, 0.0) if device_type == "pose" else super().sample(body, device_type)

    def drive(self, body: str, wheels: Wheels, ttl_s: float, source: str) -> None:
        self.v_mps[body] = wheels.left_mps

    def act(self, body: str, device_type: str, command: Grip, ttl_s: float, source: str) -> None:
        self.grip[body] = command.force
        self.told.append(f"{device_type} {command.force} for {ttl_s:g} s by {source}")

    def hold(self, body: str, device: str) -> None:
        if device == "gripper":
            self.grip[body] = 0.0
        else:
            self.v_mps[body] = 0.0


class Gripper(SimulatedActuator):
    type = "rail.grip"


class Haul(Task):
    requires = ("motors", "rail.grip")

    @every(hz=5)
    def haul(self, tick: Tick) -> None:
        self.publish(CTRL, Twist(0.2, 0.0))
        self.publish(CTRL, Grip(0.5))


@pytest.fixture
def rail() -> Iterator[Simulation]:
    """A robot on a rail, which hauls from 0 s on."""
    with Simulation() as simulation:
        settings = {"bus": BUS, "robots": {"robot": {"x_m": 0.0, "y_m": 0.0}}}
        simulation.add("world", tasks={"Rail": {"type": Rail, "settings": settings}}, role="environment")
        simulation.add(
            "robot",
            tasks={"Haul": Haul},
            devices={
                "pose": {"type": "sim.pose", "rate_hz": 5, "settings": {"world": BUS}},
                "motors": {"type": "sim.differential_drive", "settings": {"world": BUS}},
                "gripper": {"type": Gripper, "settings": {"world": BUS}},
            },
        )
        simulation.reset(seed=1)
        yield simulation


def test_other_world_reports_the_truth(rail: Simulation) -> None:
    rail.step(5.0)
    assert rail.body("robot").x_m == pytest.approx(1.0, abs=0.1)
    assert rail.world().time_s == pytest.approx(5.0, abs=0.11)


def test_actuator_of_any_type_is_commanded_and_held(rail: Simulation) -> None:
    rail.step(1.0)
    world = rail.task("world", "Rail")
    assert world.grip == {"robot": 0.5}
    assert world.told[0] == "rail.grip 0.5 for 0.5 s by robot/client/Haul"
    rail.agents["robot"].ask(Stop("Haul"))
    rail.step(1.0)
    assert world.grip == {"robot": 0.0} and world.v_mps == {"robot": 0.0}


def test_what_a_world_does_not_override_is_refused(rail: Simulation) -> None:
    battery = {"type": "sim.battery", "rate_hz": 1, "settings": {"world": BUS, "body": "robot"}}
    rail.add("other", devices={"battery": battery})
    rail.reset(seed=1)
    rail.step(2.0)
    (line,) = rail.agents["other"].lines("error")
    assert "the simulated world has no sensor of the type 'battery'" in line


def test_simulation_without_a_world_says_so() -> None:
    with Simulation() as simulation:
        simulation.add("robot")
        simulation.reset(seed=1)
        with pytest.raises(SimulationError, match="runs a simulated world, such as 'sim.world'"):
            simulation.world()


Models = Callable[[str], None]


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Models]:
    """Installs a distribution with these robot models."""
    monkeypatch.syspath_prepend(tmp_path)

    def install(lines: str) -> None:
        information = tmp_path / "crawlers-1.0.dist-info"
        information.mkdir()
        (information / "METADATA").write_text("Metadata-Version: 2.1\nName: crawlers\nVersion: 1.0\n")
        (information / "entry_points.txt").write_text(f"[pancakes.robot_models]\n{lines}\n")
        (tmp_path / "crawler_models.py").write_text(CRAWLER)
        installed.cache_clear()

    yield install
    installed.cache_clear()


def test_robot_model_of_another_distribution_drives(models: Models) -> None:
    models("crawler = crawler_models:CRAWLER")
    assert robot_model("crawler").full_v == 12.0
    with Simulation() as simulation:
        world = {"bus": BUS, "robots": {"robot": {"x_m": 0.0, "y_m": 0.0, "theta_rad": 0.0, "model": "crawler"}}}
        simulation.add("world", tasks={"World": {"type": "sim.world", "settings": world}}, role="environment")
        motors = {"type": "sim.differential_drive", "settings": {"world": BUS, "model": "crawler"}}
        simulation.add("robot", tasks={"Forward": Forward}, devices={"motors": motors})
        simulation.reset(seed=1)
        simulation.step(2.0)
        assert simulation.body("robot").v_mps == pytest.approx(0.5, rel=0.1), "no Khepera III is that fast"
        assert simulation.body("robot").battery_v == pytest.approx(12.0, abs=0.01)


class Forward(Task):
    requires = ("motors",)

    @every(hz=5)
    def forward(self, tick: Tick) -> None:
        self.publish(CTRL, Twist(0.5, 0.0))


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("crawler = crawler_models:OTHER", "the robot model 'crawler' calls itself 'other': both must be one name"),
        ("crawler = crawler_models:WHEELS", "the robot model 'crawler' is a DriveKinematics, not a RobotModel"),
        ("crawler = crawler_models:NONE", "robot model 'crawler' of crawlers 1.0 .* cannot be loaded"),
        ("crawling = crawler_models:CRAWLER", "there are crawling, .*khepera3.*did you mean 'crawling'"),
    ],
)
def test_robot_model_that_cannot_be_used_is_explained(lines: str, said: str, models: Models) -> None:
    models(lines)
    with pytest.raises(UnknownRobotModelError, match=said):
        robot_model("crawler")


def test_command_with_a_number_out_of_bounds_is_refused() -> None:
    def received(value: Any, ttl_s: float = 0.5, kind: str = "rail.grip") -> RawCommand:
        (request,) = RequestReader().feed(encode(Command("robot", "gripper", kind, value, ttl_s, "robot/client/Haul")))
        assert isinstance(request, RawCommand)
        return request

    assert received(Grip(1.0)).command() == Grip(1.0)
    for request, said in (
        (received({"force": 1.5}), "'rail.grip' has a bad body"),
        (received(Twist(math.nan, 0.0), kind="motors"), "cannot be carried out: v_mps is nan"),
        (received(Grip(0.5), math.inf), "cannot be carried out: ttl_s is inf"),
        (received(Grip(0.5), kind="rail.unknown"), "'rail.unknown' is unknown here: install what registers it"),
    ):
        with pytest.raises(RemoteProtocolError, match=said):
            request.command()
