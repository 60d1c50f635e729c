"""What owns a simulated world ends, or fails, and starts again: it listens again, and robots drive on."""

import math
from dataclasses import dataclass

import pytest
from pancakes_sensor_field.field import Field
from pancakes_sensor_field.tiny_nodes import SimulatedTinyNodes

from pancakes.control import Describe, Restart, Start, Stop
from pancakes.devices import Pose, Twist
from pancakes.mesh.transport import ConnectionHandler
from pancakes.packet import Packet, packet_type
from pancakes.sim.hardware_bus import Attach, Drive, encode
from pancakes.sim.world import World
from pancakes.sim.world_state import WorldState
from pancakes.task import Task, every, on
from pancakes.testing import Fleet

BUS = "tcp://127.0.0.1:7499"
LINE = "tcp://127.0.0.1:7421"


@packet_type("test.break")
@dataclass(frozen=True)
class Break:
    """Fail the task that takes it."""


class _Breakable(Task):
    @on("network", Break)
    def break_off(self, packet: Packet) -> None:
        raise RuntimeError("broken")


class BreakableWorld(_Breakable, World):
    pass


class BreakableField(_Breakable, Field):
    pass


class BreakableNodes(_Breakable, SimulatedTinyNodes):
    pass


WORLD = {"type": BreakableWorld, "settings": {"bus": BUS, "robots": {"robot": {"x_m": 0.0, "y_m": 0.0}}}}
FIELD = {"type": BreakableField, "settings": {"bus": BUS, "nodes": {"shed": {"x_m": 0.0, "y_m": 0.0}}}}
NODES = {
    "type": BreakableNodes,
    "settings": {"nodes": {"shed": {"number": 1, "line": LINE, "period_s": 1.0}}},
}


class Driving(Task):
    """Drive as it is told, at 10 Hz."""

    requires = ("motors",)
    says = Twist(0.1, 0.0)

    @every(hz=10)
    def drive(self, tick):
        self.publish("ctrl", self.says)


class DrivingOnNan(Driving):
    says = Twist(0.1, math.nan)


@pytest.fixture
def fleet():
    with Fleet(seed=3) as made:
        yield made


ROBOT = {
    "motors": {"type": "sim.differential_drive", "settings": {"world": BUS}},
    "pose": {"type": "sim.pose", "rate_hz": 10.0, "settings": {"world": BUS}},
}


@pytest.mark.parametrize("how", ["fails", "is restarted", "is stopped and started"])
@pytest.mark.parametrize("task", [WORLD, FIELD, NODES], ids=["world", "field", "tiny nodes"])
def test_what_listened_listens_again_after_it_has_ended(fleet, task, how):
    world = fleet.start("world", tasks={"World": task}, role="environment")
    fleet.run_for(1.0)
    if how == "fails":
        world.publish("network", Break())
    elif how == "is restarted":
        assert world.ask(Restart("World")).ok
    else:
        assert world.ask(Stop("World")).ok
        assert world.ask(Start("World")).ok
    fleet.run_for(3.0)
    assert world.ask(Describe("World")).result["state"] == "running"
    assert not [event for event in world.events("task_failed") if "in use" in event["error"]]
    world.publish("network", Break())
    fleet.run_for(3.0)
    assert world.ask(Describe("World")).result["state"] == "running"


def test_robots_find_their_world_again_once_it_was_restarted(fleet):
    world = fleet.start("world", tasks={"World": WORLD}, role="environment")
    robot = fleet.start("robot", devices=ROBOT, tasks={"Driving": Driving})
    fleet.run_for(2.0)
    world.publish("network", Break())
    fleet.run_for(3.0)
    robot.probe.forget()
    world.probe.forget()
    fleet.run_for(2.0)
    assert len(robot.probe.packets(Pose)) > 10
    first, *_, last = (packet.body.bodies[0].x_m for packet in world.probe.packets(WorldState))
    assert last > first + 0.1


def test_a_command_with_nan_moves_nothing_and_hurts_no_world(fleet):
    world = fleet.start("world", tasks={"World": WORLD}, role="environment")
    robot = fleet.start("robot", devices=ROBOT, tasks={"Driving": DrivingOnNan})
    fleet.run_for(3.0)
    assert robot.events("command_refused", device="motors", by="robot/client/Driving")
    assert not world.events("task_failed") and not robot.events("task_failed")
    first, *_, last = (packet.body.bodies[0].x_m for packet in world.probe.packets(WorldState))
    assert first == last


class Liar(ConnectionHandler):
    """Speak on the hardware bus, and says what no drive says."""

    def __init__(self):
        self.said = b""

    def opened(self, connection):
        connection.send(encode(Attach("robot", "motors", "motors", "khepera3")))
        for wheels in ((0.1, math.nan), (math.inf, 0.0)):
            connection.send(encode(Drive("robot", "motors", *wheels, 1.0, "liar/client/Liar")))
        connection.send(encode(Drive("robot", "motors", 0.1, 0.1, math.nan, "liar/client/Liar")))

    def received(self, data):
        self.said += data

    def closed(self, reason):
        pass


def test_the_world_refuses_wheel_speeds_that_are_no_numbers(fleet):
    world = fleet.start("world", tasks={"World": WORLD}, role="environment")
    stranger = fleet.start("stranger")
    fleet.run_for(0.5)
    liar = Liar()
    stranger.kernel.transport.dial(BUS, liar)
    fleet.run_for(2.0)
    assert liar.said.count(b"refused") == 3
    assert not world.events("task_failed")
    assert math.isfinite(world.probe.packets(WorldState)[-1].body.bodies[0].x_m)
