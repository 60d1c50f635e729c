"""Tasks of a simulated field's agent that play its tiny nodes, so that a gateway has something to hear.

`sensor_field.TinyNodes` runs each as a process that plays the hardware, for live runs; `SimulatedTinyNodes` runs
the same nodes itself, on simulated lines, for virtual time.
"""

from __future__ import annotations

import random
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

from msgspec import Meta

from pancakes import SYSTEM, Packet, PancakesError, Task, Tick, every, on
from pancakes.mesh.transport import Connection, ConnectionHandler
from pancakes.settings import Share
from pancakes_sensor_field.drivers import NodeNumber, PeriodS
from pancakes_sensor_field.mote import Mote, spoilt
from pancakes_sensor_field.packets import FieldTruth, NodeTruth

END_S: Final = 0.5
"""How long a tiny node may take to end, of the 2 s that a task has to stop."""


@dataclass
class TinyNodeSettings:
    """A tiny node.

    Attributes:
        number: its number, 1 to 254.
        line: where it speaks: `pty:PATH` (a link to a pseudo-terminal is made there), `udp://HOST:PORT` (it sends
            there), or `tcp://HOST:PORT` (a simulated line: the gateway dials there).
        period_s: its report period at first.
        garble: share of what it sends that is spoilt on the line.
    """

    number: NodeNumber
    line: Annotated[str, Meta(pattern=r"^(pty:.|udp://.|tcp://.)")]
    period_s: PeriodS = 10.0
    garble: Share = 0.0


@dataclass
class TinyNodesSettings:
    """The tiny nodes of a field.

    Attributes:
        nodes: each by its name in the field.
    """

    nodes: dict[str, TinyNodeSettings] = field(default_factory=dict)


class TinyNodes(Task):
    """Run the tiny nodes of a field as processes, and pass them the readings of the field.

    Each ends with its standard input, so none outlives this agent, however the agent ends.
    """

    blocking = True
    Settings = TinyNodesSettings

    settings: TinyNodesSettings

    def on_start(self) -> None:
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._felt: dict[str, tuple[float, bool]] = {}
        for name, node in self.settings.nodes.items():
            self._processes[name] = subprocess.Popen(
                [sys.executable, "-m", "pancakes_sensor_field.tiny_node", *self._arguments(node)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                start_new_session=True,
            )

    def _arguments(self, node: TinyNodeSettings) -> list[str]:
        kind, _, where = node.line.partition(":")
        if kind == "tcp":
            raise PancakesError(
                f"a process cannot play a tiny node at {node.line}: sensor_field.SimulatedTinyNodes can"
            )
        if kind == "pty":
            Path(where).parent.mkdir(parents=True, exist_ok=True)
        return [
            f"--node={node.number}",
            f"--{kind}={where.removeprefix('//') if kind == 'udp' else where}",
            f"--period={node.period_s}",
            f"--speed={self._actor.kernel.mission.speed}",
            f"--garble={node.garble}",
        ]

    def on_stop(self) -> None:
        for process in self._processes.values():
            process.terminate()
        for process in self._processes.values():
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdin is not None:
                process.stdin.close()

    def on_failure(self, *error: Any) -> None:
        self.on_stop()

    @on(SYSTEM, FieldTruth, queue="latest")
    def feel(self, packet: Packet) -> None:
        """Pass changed readings to the nodes."""
        for name, celsius, moving in _changes(packet.body, self.settings.nodes, self._felt):
            process = self._processes[name]
            assert process.stdin is not None
            try:
                process.stdin.write(f"t {celsius:.2f}\nm {int(moving)}\n".encode())
                process.stdin.flush()
            except OSError:
                raise PancakesError(f"the tiny node {name} has ended with code {process.poll()}") from None


class SimulatedTinyNodes(Task):
    """Play the tiny nodes of a field on simulated lines; also in virtual time, where runs repeat exactly."""

    Settings = TinyNodesSettings

    settings: TinyNodesSettings

    def on_start(self) -> None:
        self._felt: dict[str, tuple[float, bool]] = {}
        self._nodes = {}
        for name, node in self.settings.nodes.items():
            if not node.line.startswith("tcp://"):
                raise PancakesError(f"a simulated tiny node cannot be at {node.line}: sensor_field.TinyNodes can")
            self._nodes[name] = _SimulatedNode(self, node)

    def on_stop(self) -> None:
        for node in self._nodes.values():
            node.close()

    def on_failure(self, *error: Any) -> None:
        self.on_stop()

    @on(SYSTEM, FieldTruth, queue="latest")
    def feel(self, packet: Packet) -> None:
        """Pass changed readings to the nodes."""
        for name, celsius, moving in _changes(packet.body, self.settings.nodes, self._felt):
            self._nodes[name].feel(celsius, moving)

    @every(hz=10)
    def pass_time(self, tick: Tick) -> None:
        """Let the nodes send what is due."""
        for node in self._nodes.values():
            node.tick(tick.time_s)


class _SimulatedNode:
    """A tiny node at the end of a simulated line. It runs in its task's actor."""

    def __init__(self, task: SimulatedTinyNodes, settings: TinyNodeSettings) -> None:
        self._task = task
        self._transport = task._actor.kernel.transport  # noqa: SLF001
        self._mote = Mote(settings.number, settings.period_s)
        self._garble = settings.garble
        self._noise: random.Random = task.random
        self._connection: Connection | None = None
        self._closed = False
        self._address = self._transport.listen(settings.line, lambda: _End(self))

    def feel(self, celsius: float, moving: bool) -> None:
        self._send(self._mote.sense(celsius, moving))

    def tick(self, now_s: float) -> None:
        self._send(self._mote.tick(now_s))

    def close(self) -> None:
        self._closed = True
        self._transport.stop_listening(self._address)
        if self._connection is not None:
            self._connection.close("the tiny node has ended")

    def connected(self, connection: Connection) -> None:
        """Called in the transport's thread, like the two below."""
        if self._closed:
            connection.close("the tiny node has ended")
            return
        self._connection = connection
        self._task.call(lambda: self._send(self._mote.start(self._task.now())))

    def received(self, data: bytes) -> None:
        self._task.call(lambda: self._send(self._mote.received(data, self._task.now())))

    def disconnected(self) -> None:
        self._connection = None

    def _send(self, data: bytes) -> None:
        if data and self._noise.random() < self._garble:
            data = spoilt(data)
        if data and self._connection is not None:
            self._connection.send(data)


class _End(ConnectionHandler):
    """The tiny node's end of one connection."""

    def __init__(self, node: _SimulatedNode) -> None:
        self._node = node

    def opened(self, connection: Connection) -> None:
        self._node.connected(connection)

    def received(self, data: bytes) -> None:
        self._node.received(data)

    def closed(self, reason: str) -> None:
        self._node.disconnected()


def _changes(
    truth: FieldTruth, nodes: Mapping[str, Any], felt: dict[str, tuple[float, bool]]
) -> list[tuple[str, float, bool]]:
    """Return the changed readings of each tiny node, as (name, degrees, whether something moves)."""
    new: list[NodeTruth] = []
    for node in truth.nodes:
        if node.name in nodes and felt.get(node.name) != (round(node.celsius, 2), node.moving):
            felt[node.name] = (round(node.celsius, 2), node.moving)
            new.append(node)
    return [(node.name, node.celsius, node.moving) for node in new]
