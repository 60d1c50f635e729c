"""Benches for drivers of tiny nodes: a gateway, a line of one kind, and hardware at its other end in a test's hands.

Each kind of line has one, so that one contract can be asked of all.
"""

from __future__ import annotations

import os
import select
import socket
import threading
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from pancakes_sensor_field.drivers import SerialNodes, TcpNodes, TinyMotion, TinyTemperature, UdpNodes

from pancakes.mesh.transport import Connection, ConnectionHandler
from pancakes.testing import AgentHandle, Fleet, threaded_agent

NODES = {"shed": 7, "gate": 9}
PATIENCE_S = 10.0


class Bench(ABC):
    """A gateway with the nodes `shed` (7) and `gate` (9) on one line.

    Attributes:
        gateway: the agent.
    """

    gateway: AgentHandle

    @abstractmethod
    def send(self, data: bytes) -> None:
        """The hardware sends bytes."""

    @abstractmethod
    def received(self, count: int) -> bytes:
        """Waits until the hardware has got so many bytes, and returns them."""

    @abstractmethod
    def unplug(self) -> None:
        """Takes the hardware away."""

    @abstractmethod
    def plug(self) -> None:
        """Brings it back."""


def devices(driver: type, settings: dict[str, Any]) -> dict[str, Any]:
    """Returns the gateway's devices."""
    line = {"type": driver, "rate_hz": 20, "settings": {"nodes": NODES, **settings}}
    shown: dict[str, Any] = {}
    for name in NODES:
        shown |= {f"{name}_temperature": TinyTemperature, f"{name}_motion": TinyMotion}
    return {"line": line, **shown}


class PtyBench(Bench):
    """A serial port, for which a pseudo-terminal stands."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._link = folder / "tty"
        self.plug()
        stack.callback(self.unplug)
        parts = devices(SerialNodes, {"port": str(self._link)})
        self.gateway = stack.enter_context(threaded_agent("gateway", devices=parts))

    def send(self, data: bytes) -> None:
        os.write(self._near, data)

    def received(self, count: int) -> bytes:
        got = b""
        while len(got) < count:
            ready, _, _ = select.select([self._near], [], [], PATIENCE_S)
            assert ready, f"only {got!r} came"
            got += os.read(self._near, count - len(got))
        return got

    def unplug(self) -> None:
        if self._link.is_symlink():
            self._link.unlink()
            os.close(self._near)
            os.close(self._far)

    def plug(self) -> None:
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        self._link.symlink_to(os.ttyname(self._far))


class UdpBench(Bench):
    """A UDP port. Nobody notices when the hardware has gone; it just falls silent."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        with socket.socket(type=socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self._port = probe.getsockname()[1]
        self._socket = stack.enter_context(socket.socket(type=socket.SOCK_DGRAM))
        self._socket.settimeout(PATIENCE_S)
        parts = devices(UdpNodes, {"listen": f"udp://127.0.0.1:{self._port}"})
        self.gateway = stack.enter_context(threaded_agent("gateway", devices=parts))

    def send(self, data: bytes) -> None:
        self._socket.sendto(data, ("127.0.0.1", self._port))

    def received(self, count: int) -> bytes:
        return self._socket.recv(count)

    def unplug(self) -> None:
        raise AssertionError("a UDP port cannot be unplugged: nobody would notice")

    def plug(self) -> None:
        raise AssertionError("a UDP port cannot be unplugged: nobody would notice")


class VirtualBench(Bench, ConnectionHandler):
    """A simulated line in virtual time."""

    ADDRESS = "tcp://127.0.0.1:4001"

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.fleet = stack.enter_context(Fleet())
        self._connection: Connection | None = None
        self._got = b""
        self.plug()
        self.gateway = self.fleet.start("gateway", devices=devices(TcpNodes, {"address": self.ADDRESS}))

    def opened(self, connection: Connection) -> None:
        self._connection = connection

    def received(self, data: Any) -> Any:
        """Both the transport's `received(data)` and the bench's `received(count)`."""
        if isinstance(data, bytes):
            self._got += data
            return None
        self.gateway.wait_until(lambda: len(self._got) >= data)
        got, self._got = self._got[:data], self._got[data:]
        return got

    def closed(self, reason: str) -> None:
        self._connection = None

    def send(self, data: bytes) -> None:
        assert self._connection is not None
        self._connection.send(data)

    def unplug(self) -> None:
        self._transport.close()

    def plug(self) -> None:
        self._transport = self.fleet.network.transport("hardware")
        self._transport.listen(self.ADDRESS, lambda: self)


BENCHES: dict[str, Callable[[Path, ExitStack], Bench]] = {"pty": PtyBench, "udp": UdpBench, "virtual": VirtualBench}


@contextmanager
def bench_of(kind: str, folder: Path) -> Iterator[Any]:
    """Makes a bench whose gateway hears the line, and clears it away."""
    before = threading.enumerate()
    with ExitStack() as stack:
        bench = BENCHES[kind](folder, stack)
        bench.gateway.wait_until(lambda: any("listens to" in line for line in bench.gateway.lines("info")))
        yield bench
    for thread in threading.enumerate():
        if thread not in before:
            thread.join(PATIENCE_S)
            assert not thread.is_alive(), f"{thread.name} is left"
