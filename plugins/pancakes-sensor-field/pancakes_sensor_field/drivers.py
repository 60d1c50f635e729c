"""Drivers of a sensor field: lines with tiny nodes, virtual devices for these nodes, and a simulated thermometer.

A node that is too small for an agent becomes one or more devices of its gateway (paper §3.5). The gateway has a device
for the line of the node, and a virtual one for each thing that the node measures: the temperature of the node `shed`
is a reading of the device `shed_temperature`, and its motion one of `shed_motion`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

from msgspec import Meta

from pancakes import SYSTEM, Actuator, DeviceContext, FilePath, Hardware, NetworkSensor, Packet, Positive, Sensor
from pancakes.config import parse_address
from pancakes.devices import Motion, Temperature
from pancakes.packet import join
from pancakes.sim.drivers import SimulatedSensor
from pancakes_sensor_field.frame import SIREN, TEMPERATURE, Frame, encode
from pancakes_sensor_field.lines import Line, Reply, SerialLine, TcpLine, UdpLine
from pancakes_sensor_field.packets import LineReport, ReportPeriod, Siren
from pancakes_sensor_field.station import Reading, Station
from pancakes_sensor_field.wires import Wires

NodeNumber = Annotated[int, Meta(ge=1, le=254)]
PeriodS = Annotated[float, Meta(ge=0.1, le=3276.7)]


class LineNodes(Sensor):
    """A line with tiny nodes; each kind of line is a subclass.

    Its own readings report how well the nodes are heard. It passes a `ReportPeriod` on to the nodes.
    """

    type = "sensor_field.line"

    @dataclass
    class Settings:
        """The nodes on a line.

        Attributes:
            nodes: the number of each tiny node, by its name here.
            period_s: the report period of the nodes, in seconds; without it, their own.
            line_silent_s: after this time without a byte, in mission seconds, the line is opened again, because its
                other end may be gone. It must be longer than the report period.
        """

        nodes: dict[str, NodeNumber] = field(kw_only=True)
        period_s: PeriodS | None = field(default=None, kw_only=True)
        line_silent_s: Positive = field(default=300.0, kw_only=True)

        def __post_init__(self) -> None:
            numbers = list(self.nodes.values())
            for name, number in self.nodes.items():
                if numbers.count(number) > 1:
                    raise ValueError(f"{name} is not the only node with the number {number}")

    settings: Any

    def __init__(self, context: DeviceContext, settings: Any) -> None:
        super().__init__(context, settings)
        self._station = Station(settings.nodes, settings.period_s)
        self._wires = _wires(context)
        self._line: Line | None = None
        self._connected = False
        self._complained = False
        self._told_errors = 0
        self._heard_s = 0.0
        self._silent = False

    @abstractmethod
    def make_line(self) -> Line:
        """Return the line in the settings."""

    @abstractmethod
    def line_name(self) -> str:
        """Return what people call the line."""

    def open(self) -> None:
        self._heard_s = self.context.now()
        self._line = self.make_line()
        self._line.open(self)

    def close(self) -> None:
        if self._line is not None:
            self._line.close()
        self._forget()

    def read(self) -> LineReport:
        """Report how well the nodes are heard."""
        self._look_for_silence()
        station = self._station
        if station.crc_errors > self._told_errors:
            new, self._told_errors = station.crc_errors - self._told_errors, station.crc_errors
            self.context.log("info", f"{new} frames on {self.line_name()} had a wrong CRC and were dropped")
        return LineReport(
            self._connected,
            station.frames,
            station.crc_errors,
            station.skipped_bytes,
            station.missed,
            station.repeated,
            station.unknown,
        )

    def receive(self, packet: Packet) -> None:
        """Take a `ReportPeriod`."""
        wish = packet.body
        if not isinstance(wish, ReportPeriod):
            self.context.log("warning", f"{packet.source} sent {packet.type!r}, which no tiny node understands")
        elif not 0.1 <= wish.period_s <= 3276.7:
            self.context.log(
                "warning", f"{packet.source} asks for a report period of {wish.period_s:g} s: 0.1 to 3276.7"
            )
        elif not self._station.want_period(wish.period_s, wish.node):
            known = ", ".join(self.settings.nodes)
            self.context.log("warning", f"{packet.source} names a tiny node {wish.node!r}; the nodes are {known}")

    # From the line, in its thread ------------------------------------------------------------------------------

    def found(self) -> None:
        """The line is there."""
        self.context.call(self._found)

    def heard(self, data: bytes, reply: Reply, whole: bool) -> None:
        """Bytes have come in."""
        self.context.call(lambda: self._heard(data, reply, whole))

    def lost(self, reason: str) -> None:
        """The line is gone, or not there."""
        self.context.call(lambda: self._lost(reason))

    # In the device's task --------------------------------------------------------------------------------------

    def _found(self) -> None:
        self._connected = True
        self._complained = False
        if not self._silent:  # otherwise it was opened again after silence, which was logged
            self.context.log("info", f"listens to {self.line_name()}")

    def _lost(self, reason: str) -> None:
        was, self._connected = self._connected, False
        self._station.ended()
        self._forget()
        if was:
            self.context.log("error", f"{self.line_name()} is gone ({reason}); trying until it is there again")
        elif not self._complained:
            self.context.log("warning", f"{self.line_name()} cannot be used ({reason}); trying until it can")
        self._complained = True

    def _look_for_silence(self) -> None:
        silent_s = self.context.now() - self._heard_s
        if not self._connected or silent_s < self.settings.line_silent_s:
            return
        if not self._silent:
            self._silent = True
            text = f"nothing has come from {self.line_name()} for {silent_s:.0f} s: it is opened again"
            self.context.log("warning", text)
        self._heard_s = self.context.now()
        self._connected = False
        self._station.ended()
        self._forget()
        if self._line is not None:
            self._line.close()
        self._line = self.make_line()
        self._line.open(self)

    def _forget(self) -> None:
        for node in self.settings.nodes:
            self._wires.forget(node)

    def _heard(self, data: bytes, reply: Reply, whole: bool) -> None:
        self._heard_s = self.context.now()
        if self._silent:
            self._silent = False
            self.context.log("info", f"{self.line_name()} sends again")
        heard = self._station.received(data)
        if whole:
            self._station.ended()
        for number in heard.strangers:
            self.context.log(
                "warning", f"a node with the number {number} speaks on {self.line_name()}; the settings do not name it"
            )
        for node in heard.speakers:
            self._wires.note(node, reply)
        for reading in heard.readings:
            self._show(reading)
        if heard.answer:
            try:
                reply(heard.answer)
            except OSError:
                pass  # the line is gone, which its thread logs; the node is told when it next sends

    def _show(self, reading: Reading) -> None:
        """Pass a reading to its virtual device."""
        body: Any
        if reading.kind == TEMPERATURE:
            device, body = f"{reading.node}_temperature", Temperature(reading.value)
        else:
            device, body = f"{reading.node}_motion", Motion(reading.value != 0.0)
        self.context.send(SYSTEM, body, join(self.context.agent, "device", device))


class SerialNodes(LineNodes):
    """Tiny nodes on a serial port (`sensor_field.serial`)."""

    @dataclass
    class Settings(LineNodes.Settings):
        """The serial port.

        Attributes:
            port: the port's file, such as `/dev/ttyUSB0`.
            baud: bits a second.
        """

        port: FilePath
        baud: Annotated[int, Meta(ge=50)] = 9600

    def make_line(self) -> Line:
        return SerialLine(self.settings.port, self.settings.baud)

    @classmethod
    def hardware(cls, settings: Settings) -> Sequence[Hardware]:
        return (Hardware(settings.port, "dialout"),)

    def line_name(self) -> str:
        return f"the serial port {self.settings.port}"


class UdpNodes(LineNodes):
    """Tiny nodes that send datagrams (`sensor_field.udp`).

    Their identity is not checked: any program that can reach the port can speak as any of them.
    """

    @dataclass
    class Settings(LineNodes.Settings):
        """The UDP port.

        Attributes:
            listen: the address that they send to, such as `udp://127.0.0.1:7421`; port 0 takes a free one.
        """

        listen: str

        def __post_init__(self) -> None:
            LineNodes.Settings.__post_init__(self)
            if parse_address(self.listen).scheme != "udp":
                raise ValueError(f"listen = {self.listen!r} is not an address such as 'udp://127.0.0.1:7421'")

    def make_line(self) -> Line:
        address = parse_address(self.settings.listen)
        return UdpLine(address.host, address.port)

    def line_name(self) -> str:
        return f"the UDP port {self.settings.listen.removeprefix('udp://')}"


class TcpNodes(LineNodes):
    """Tiny nodes on a serial port at the far end of a TCP connection, as `ser2net` offers it (`sensor_field.tcp`).

    It runs in virtual time too.
    """

    @dataclass
    class Settings(LineNodes.Settings):
        """The address of the line.

        Attributes:
            address: where to connect to, such as `tcp://192.168.1.20:4001`.
        """

        address: str

        def __post_init__(self) -> None:
            LineNodes.Settings.__post_init__(self)
            if parse_address(self.address).scheme != "tcp":
                raise ValueError(f"address = {self.address!r} is not an address such as 'tcp://192.168.1.20:4001'")

    def make_line(self) -> Line:
        return TcpLine(self.context.transport, self.settings.address)

    def line_name(self) -> str:
        return f"the line at {self.settings.address}"


class TinySensor(NetworkSensor):
    """A virtual device for what a tiny node measures; a subclass for each kind of reading."""

    networked = False  # the line is this agent's own, so it may sleep on the mesh
    silent_s = 30.0


class TinyTemperature(TinySensor):
    """The temperature that a tiny node measures (`sensor_field.tiny_temperature`)."""

    type = "temperature"


class TinyMotion(TinySensor):
    """The motion that a tiny node senses (`sensor_field.tiny_motion`)."""

    type = "motion"


class TinySiren(Actuator):
    """The siren of a tiny node (`sensor_field.tiny_siren`).

    Each command has a time to live, after which the node falls silent by itself.
    """

    type = "sensor_field.siren"

    @dataclass
    class Settings:
        """The tiny node with the siren.

        Attributes:
            node: the name of the tiny node in the settings of its line.
            number: its number.
        """

        node: str
        number: NodeNumber

    settings: Settings

    def __init__(self, context: DeviceContext, settings: Any) -> None:
        super().__init__(context, settings)
        self._wires = _wires(context)
        self._unheard = False

    def write(self, command: Siren, ttl_s: float, source: str) -> None:
        # Rather too short than too long: when the right to command it ends, another agent may have it.
        self._sound(min(int(10 * ttl_s + 1e-6), 32767) if command.sounds else 0)

    def watchdog_s(self, hold_after_s: float) -> float:
        """Return the hold time: the node counts each command's time to live."""
        return hold_after_s

    def safe_stop(self) -> None:
        """Silence it."""
        self._sound(0)

    def _sound(self, tenths: int) -> None:
        node = self.settings.node
        unheard = not self._wires.send(node, encode(Frame(self.settings.number, SIREN, 0, tenths)))
        if unheard and tenths and not self._unheard:
            self.context.log("warning", f"the siren of {node} is not commanded: the node has not sent on its line yet")
        self._unheard = unheard and (self._unheard or tenths > 0)


def _wires(context: DeviceContext) -> Wires:
    return context.shared("sensor_field.wires", Wires)


class SimulatedTemperature(SimulatedSensor):
    """A thermometer in a simulated field (`sensor_field.temperature`)."""

    type = "temperature"
