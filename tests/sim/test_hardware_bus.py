"""The hardware bus: drivers at one end, the world at the other, over a network in memory and over TCP."""

import random
import threading
from typing import Any

import pytest
from devices.driver_context import DriverContext

from pancakes.devices import Battery, Pose, Twist
from pancakes.errors import PancakesError, RemoteProtocolError
from pancakes.kernel.virtual_time import VirtualDispatcher
from pancakes.mesh.memory_network import MemoryNetwork
from pancakes.mesh.transport import ConnectionHandler, SocketTransport
from pancakes.settings import SettingsError, make_settings
from pancakes.sim import hardware_bus
from pancakes.sim.drivers import DifferentialDrive, SimulatedBattery, SimulatedInfrared, SimulatedPose
from pancakes.sim.hardware_bus import BusClient, BusServer
from pancakes.util.clock import MonotonicClock
from pancakes.util.plugins import Plugins

ADDRESS = "tcp://127.0.0.1:7499"


class Rig:
    """A world that answers from a table, and an agent whose drivers ask it, in virtual time."""

    def __init__(self):
        self.dispatcher = VirtualDispatcher(1)
        self.network = MemoryNetwork(self.dispatcher.call_at, self.dispatcher.clock.now, random.Random(1))
        self.world_transport = self.network.transport("world")
        self.requests = []
        self.answers = {hardware_bus.Attach: hardware_bus.Attached("")}
        self.world_log = []

    def open_world(self, transport=None):
        transport = transport or self.world_transport
        self.server = BusServer(
            transport, lambda function: function(), self.serve, lambda *line: self.world_log.append(line)
        )
        assert self.server.listen(ADDRESS) == ADDRESS

    def serve(self, request):
        self.requests.append(request)
        return self.answers.get(type(request))

    def run(self, duration_s):
        self.dispatcher.run_until(self.dispatcher.clock.now() + duration_s)

    def asked(self, kind):
        return [request for request in self.requests if isinstance(request, kind)]


class Context(DriverContext):
    """What a driver on the rig's network sees of its agent."""

    def __init__(self, rig, agent="agent1", device="motors", shared=None):
        super().__init__(agent, device, rig.network.transport(agent), shared)


@pytest.fixture
def rig():
    return Rig()


def opened(cls, context, **settings):
    driver = cls(context, make_settings(cls.Settings, {"world": ADDRESS, **settings}))
    driver.open()
    return driver


def test_a_drive_sends_wheel_speeds_with_their_time_to_live_and_their_source(rig):
    rig.open_world()
    drive = opened(DifferentialDrive, Context(rig))
    rig.run(1.0)
    drive.write(Twist(0.1, 0.2), 0.5, "agent1/client/ScanTarget")
    rig.run(0.1)
    (attach,) = rig.asked(hardware_bus.Attach)
    assert (attach.body, attach.type, attach.model) == ("agent1", "motors", "khepera3")
    (command,) = rig.asked(hardware_bus.Drive)
    assert (command.body, command.ttl_s, command.source) == ("agent1", 0.5, "agent1/client/ScanTarget")
    assert command.left_mps == pytest.approx(0.1 - 0.2 * 0.0885 / 2)
    assert command.right_mps == pytest.approx(0.1 + 0.2 * 0.0885 / 2)


def test_a_measured_wheel_base_takes_the_place_of_the_models(rig):
    rig.open_world()
    drive = opened(DifferentialDrive, Context(rig), wheel_base_m=0.1)
    rig.run(1.0)
    drive.write(Twist(0.0, 1.0), 0.5, "x")
    rig.run(0.1)
    assert rig.asked(hardware_bus.Drive)[0].right_mps == pytest.approx(0.05)


def test_hold_is_sent_at_once(rig):
    rig.open_world()
    drive = opened(DifferentialDrive, Context(rig), body="robot7")
    rig.run(1.0)
    drive.safe_stop()
    rig.run(0.1)
    assert [halt.body for halt in rig.asked(hardware_bus.Halt)] == ["robot7"]


def test_a_sample_is_asked_for_and_delivered_when_it_comes(rig):
    rig.open_world()
    rig.answers[hardware_bus.Sample] = hardware_bus.Reading("pose", "pose", {"x_m": 1.0, "y_m": 2.0, "theta_rad": 0.5})
    context = Context(rig, device="pose")
    sensor = opened(SimulatedPose, context)
    rig.run(1.0)
    assert sensor.read() is None
    assert context.readings == []
    rig.run(0.1)
    assert context.readings == [Pose(1.0, 2.0, 0.5)]


def test_one_question_is_under_way_at_a_time(rig):
    rig.open_world()
    context = Context(rig, device="pose")
    sensor = opened(SimulatedPose, context)
    rig.run(1.0)
    for _ in range(3):  # nobody answers
        sensor.read()
        rig.run(0.1)
    assert len(rig.asked(hardware_bus.Sample)) == 1


def test_the_battery_tells_how_many_packets_were_sent_and_whether_the_radio_listens(rig):
    rig.open_world()
    rig.answers[hardware_bus.Sample] = hardware_bus.Reading("battery", "battery", {"voltage_v": 8.0, "level": 0.8})
    context = Context(rig, device="battery")
    context.packets = 42
    sensor = opened(SimulatedBattery, context)
    rig.run(1.0)
    sensor.read()
    rig.run(0.1)
    assert rig.asked(hardware_bus.Sample)[0].packets_sent == 42
    assert rig.asked(hardware_bus.Sample)[0].listening is True
    assert context.readings == [Battery(8.0, 0.8)]
    context.awake = False
    sensor.read()
    rig.run(0.1)
    assert rig.asked(hardware_bus.Sample)[1].listening is False


def test_the_drivers_of_an_agent_share_one_connection(rig):
    rig.open_world()
    shared: dict[str, Any] = {}
    for cls, device in ((SimulatedPose, "pose"), (SimulatedInfrared, "ir")):
        opened(cls, Context(rig, device=device, shared=shared))
    rig.run(1.0)
    assert len(shared) == 1
    assert sorted(attach.device for attach in rig.asked(hardware_bus.Attach)) == ["ir", "pose"]


def test_a_refusal_is_said_once(rig):
    rig.open_world()
    rig.answers[hardware_bus.Attach] = hardware_bus.Refused(
        "ir", "agent1 is a pioneer3dx, which has no infrared sensors"
    )
    rig.answers[hardware_bus.Sample] = rig.answers[hardware_bus.Attach]
    context = Context(rig, device="ir")
    sensor = opened(SimulatedInfrared, context)
    for _ in range(3):
        rig.run(0.5)
        sensor.read()
    assert [line for line in context.lines if line[0] == "error"] == [
        ("error", "agent1 is a pioneer3dx, which has no infrared sensors")
    ]


def test_a_world_that_comes_later_is_found(rig):
    context = Context(rig, device="pose")
    opened(SimulatedPose, context)
    rig.run(3.0)
    assert rig.requests == []
    rig.open_world()
    rig.run(2.0)
    assert [request.body for request in rig.asked(hardware_bus.Attach)] == ["agent1"]
    assert ("info", f"reached the world at {ADDRESS}") in context.lines


def test_a_world_that_does_not_answer_is_warned_of_once(rig):
    context = Context(rig, device="pose")
    opened(SimulatedPose, context)
    rig.run(30.0)
    warnings = [text for level, text in context.lines if level == "warning"]
    assert len(warnings) == 1
    assert warnings[0].startswith(f"the world at {ADDRESS} does not answer")


def test_a_world_that_dies_is_said_to_be_gone_and_what_was_asked_is_forgotten(rig):
    rig.open_world()
    context = Context(rig, device="pose")
    sensor = opened(SimulatedPose, context)
    rig.run(1.0)
    sensor.read()
    rig.world_transport.close()
    rig.run(1.0)
    errors = [text for level, text in context.lines if level == "error"]
    assert len(errors) == 1
    assert errors[0].startswith(f"the world at {ADDRESS} is gone")
    sensor.read()
    rig.run(1.0)

    rig.requests.clear()
    rig.open_world(rig.network.transport("world"))
    rig.run(3.0)
    sensor.read()
    rig.run(0.1)
    assert [type(request) for request in rig.requests] == [hardware_bus.Attach, hardware_bus.Sample]


def test_a_world_task_that_ends_closes_its_bus_and_is_said_to_be_gone_once(rig):
    rig.open_world()
    context = Context(rig, device="pose")
    opened(SimulatedPose, context)
    rig.run(1.0)
    rig.server.close()
    rig.run(20.0)
    assert [level for level, _ in context.lines] == ["info", "error", "warning"]


def test_a_closed_client_dials_no_more(rig):
    client = BusClient(rig.network.transport("agent1"), ADDRESS, lambda level, text: None)
    rig.run(0.5)
    client.close()
    rig.open_world()
    rig.run(5.0)
    assert not client.send(hardware_bus.Halt("agent1", "motors"))


def test_garbage_closes_that_connection_and_no_other(rig):
    rig.open_world()
    context = Context(rig, device="pose")
    opened(SimulatedPose, context)

    class Rude(ConnectionHandler):
        reason = None

        def opened(self, connection):
            connection.send(b"\x00\x00\x00\x04junk")

        def received(self, data):
            pass

        def closed(self, reason):
            self.reason = reason

    rude = Rude()
    rig.network.transport("stranger").dial(ADDRESS, rude)
    rig.run(1.0)
    assert rude.reason is not None
    assert "that is not a request to a simulated world" in rig.world_log[0][1]
    assert [line for line in context.lines if line[0] == "error"] == []


@pytest.mark.parametrize("cut", [1, 3, 7])
def test_requests_are_read_however_the_network_cuts_them(cut):
    requests: list[hardware_bus.Request] = [
        hardware_bus.Attach("a", "motors", "motors", "khepera3"),
        hardware_bus.Drive("a", "motors", 0.1, 0.2, 0.5, "x"),
        hardware_bus.Halt("a", "m"),
    ]
    data = b"".join(hardware_bus.encode(request) for request in requests)
    reader = hardware_bus.RequestReader()
    assert [r for i in range(0, len(data), cut) for r in reader.feed(data[i : i + cut])] == requests


def test_a_request_of_the_wrong_shape_is_refused():
    with pytest.raises(RemoteProtocolError, match="not a request to a simulated world"):
        hardware_bus.RequestReader().feed(hardware_bus.encode(hardware_bus.Reading("ir", "ir", {})))
    with pytest.raises(RemoteProtocolError, match="not a reply of a simulated world"):
        hardware_bus.ReplyReader().feed(hardware_bus.encode(hardware_bus.Halt("a", "motors")))


def test_an_unknown_model_is_a_mistake_in_the_settings():
    with pytest.raises(SettingsError, match="no robot model 'pioneer'"):
        make_settings(DifferentialDrive.Settings, {"world": ADDRESS, "model": "pioneer"})
    with pytest.raises(SettingsError, match="world: is missing"):
        make_settings(DifferentialDrive.Settings, {})


def test_it_works_over_tcp_as_well():
    served, answered = threading.Event(), threading.Event()
    insecure = {"tcp": {"insecure": True}}
    world, agent = (SocketTransport(MonotonicClock(), name, Plugins(), insecure) for name in ("world", "agent1"))
    pose = hardware_bus.Reading("pose", "pose", {"x_m": 1.0, "y_m": 2.0, "theta_rad": 0.5})

    def serve(request):
        served.set()
        return pose if isinstance(request, hardware_bus.Sample) else None

    try:
        address = BusServer(world, lambda function: function(), serve, lambda *line: None).listen("tcp://127.0.0.1:0")

        class Answered(DriverContext):
            def deliver(self, body):
                super().deliver(body)
                answered.set()

        context = Answered(transport=agent)
        sensor = SimulatedPose(context, SimulatedPose.Settings(address))
        sensor.open()
        assert served.wait(10.0), "the attachment did not arrive"
        sensor.read()
        assert answered.wait(10.0), "the reading did not come"
        assert context.readings == [Pose(1.0, 2.0, 0.5)]
    finally:
        agent.close()
        world.close()


def test_an_address_in_use_is_said(rig):
    rig.open_world()
    with pytest.raises(PancakesError, match="7499"):
        rig.open_world()


def test_a_reading_arrives_as_what_it_was_and_one_that_does_not_fit_its_type_is_refused():
    def arrived(kind, value):
        (answer,) = hardware_bus.ReplyReader().feed(hardware_bus.encode(hardware_bus.Reading("device", kind, value)))
        assert isinstance(answer, hardware_bus.RawReading)
        return answer.body()

    assert arrived("pose", Pose(1.0, 2.0, 0.5)) == Pose(1.0, 2.0, 0.5)
    assert arrived("of_a_plugin_that_is_not_here", {"depth_m": 3.0}) == {"depth_m": 3.0}
    with pytest.raises(RemoteProtocolError, match="a packet of the type 'pose' has a bad body"):
        arrived("pose", {"x_m": "far away"})
