"""Readings and commands that fail, or whose numbers are none: they are missed and counted, in one place for all."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy
import numpy.typing
import pytest
from msgspec import Meta, Struct

from pancakes.control import Describe
from pancakes.devices import Battery, Sonar, Temperature, Twist
from pancakes.devices.driver import Actuator, Sensor
from pancakes.events import Event, LogLine
from pancakes.packet import packet_type
from pancakes.task import Task, every
from pancakes.testing import Fleet


@packet_type("test.arm")
class Arm(Struct, frozen=True):
    """A command with numbers in many places."""

    joints_rad: tuple[float, ...] = ()
    grip: Annotated[float, Meta(ge=0, le=1)] = 0.0
    named: dict[str, float] = {}
    speed: float | None = None
    goal: Twist | None = None


@packet_type("test.field")
@dataclass(frozen=True)
class Force:
    """A command that is an array."""

    newton: numpy.typing.NDArray


class Flaky(Sensor):
    """A chip on a bus with noise: the readings whose numbers are named raise, or have the value that is named."""

    type = "temperature"
    bad: dict = {}
    asked = 0

    def open(self):
        type(self).asked = 0

    def read(self):
        type(self).asked += 1
        value = self.bad(self.asked) if callable(self.bad) else None
        if isinstance(value, Exception):
            raise value
        return Temperature(21.5) if value is None else value


class Taker(Actuator):
    """Writes down what it carries out; fails as it is told."""

    type = "motors"
    done: list
    fails: int = 0

    def open(self):
        type(self).done = []

    def write(self, command, ttl_s, source):
        if type(self).fails:
            type(self).fails -= 1
            raise OSError(121, "Remote I/O error")
        self.done.append(command)

    def safe_stop(self):
        self.done.append("hold")


class ArmDriver(Taker):
    type = "test.arm"


class ForceDriver(Taker):
    type = "test.field"


class Commanding(Task):
    """Commands what it is told at 10 Hz, in turns."""

    requires = ("motors",)
    says: list = []

    @every(hz=10)
    def command(self, tick):
        if self.says:
            self.publish("ctrl", self.says[round(tick.time_s * 10) % len(self.says)])


@pytest.fixture
def fleet():
    with Fleet(seed=4) as made:
        yield made


def flaky(bad, device_type="temperature"):
    return type("FlakyInTest", (Flaky,), {"bad": staticmethod(bad), "type": device_type})


def sensor(fleet, bad, device_type="temperature", **keys):
    device = {"type": flaky(bad, device_type), "rate_hz": 10.0, **keys}
    return fleet.start("a", devices={"chip": device})


def warnings(agent):
    packets = agent.probe.packets(LogLine)
    return [packet.body.text for packet in packets if packet.body.level == "warning"]


def readings_of(agent, name="chip"):
    return agent.ask(Describe(name)).result["readings"]


# Sensors -------------------------------------------------------------------------------------------------------


def test_one_read_in_thirty_that_fails_costs_that_reading_only(fleet):
    agent = sensor(fleet, lambda number: OSError(121, "Remote I/O error") if number % 30 == 0 else None)
    fleet.run_for(130.0)
    assert len(agent.probe.packets(Temperature)) == pytest.approx(1300 * 29 / 30, abs=3)
    assert not agent.events("task_failed")
    assert readings_of(agent)["missed"] == 43
    first, *later = warnings(agent)
    assert "Remote I/O error" in first
    assert 3 <= len(later) <= 4
    assert "10 of 300 readings (3.3 %)" in later[0]


def test_a_chip_that_is_gone_fails_its_device_after_some_reads_in_a_row(fleet):
    agent = sensor(fleet, lambda number: OSError("unplugged"), missed={"in_a_row": 7})
    fleet.run_for(0.65)
    assert not agent.events("task_failed")
    fleet.run_for(0.1)
    assert "OSError: unplugged" in agent.events("task_failed")[0]["error"]


def test_a_share_of_misses_that_is_too_large_fails_the_device(fleet):
    agent = sensor(
        fleet, lambda number: OSError("noise") if number % 3 else None, missed={"share": 0.6, "within_mission_s": 5.0}
    )
    fleet.run_for(4.9)
    assert not agent.events("task_failed")
    fleet.run_for(0.6)
    assert len(agent.events("task_failed")) == 1


@pytest.mark.parametrize(
    ("device_type", "reading"),
    [
        ("temperature", Temperature(math.nan)),
        ("temperature", Temperature(math.inf)),
        ("battery", Battery(7.4, 1.2)),
        ("battery", Battery(7.4, math.nan)),
        ("sonar", Sonar((0.0, 1.0), (1.0, math.nan), 4.0)),
    ],
)
def test_a_reading_whose_number_is_none_is_missed(fleet, device_type, reading):
    agent = sensor(fleet, lambda number: reading if number == 3 else Temperature(1.0), device_type)
    fleet.run_for(2.0)
    assert not agent.probe.packets(type(reading), channel="system") or type(reading) is Temperature
    assert reading not in [packet.body for packet in agent.probe.packets(channel="system")]
    assert readings_of(agent)["missed"] == 1
    assert any("chip: a reading is missed" in text for text in warnings(agent))


def test_a_voltage_that_is_not_known_is_no_fault(fleet):
    agent = sensor(fleet, lambda number: Battery(math.nan, 0.5), "battery")
    fleet.run_for(1.0)
    assert len(agent.probe.packets(Battery)) == 10


def test_a_reading_that_comes_by_itself_and_is_none_is_missed_too(fleet):
    class Speaking(Sensor):
        type = "temperature"
        rate = "none"

        def open(self):
            self.context.after(1.0, lambda: self.context.deliver(Temperature(math.nan)))
            self.context.after(2.0, lambda: self.context.deliver(Temperature(4.0)))
            self.context.after(3.0, lambda: self.context.missed("it stuttered"))

        def read(self):
            return None

    agent = fleet.start("a", devices={"chip": Speaking})
    fleet.run_for(4.0)
    assert [packet.body for packet in agent.probe.packets(Temperature)] == [Temperature(4.0)]
    assert readings_of(agent) == {"came": 1, "missed": 2, "why": "it stuttered", "silent_s": None}


def test_a_sensor_that_falls_silent_is_told_as_silent_until_it_speaks_again(fleet):
    class Speaking(Sensor):
        type = "temperature"
        rate = "none"
        dialled = 0

        def open(self):
            for time_s in (1.0, 30.0):
                self.context.after(time_s, lambda: self.context.deliver(Temperature(4.0)))

        def read(self):
            return None

        def silent(self):
            type(self).dialled += 1

    agent = fleet.start("a", devices={"chip": {"type": Speaking, "silent_mission_s": 5.0}})
    fleet.run_for(4.0)
    assert agent.ask(Describe("chip")).result["rest"] == ""
    fleet.run_for(17.0)
    described = agent.ask(Describe("chip")).result
    assert described["rest"] == "silent"
    assert described["readings"]["silent_s"] == pytest.approx(20.0, abs=0.5)
    assert Speaking.dialled == 4
    fleet.run_for(10.0)
    assert agent.ask(Describe("chip")).result["rest"] == ""
    lines = [packet.body.text for packet in agent.probe.packets(LogLine) if "chip: " in packet.body.text]
    assert lines == ["chip: no reading has come for 5.0 s of mission time", "chip: readings come again"]


# Actuators -----------------------------------------------------------------------------------------------------


def commanding(fleet, driver, *bodies, **keys):
    task = type("CommandingInTest", (Commanding,), {"says": list(bodies), "requires": (driver.type,)})
    return fleet.start("a", devices={"wheels": {"type": driver, **keys}}, tasks={"Commanding": task})


@pytest.mark.parametrize(
    ("driver", "body", "named"),
    [
        (Taker, Twist(0.1, math.nan), "omega_radps is nan"),
        (Taker, Twist(-math.inf, 0.0), "v_mps is -inf"),
        (Taker, Twist("fast", 0.0), "v_mps is 'fast'"),  # type: ignore[arg-type]
        (ArmDriver, Arm((0.0, math.nan)), "joints_rad[1] is nan"),
        (ArmDriver, Arm(grip=1.5), "grip is 1.5, above 1"),
        (ArmDriver, Arm(None), "joints_rad is None, which is no list"),  # type: ignore[arg-type]
        (ArmDriver, Arm(goal="home"), "goal is 'home', which is no Twist"),  # type: ignore[arg-type]
        (ArmDriver, Arm(named={"elbow": math.inf}), "named['elbow'] is inf"),
        (ArmDriver, Arm(speed=math.nan), "speed is nan"),
        (ArmDriver, Arm(goal=Twist(0.0, math.nan)), "goal.omega_radps is nan"),
        (ForceDriver, Force(numpy.array([0.0, math.nan])), "newton has a number in it that is not finite"),
    ],
)
def test_a_command_whose_number_is_none_is_refused_and_its_sender_named(fleet, driver, body, named):
    sound = {Taker: Twist(0.1, 0.0), ArmDriver: Arm(), ForceDriver: Force(numpy.ones(2))}[driver]
    agent = commanding(fleet, driver, sound, body)
    fleet.run_for(2.0)
    assert sound in [it for it in driver.done if it is sound]
    assert body not in [it for it in driver.done if it is body]
    refused = agent.events("command_refused", device="wheels", by="a/client/Commanding")
    assert named in refused[0]["reason"]
    assert any("a/client/Commanding" in text and named in text for text in warnings(agent))
    assert not agent.events("task_failed")


def test_a_command_that_is_none_brings_the_safe_hold_at_once(fleet):
    agent = commanding(fleet, Taker, Twist(0.1, 0.0), *[Twist(0.1, math.nan)] * 3, hold_after_mission_s=5.0)
    fleet.run_for(2.0)
    assert Taker.done[:6] == [Twist(0.1, 0.0), "hold"] * 3
    assert agent.events("safe_hold", device="wheels", reason="a command was no command")


def test_a_stranger_stops_nothing_with_a_command_that_is_none(fleet):
    agent = commanding(fleet, Taker, Twist(0.1, 0.0))
    stranger = fleet.start("b")
    fleet.run_for(1.0)
    stranger.publish("ctrl", Twist(math.nan, 0.0), to="a/device/wheels")
    fleet.run_for(1.0)
    assert "hold" not in Taker.done
    assert agent.events("command_refused", device="wheels", by="b/test/Probe")


def test_a_command_that_the_hardware_does_not_take_is_missed(fleet):
    Taker.fails = 3
    agent = commanding(fleet, Taker, Twist(0.1, 0.0))
    fleet.run_for(2.0)
    assert not agent.events("task_failed")
    assert len(Taker.done) == pytest.approx(17, abs=1)
    assert readings_of(agent, "wheels")["missed"] == 3
    assert any("wheels: a command is missed: OSError: [Errno 121]" in text for text in warnings(agent))


def test_hardware_that_takes_no_command_at_all_holds_and_fails(fleet):
    Taker.fails = 5
    agent = commanding(fleet, Taker, Twist(0.1, 0.0))
    fleet.run_for(1.0)
    assert "Remote I/O error" in agent.events("task_failed", task="wheels")[0]["error"]


def test_misses_are_events_of_a_device_and_not_of_its_service(fleet):
    agent = sensor(fleet, lambda number: OSError("noise") if number == 2 else None)
    fleet.run_for(1.0)
    assert [it.source for it in agent.probe.packets(LogLine) if "is missed" in it.body.text] == ["a/device/chip"]
    assert not [it for it in agent.probe.packets(Event) if it.body.kind == "task_failed"]
