"""The devices of a Khepera III, on a real pseudo-terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pancakes_pi.khepera import KheperaBattery, KheperaInfrared, KheperaMotors, KheperaSonar
from pancakes_pi.khepera_lines import NoAnswerError, numbers_in, ring_in, speeds, volts_in
from pi.khepera_bench import KheperaBench

from pancakes.control import Describe, Stop
from pancakes.devices import Battery, Infrared, Sonar, Twist
from pancakes.packet import CTRL
from pancakes.task import Task
from pancakes.testing import AgentHandle, threaded_agent


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[KheperaBench]:
    bench = KheperaBench(tmp_path / "tty")
    yield bench
    bench.unplug()


class Drive(Task):
    """Holds the wheels for a test."""

    requires = ("motors",)


def devices(robot: KheperaBench, hold_after_s: float = 30.0, rate_hz: float = 20.0) -> dict[str, Any]:
    settings = {"port": str(robot.link)}
    sensors = {"ir": KheperaInfrared, "sonar": KheperaSonar, "battery": KheperaBattery}
    return {
        "motors": {"type": KheperaMotors, "hold_after_mission_s": hold_after_s, "settings": settings},
        **{name: {"type": cls, "rate_hz": rate_hz, "settings": settings} for name, cls in sensors.items()},
    }


def drives(agent: AgentHandle, robot: KheperaBench, left: int, right: int) -> None:
    agent.wait_until(lambda: robot.speeds == (left, right), what=f"{left}, {right}; the robot has {robot.speeds}")


def is_there(agent: AgentHandle, times: int = 1) -> None:
    agent.wait_until(lambda: sum("speaks with a Khepera III" in it for it in agent.lines("info")) == times)


def test_its_sensors_are_read(robot: KheperaBench) -> None:
    with threaded_agent("a", devices=devices(robot)) as agent:
        ring = agent.wait_for(Infrared).body
        assert ring.raw == (3945, 22, 100, 0, 1, 2, 3, 4, 5) and len(ring.bearings_rad) == 9
        assert ring.ranges_m[0] == pytest.approx(0.02, abs=0.001) and ring.ranges_m[1] == pytest.approx(0.19, abs=0.01)
        assert ring.ranges_m[3] == ring.max_range_m == 0.2
        assert math.degrees(ring.bearings_rad[0]) == pytest.approx(128.0)
        sonar = agent.wait_for(Sonar).body
        assert sonar.ranges_m == (0.5, 0.3, 4.0, 4.0, 4.0) and len(sonar.bearings_rad) == 5
        assert agent.wait_for(Battery).body == Battery(7.8125, 0.64)


def test_its_wheels_turn_as_they_are_told_and_stand_at_the_safe_hold(robot: KheperaBench) -> None:
    with threaded_agent("a", devices=devices(robot), tasks={"Drive": Drive}) as agent:
        is_there(agent)
        assert "D,l0,l0" in robot.heard, "it stands before it is told anything"
        agent.task("Drive").publish(CTRL, Twist(0.1, 0.0))
        drives(agent, robot, 14401, 14401)
        agent.task("Drive").publish(CTRL, Twist(0.0, 1.0))
        drives(agent, robot, -6372, 6372)
        agent.task("Drive").publish(CTRL, Twist(9.0, 0.0))
        drives(agent, robot, 45219, 45219)
        assert agent.ask(Stop("Drive")).ok
        drives(agent, robot, 0, 0)


def test_it_stands_where_no_fresh_command_comes_and_where_the_agent_ends(robot: KheperaBench) -> None:
    with threaded_agent("a", devices=devices(robot, 0.2), tasks={"Drive": Drive}) as agent:
        is_there(agent)
        agent.task("Drive").publish(CTRL, Twist(0.1, 0.0))
        drives(agent, robot, 14401, 14401)
        drives(agent, robot, 0, 0)
        agent.task("Drive").publish(CTRL, Twist(0.1, 0.0))
        drives(agent, robot, 14401, 14401)
    agent.wait_until(lambda: robot.speeds == (0, 0), what="the wheels stand")


def test_a_cable_that_is_pulled_out_and_put_back_is_found_again(robot: KheperaBench) -> None:
    with threaded_agent("a", devices=devices(robot), tasks={"Drive": Drive}) as agent:
        agent.wait_for(Infrared)
        agent.task("Drive").publish(CTRL, Twist(0.1, 0.0))
        drives(agent, robot, 14401, 14401)
        robot.unplug()
        agent.wait_until(lambda: any("is gone (" in line for line in agent.lines("error")))
        agent.task("Drive").publish(CTRL, Twist(0.2, 0.0))
        agent.wait_until(lambda: "motors: commands are lost: the robot is not there" in agent.lines("warning"))
        agent.probe.forget()
        robot.plug()
        agent.wait_for(Infrared)
        assert robot.speeds == (0, 0), "and nothing that it was told meanwhile"
        agent.task("Drive").publish(CTRL, Twist(0.1, 0.0))
        drives(agent, robot, 14401, 14401)
        assert not agent.events("task_failed") and not agent.lines("error")


def test_a_robot_that_comes_up_late_is_found_and_its_absence_said_once(robot: KheperaBench) -> None:
    robot.unplug()
    with threaded_agent("a", devices=devices(robot)) as agent:
        agent.wait_until(lambda: any("cannot be used (No such file" in line for line in agent.lines("warning")))
        robot.plug()
        agent.wait_for(Infrared)
        assert len([line for line in agent.lines("warning") if "cannot be used" in line]) == 1


def test_a_robot_that_falls_silent_is_found_again(robot: KheperaBench) -> None:
    with threaded_agent("a", devices=devices(robot)) as agent:
        agent.wait_for(Infrared)
        robot.mute = True
        agent.wait_until(lambda: any("is gone (the robot does not answer)" in line for line in agent.lines("error")))
        robot.mute = False
        is_there(agent, 2)


def test_noise_on_the_line_is_named_once_and_costs_no_reading(robot: KheperaBench) -> None:
    robot.noise = b"\xff\x00garbage\r\nn,1,x\r\n"
    with threaded_agent("a", devices=devices(robot)) as agent:
        assert agent.wait_for(Infrared).body.raw[0] == 3945
        assert agent.wait_for(Battery).body.level == 0.64
        (line,) = [line for line in agent.lines("warning") if "is noisy" in line]
        assert "is no answer to B" in line and line.endswith("more of that is read past in silence")


def test_what_is_no_khepera_is_named(robot: KheperaBench) -> None:
    robot.mute = True
    with threaded_agent("a", devices=devices(robot)) as agent:
        agent.wait_until(lambda: any("(nothing answers like a Khepera III)" in it for it in agent.lines("warning")))


def test_too_few_sensors_are_named_and_not_told(robot: KheperaBench) -> None:
    robot.infrared = [1, 2, 3]
    with threaded_agent("a", devices=devices(robot)) as agent:
        agent.wait_until(
            lambda: any("the robot told 4 infrared sensors, not 11" in it for it in agent.lines("warning"))
        )
        agent.wait_for(Battery)
        assert not agent.probe.packets(Infrared)


def test_it_says_that_its_hardware_does_not_hold_by_itself(robot: KheperaBench) -> None:
    with threaded_agent("a", devices=devices(robot)) as agent:
        assert agent.ask(Describe("device/motors")).result["watchdog_s"] is None


def test_it_refuses_virtual_time_with_a_sentence(virtual_agent: Any) -> None:
    agent = virtual_agent("a", devices={"motors": {"type": KheperaMotors, "settings": {"port": "/dev/ttyUSB0"}}})
    failed = agent.wait_for_event("task_failed", task="motors")
    assert "a/device/motors is real hardware, which knows no virtual time" in failed["error"]


def test_a_service_of_the_system_may_open_its_port() -> None:
    (found,) = KheperaMotors.hardware(KheperaMotors.Settings("/dev/ttyUSB0"))
    assert (found.node, found.group) == ("/dev/ttyUSB0", "dialout")


def test_lines_of_the_protocol() -> None:
    assert speeds(99_999, -99_999) == "D,l48000,l-48000"
    assert numbers_in(b"n,1,-2\r\n", "N") == [1, -2] and numbers_in(b"d\r\n", "D,l0,l0") == []
    assert volts_in([7, 1]) == 7.0001
    for line in (b"", b"n,a", b"o,1", b"\xff", b"n,1.5", b"N,1", b"n,1_0"):
        with pytest.raises(NoAnswerError):
            numbers_in(line, "N")
    with pytest.raises(NoAnswerError):
        ring_in([1] * 10)
