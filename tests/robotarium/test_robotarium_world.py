"""The Robotarium as a world: devices on its bus, commands that expire, the truth, incidents, its verdict."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pancakes import CTRL, SYSTEM, Packet, PancakesError, Simulation, Task, Tick, every, on
from pancakes.control import Configure, Stop
from pancakes.devices import Battery, Infrared, Motion, Pose, Twist
from pancakes.worlds import Wheels

BUS = "tcp://world:7499"
Make = Callable[..., Simulation]


class Drive(Task):
    """Drive at 10 Hz, and keep what the sensors read."""

    requires = ("motors",)
    twist = Twist(0.1, 0.0)

    def on_start(self) -> None:
        self.read: dict[type, Any] = {}

    @every(hz=10)
    def drive(self, tick: Tick) -> None:
        self.publish(CTRL, self.twist)

    @on(SYSTEM)
    def pose(self, pose: Pose) -> None:
        self.read[Pose] = pose

    @on(SYSTEM)
    def battery(self, battery: Battery) -> None:
        self.read[Battery] = battery

    @on(SYSTEM)
    def ranges(self, ranges: Infrared) -> None:
        self.read[Infrared] = ranges


class Listen(Task):
    """Keep what a motion sensor says."""

    def on_start(self) -> None:
        self.heard: list[Motion] = []

    @on(SYSTEM, Motion)
    def motion(self, packet: Packet) -> None:
        self.heard.append(packet.body)


def device(driver: str, rate_hz: float | None = None, **settings: Any) -> dict[str, Any]:
    made: dict[str, Any] = {"type": driver, "settings": {"world": BUS, **settings}}
    return made if rate_hz is None else {**made, "rate_hz": rate_hz}


@pytest.fixture
def make(robotarium: Any, tmp_path: Path) -> Iterator[Make]:
    """Makes a simulation of a Robotarium with a robot `a`, which drives, and others."""
    made: list[Simulation] = []

    def make(drive: type = Drive, start: bool = True, **contents: Any) -> Simulation:
        simulation = Simulation()
        made.append(simulation)
        robots = {"a": {"x_m": 0.0, "y_m": 0.0, "spread_m": 0.0, "spread_rad": 0.0}, **contents.pop("robots", {})}
        settings = {"bus": BUS, "path": str(tmp_path / "robotarium.json"), "robots": robots, **contents}
        world = {"type": "robotarium.world", "settings": settings}
        simulation.add("world", tasks={"World": world}, role="environment")
        devices = {
            "pose": device("robotarium.pose", 10),
            "battery": device("robotarium.battery", 2),
            "ir": device("robotarium.ir", 10),
            "motors": device("robotarium.motors"),
        }
        simulation.add("a", tasks={"Drive": {"type": drive, "start": start}}, devices=devices)
        simulation.reset(seed=1)
        return simulation

    yield make
    for simulation in made:
        simulation.close()


def test_robot_drives_in_steps_of_the_laboratory(make: Make) -> None:
    simulation = make()
    simulation.step(3.0)
    robot = simulation.body("a")
    assert robot.x_m == pytest.approx(0.3, abs=0.02) and robot.v_mps == pytest.approx(0.1)
    assert robot.driven_by == "Drive"
    assert simulation.world().time_s == pytest.approx(90 * 0.033)
    read = simulation.task("a", "Drive").read
    assert read[Pose].x_m == pytest.approx(robot.x_m, abs=0.02)
    assert 0.99 < read[Battery].level < 1.0 and read[Battery].voltage_v == pytest.approx(4.2, abs=0.01)


def test_robot_of_a_dead_agent_stands_when_its_command_ends(make: Make) -> None:
    simulation = make()
    simulation.step(2.0)
    simulation.crash("a")
    simulation.step(0.6)  # a command is good for half a second
    stood = simulation.body("a")
    assert (stood.v_mps, stood.driven_by) == (0.0, "")
    simulation.step(1.0)
    assert simulation.body("a").x_m == stood.x_m


def test_robot_whose_task_is_stopped_stands_at_once(make: Make) -> None:
    simulation = make()
    simulation.step(2.0)
    simulation.agents["a"].ask(Stop("Drive"))
    simulation.step(0.1)
    assert simulation.body("a").v_mps == 0.0


class Mad(Drive):
    """Command what is no number, now and then."""

    @every(hz=5)
    def rave(self, tick: Tick) -> None:
        self.publish(CTRL, Twist(0.1, math.nan))
        self.publish(CTRL, Twist(math.inf, 0.0))


def test_commands_that_are_no_numbers_harm_no_one(make: Make) -> None:
    simulation = make(Mad)
    simulation.step(3.0)
    assert simulation.body("a").x_m == pytest.approx(0.3, abs=0.02)
    assert simulation.agents["world"].events("task_failed") == []


def test_wheel_speeds_that_are_no_numbers_are_refused(make: Make) -> None:
    """They come past the driver only from a program of somebody else."""
    simulation = make(start=False)
    for wheels, ttl_s in ((Wheels(math.nan, 0.1), 0.5), (Wheels(0.1, 0.1), math.inf)):
        with pytest.raises(PancakesError, match="the wheels of a cannot run at"):
            simulation.task("world", "World").drive("a", wheels, ttl_s, "a/client/Drive")


class Fast(Drive):
    twist = Twist(0.2, 1.5)


def test_command_too_fast_is_slowed_down_without_a_fault(make: Make, tmp_path: Path) -> None:
    simulation = make(Fast)
    simulation.step(3.0)
    robot = simulation.body("a")
    assert robot.v_mps / robot.omega_radps == pytest.approx(0.2 / 1.5)
    simulation.stop("world")
    verdict = json.loads((tmp_path / "robotarium.json").read_text())
    assert verdict["counts"] == {"steps": 90, "collision": 0, "boundary": 0, "actuator": 0, "other": 0}
    assert verdict["rps"] == "0.0.0" and "No errors in your simulation" in verdict["said"][-1]


def test_both_judges_see_a_collision_and_a_robot_outside(make: Make, tmp_path: Path) -> None:
    still = {"x_m": 0.3, "y_m": 0.0, "spread_m": 0.0}
    simulation = make(robots={"b": still}, arena={"width_m": 1.2, "height_m": 2.0})
    simulation.step(7.0)
    (collision,) = simulation.agents["world"].events("collision")
    assert collision["names"] == ["a", "b"] and collision["time_s"] == pytest.approx(1.9, abs=0.3)
    (outside,) = simulation.agents["world"].events("out_of_bounds")
    assert outside["names"] == ["a"] and outside["x_m"] == pytest.approx(0.6 - 0.055, abs=0.01)
    simulation.stop("world")
    counts = json.loads((tmp_path / "robotarium.json").read_text())["counts"]
    assert counts["collision"] > 50, "it counts steps, and drives robots through each other"
    assert counts["boundary"] == 0, "its floor is larger than this arena"


def test_ranges_see_robots_and_posts_but_no_walls(make: Make) -> None:
    simulation = make(
        start=False,
        robots={"b": {"x_m": 0.5, "y_m": 0.0, "spread_m": 0.0}},
        sensors={"post": {"x_m": 0.0, "y_m": 0.4, "radius_m": 0.06}},
        range_noise=0.0,
    )
    simulation.agents["a"].probe.follow("system")
    simulation.step(1.0)
    (sweep,) = {packet.body for packet in simulation.agents["a"].probe.packets(Infrared)}
    seen = {round(math.degrees(b)): r for b, r in zip(sweep.bearings_rad, sweep.ranges_m, strict=True)}
    assert seen[0] == pytest.approx(0.5 - 0.05 - 0.055, abs=0.002)
    assert seen[90] == pytest.approx(0.4 - 0.06 - 0.06, abs=0.002)
    assert seen[-90] == seen[180] == sweep.max_range_m == 1.2


def test_guest_drives_to_its_waypoints_and_is_sensed(make: Make) -> None:
    simulation = make(
        start=False,
        sensors={"post": {"x_m": 0.0, "y_m": 0.5, "motion": {"range_m": 1.5, "locates": True}}},
        movers={"guest": {"x_m": -0.8, "y_m": 0.5, "spread_m": 0.0, "waypoints": [[-0.8, -0.5], [-0.8, 0.5]]}},
    )
    simulation.add("post", tasks={"Listen": Listen}, devices={"motion": device("sim.motion", 5)})
    simulation.reset(seed=1)
    simulation.step(11.0)
    guest = simulation.body("guest")
    assert guest.kind == "mover" and guest.battery_v is None
    assert guest.y_m == pytest.approx(-0.5, abs=0.2)
    simulation.step(12.0)
    assert simulation.body("guest").y_m > 0.0, "it is on its way back"
    heard = simulation.task("post", "Listen").heard
    assert any(motion.detected for motion in heard)
    assert [body.name for body in simulation.world().bodies] == ["a", "post", "guest"]


def test_empty_battery_stops_a_robot(make: Make) -> None:
    battery = {"capacity_j": 3.0}
    simulation = make(robots={"a": {"x_m": 0.0, "y_m": 0.0, "battery": battery}})
    simulation.step(10.0)
    robot = simulation.body("a")
    assert robot.v_mps == 0.0 and robot.battery_v == pytest.approx(3.3)


@pytest.mark.parametrize(
    ("devices", "said"),
    [
        ({"motors": device("robotarium.motors", body="z")}, "has no robot that agents drive 'z', only a"),
        ({"motors": device("robotarium.motors", body="guest")}, "has no robot that agents drive 'guest', only a"),
        ({"motors": device("sim.differential_drive", body="a")}, "a is a gternal .*, its driver expects a 'khepera3'"),
        ({"sonar": device("sim.sonar", 1, body="a")}, "nothing in the Robotarium has a device of the type 'sonar'"),
        ({"motion": device("sim.motion", 1, body="a")}, "has no sensor node 'a', only none"),
        ({"pose": device("robotarium.pose", 1, body="z")}, "has no body 'z', only a, guest"),
    ],
)
def test_device_that_a_body_has_not_is_refused(devices: dict[str, Any], said: str, make: Make) -> None:
    simulation = make(movers={"guest": {"x_m": 1.0, "y_m": 0.0}})
    simulation.add("b", devices=devices)
    simulation.reset(seed=1)
    simulation.step(1.5)
    lines = simulation.agents["b"].lines("error")
    assert len(lines) == 1 and re.search(said, lines[0]), lines


def test_robot_that_is_not_seen_has_no_pose(make: Make, robotarium: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    class Blinking(robotarium):
        """Cameras that lose all robots for a while."""

        def get_poses(self) -> Any:
            return super().get_poses() * (math.nan if 60 <= self._iterations < 90 else 1.0)

    monkeypatch.setattr("pancakes_robotarium.laboratory.simulator", lambda: Blinking)
    simulation = make(start=False)
    simulation.agents["a"].probe.follow("system")
    simulation.step(5.0)
    (line,) = simulation.agents["world"].lines("warning")
    assert "the Robotarium does not see a: it has no pose until it does" in line
    stamps = [packet.stamp_s for packet in simulation.agents["a"].probe.packets(Pose)]
    assert [stamp for stamp in stamps if 2.1 < stamp < 2.9] == [] and max(stamps) > 4.5
    assert simulation.agents["world"].events("task_failed") == []


def test_changed_settings_count_from_the_next_start(make: Make) -> None:
    simulation = make()
    simulation.agents["world"].ask(Configure("World", {"state_steps": 5}))
    simulation.step(0.5)
    (line,) = simulation.agents["world"].lines("warning")
    assert "its new settings count from its next start" in line
