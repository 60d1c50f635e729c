"""The siren of a tiny node: an actuator on a line, with a dead-man switch in the node."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from devices.driver_context import DriverContext
from pancakes_sensor_field.drivers import TcpNodes, TinySiren
from pancakes_sensor_field.frame import SIREN, Decoder
from pancakes_sensor_field.mote import Mote
from pancakes_sensor_field.packets import Siren
from pancakes_sensor_field.wires import Wires

from pancakes.control import Configure, Describe, Stop
from pancakes.mesh.transport import Connection, ConnectionHandler
from pancakes.packet import CTRL
from pancakes.task import Task, Tick, every
from pancakes.testing import Fleet

LINE = "tcp://127.0.0.1:4001"


class Warn(Task):
    """Sounds the siren for as long as it runs."""

    requires = ("sensor_field.siren",)

    @every(hz=10)
    def warn(self, tick: Tick) -> None:
        self.publish(CTRL, Siren(True))


class Hardware(ConnectionHandler):
    """A tiny node at the other end of a simulated line. It is on mains, so it lives where its gateway does not."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._connection: Connection | None = None
        self.mote = Mote(7, 60.0)
        fleet.network.transport("hardware").listen(LINE, lambda: self)

    def opened(self, connection: Connection) -> None:
        self._connection = connection

    def received(self, data: bytes) -> None:
        self._send(self.mote.received(data, self._fleet.now()))

    def closed(self, reason: str) -> None:
        self._connection = None

    def start(self) -> None:
        self._send(self.mote.start(self._fleet.now()))

    def sounds_in(self, for_s: float) -> bool:
        """Whether its siren sounds after so long."""
        self._fleet.run_for(for_s)
        self._send(self.mote.tick(self._fleet.now()))
        return self.mote.sounds

    def _send(self, data: bytes) -> None:
        if data and self._connection is not None:
            self._connection.send(data)


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet() as made:
        yield made


@pytest.fixture
def hardware(fleet: Fleet) -> Hardware:
    made = Hardware(fleet)
    devices = {
        "line": {"type": TcpNodes, "rate_hz": 1, "settings": {"nodes": {"shed": 7}, "address": LINE}},
        "siren": {"type": TinySiren, "settings": {"node": "shed", "number": 7}},
    }
    fleet.start("gateway", devices=devices, tasks={"Warn": Warn})
    fleet.run_for(1.0)
    return made


def test_it_sounds_while_its_task_says_so(fleet: Fleet, hardware: Hardware) -> None:
    hardware.start()
    assert hardware.sounds_in(0.3) and hardware.sounds_in(1.0)
    assert fleet.agents["gateway"].ask(Stop("Warn")).ok
    assert not hardware.sounds_in(0.1)


def test_it_falls_silent_by_itself_where_its_gateway_is_dead(fleet: Fleet, hardware: Hardware) -> None:
    hardware.start()
    assert hardware.sounds_in(1.0)
    fleet.crash("gateway")
    assert hardware.sounds_in(0.3)
    assert not hardware.sounds_in(0.3)


def test_its_driver_says_that_it_does(fleet: Fleet, hardware: Hardware) -> None:
    assert fleet.agents["gateway"].ask(Describe("siren")).result["watchdog_s"] == 0.5


def test_a_node_that_has_not_spoken_cannot_be_commanded_and_that_is_said_once(fleet: Fleet, hardware: Hardware) -> None:
    gateway = fleet.agents["gateway"]
    warned = "the siren of shed is not commanded: the node has not sent on its line yet"
    assert sum(warned in line for line in gateway.lines("warning")) == 1
    hardware.start()
    assert hardware.sounds_in(0.3)
    assert gateway.ask(Configure("line", {"period_s": 5.0})).ok, "the line is opened anew"
    fleet.run_for(1.0)
    hardware.start()
    assert hardware.sounds_in(0.3)


@pytest.mark.parametrize(("ttl_s", "tenths"), [(0.5, 5), (0.37, 3), (0.05, 0), (0.3, 3), (1e9, 32767)])
def test_a_command_is_good_for_whole_tenths_of_a_second_and_rather_too_short(ttl_s: float, tenths: int) -> None:
    sent: list[bytes] = []
    wires = Wires()
    wires.note("shed", sent.append)
    context = DriverContext(device="siren", shared={"sensor_field.wires": wires})
    siren = TinySiren(context, TinySiren.Settings("shed", 7))
    siren.write(Siren(True), ttl_s, "a/client/Warn")
    siren.write(Siren(False), ttl_s, "a/client/Warn")
    siren.safe_stop()
    frames = Decoder().feed(b"".join(sent))
    assert [(frame.node, frame.kind, frame.value) for frame in frames] == [
        (7, SIREN, tenths),
        (7, SIREN, 0),
        (7, SIREN, 0),
    ]
