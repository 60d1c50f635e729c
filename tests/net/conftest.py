"""Two networks to run the same tests on: real sockets on loopback, and virtual time."""

from __future__ import annotations

import contextlib
import heapq
import random
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from pancakes.mesh.codec import frame
from pancakes.mesh.event_loop import TimerHandle
from pancakes.mesh.link import Action, Greeted, Heard, Link, LinkTimes, Over, PacketsReceived, SendMessage, Up
from pancakes.mesh.memory_network import MemoryNetwork
from pancakes.mesh.mesh import Mesh
from pancakes.mesh.messages import Gossip, Identity, Role
from pancakes.mesh.transport import Connection, ConnectionHandler, SocketTransport, Transport
from pancakes.packet import Packet
from pancakes.security.access import Access
from pancakes.security.authority import Authority
from pancakes.security.keys import Keys
from pancakes.security.roster import AccessRule, CertifiedRole
from pancakes.util.clock import Clock, MonotonicClock, VirtualClock
from pancakes.util.plugins import Plugins
from pancakes.util.timebase import Timebase

PATIENCE_S = 20.0


class Timeline:
    """A virtual scheduler: what is due at the same time runs in the order in which it was put off."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self._heap: list[tuple[float, int, TimerHandle]] = []
        self.count = 0

    def call_at(self, time_s: float, function: Callable[[], None]) -> TimerHandle:
        timer = TimerHandle(function)
        self.count += 1
        heapq.heappush(self._heap, (max(time_s, self.clock.now()), self.count, timer))
        return timer

    def step(self) -> bool:
        if not self._heap:
            return False
        time_s, _, timer = heapq.heappop(self._heap)
        self.clock.advance_to(time_s)
        if timer.function is not None:
            timer.function()
        return True

    def run_until(self, time_s: float) -> None:
        while self._heap and self._heap[0][0] <= time_s:
            self.step()
        self.clock.advance_to(time_s)


class TransportRig(ABC):
    """Transports and what stands on them: ears, agents, bare peers."""

    virtual: bool
    listen_at: str
    clock: Clock

    @abstractmethod
    def transport(self, name: str, role: Role = "agent") -> Transport:
        """Returns a transport for an agent, or for what has another role."""

    def keys_of(self, transport: Transport) -> Keys | None:
        """Returns what a transport shows; None: it has no keys."""
        return None

    def ear(self) -> Ear:
        return Ear(self)

    def agent(self, name: str, *arguments: Any, **more: Any) -> Agent:
        return Agent(self, name, *arguments, **more)

    def bare_peer(self, name: str, to: Agent, at: str = "", **more: Any) -> BarePeer:
        """Returns a peer of an agent that is nothing but a link; `at` is where it dials, where not at the first one."""
        peer = BarePeer(self.clock.now, name, **more)
        self.transport(name).dial(at or to.address, peer)
        return peer

    @abstractmethod
    def note(self) -> None:
        """To be called when something has happened that a test may wait for."""

    @abstractmethod
    def until(self, condition: Callable[[], Any]) -> None:
        """Waits until something is so."""

    @abstractmethod
    def close(self) -> None:
        """Closes the transports."""


class SocketRig(TransportRig):
    """Transports on real sockets; waits in real time."""

    virtual = False

    def __init__(self) -> None:
        self.clock: Clock = MonotonicClock()
        self.changed = threading.Condition()
        self.transports: list[Transport] = []

    def transport(self, name: str, role: Role = "agent") -> Transport:
        made = SocketTransport(self.clock, name, Plugins(), {"tcp": {"insecure": True}})
        self.transports.append(made)
        return made

    def note(self) -> None:
        with self.changed:
            self.changed.notify_all()

    def until(self, condition: Callable[[], Any]) -> None:
        # `wait_for` looks again at each note; the short slices are for conditions that no note tells of.
        deadline_s = time.monotonic() + PATIENCE_S
        with self.changed:
            while not condition():
                assert time.monotonic() < deadline_s, "what the test waits for did not happen"
                self.changed.wait(0.01)

    def close(self) -> None:
        for transport in self.transports:
            transport.close()


class TcpRig(SocketRig):
    """TCP on loopback."""

    listen_at = "tcp://127.0.0.1:0"


class TlsRig(TcpRig):
    """TCP on loopback, with keys of one fleet."""

    def __init__(self, directory: Path) -> None:
        super().__init__()
        self.directory = directory
        self._keys: dict[Transport, Keys | None] = {}
        self.authority = Authority.founded("default", directory / "authority")
        self.authority.allow(AccessRule(("role:agent",), ("command",)))

    def transport(self, name: str, role: Role = "agent") -> Transport:
        if role == "client":
            return self.with_keys(self.enrol(name.partition(".")[0], "operator"))
        return self.with_keys(self.enrol(name, role))

    def enrol(self, name: str, role: CertifiedRole = "agent", **more: Any) -> Path:
        """Makes keys; returns the folder that they are in."""
        folder = self.directory / f"{role}-{name}-{len(self.transports)}"
        self.authority.enrol_with_key(role, name, **more).write(folder)
        return folder

    def with_keys(self, folder: Path | None) -> Transport:
        """Returns a transport that shows these keys; None: none."""
        keys = Keys(folder) if folder is not None else None
        settings = {"tcp": {"insecure": keys is None}}
        made = SocketTransport(self.clock, keys.own.name if keys is not None else "none", Plugins(), settings, keys)
        self.transports.append(made)
        self._keys[made] = keys
        return made

    def keys_of(self, transport: Transport) -> Keys | None:
        return self._keys[transport]


class LocalRig(SocketRig):
    """Unix sockets; each agent listens at a name of its own."""

    def __init__(self) -> None:
        super().__init__()
        self._names = 0

    @property
    def listen_at(self) -> str:  # type: ignore[override]
        self._names += 1
        return f"local://agent{self._names}"


class MemoryRig(TransportRig):
    """Transports in memory; virtual time runs until what a test waits for has happened."""

    virtual = True
    listen_at = "tcp://127.0.0.1:0"

    def __init__(self) -> None:
        self.timeline = Timeline()
        self.clock: Clock = self.timeline.clock
        self.network = MemoryNetwork(self.timeline.call_at, self.clock.now, random.Random(1))

    def transport(self, name: str, role: Role = "agent") -> Transport:
        return self.network.transport(name)

    def note(self) -> None:
        pass

    def until(self, condition: Callable[[], Any]) -> None:
        deadline_s = self.clock.now() + 60.0
        while not condition():
            assert self.clock.now() < deadline_s and self.timeline.step(), "what the test waits for did not happen"

    def close(self) -> None:
        pass


class BarePeer(ConnectionHandler):
    """A peer that is nothing but a link: it keeps a link up, and writes down what the other side does.

    Args:
        now: the host clock.
        name: its name.
        listen: the address that it names in its hello, or several; nothing listens there.
        role: its role.
        journal: its journal; empty: one of its own.
        boot: the boot of that journal.
    """

    def __init__(
        self,
        now: Callable[[], float],
        name: str,
        listen: str | Sequence[str] = "",
        role: Role = "agent",
        journal: str = "",
        boot: int = 1,
    ) -> None:
        listens = list(filter(None, [listen] if isinstance(listen, str) else listen))
        self.own = Identity(name, journal or f"journal of {name}", boot, role=role).hello(listens)
        self.told: list[tuple[str, ...]] = []
        self.packets: list[Packet] = []
        self.is_up = False
        self.over: Over | None = None
        self.closed_for: list[str] = []
        self._now = now

    def opened(self, connection: Connection) -> None:
        self.connection = connection
        self.link = Link(self.own, LinkTimes(), self._now())
        self.act(self.link.open(self._now()))

    def received(self, data: bytes) -> None:
        self.act(self.link.receive(data, self._now()))

    def closed(self, reason: str) -> None:
        self.closed_for.append(reason)

    def send(self, *messages: bytes) -> None:
        self.connection.send(frame(messages))

    def act(self, actions: Sequence[Action]) -> None:
        for action in actions:
            match action:
                case SendMessage(message):
                    self.send(message)
                case Greeted(hello) if self.own.name < hello.name:
                    self.act(self.link.admit(self._now()))
                case Up():
                    self.is_up = True
                case Heard(Gossip(agents)):
                    self.told.append(tuple(it.address for it in agents))
                case PacketsReceived(packets):
                    self.packets.extend(packets)
                case Over():
                    self.over = action
                    self.connection.close(action.reason)


class Ear(ConnectionHandler):
    """A handler that writes down what it is told."""

    def __init__(self, rig: TransportRig) -> None:
        self._rig = rig
        self.connection: Connection | None = None
        self.data = bytearray()
        self.closed_for: list[str] = []
        self.drains = 0
        self.threads: list[int] = []

    def opened(self, connection: Connection) -> None:
        self.connection = connection
        self._heard()

    def received(self, data: bytes) -> None:
        self.data += data
        self._heard()

    def drained(self) -> None:
        self.drains += 1
        self._heard()

    def closed(self, reason: str) -> None:
        self.closed_for.append(reason)
        self._heard()

    def _heard(self) -> None:
        self.threads.append(threading.get_ident())
        self._rig.note()


RIGS: dict[str, Callable[[Path], TransportRig]] = {
    "tcp": lambda directory: TcpRig(),
    "tls": TlsRig,
    "local": lambda directory: LocalRig(),
    "memory": lambda directory: MemoryRig(),
}


@pytest.fixture(params=["tcp", "memory"])
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[TransportRig]:
    """Real sockets and virtual time.

    A mesh does the same over every transport that keeps the contract. `test_transport_contract.py` checks the contract
    on all of RIGS.
    """
    with contextlib.closing(RIGS[request.param](tmp_path)) as made:
        yield made


@pytest.fixture
def memory_rig() -> MemoryRig:
    return MemoryRig()


@pytest.fixture
def new_memory_rig() -> type[MemoryRig]:
    return MemoryRig


@pytest.fixture
def tcp_rig() -> Iterator[TcpRig]:
    made = TcpRig()
    yield made
    made.close()


@pytest.fixture
def ear(rig: Any) -> Callable[[], Ear]:
    return rig.ear


class Agent:
    """A mesh and what it told."""

    def __init__(
        self,
        rig: TransportRig,
        name: str,
        peers: Sequence[str] = (),
        *,
        journal: str = "",
        boot: int = 1,
        fleet: str = "default",
        role: Role = "agent",
        listen: str | None = None,
        listens: Sequence[str] | None = None,
        times: LinkTimes | None = None,
        defer: Callable[[Callable[[], None]], None] = lambda function: function(),
        follows: bool = False,
        links: int | None = None,
        timebase: Callable[[], Timebase] | None = None,
    ) -> None:
        self._rig = rig
        self.name = name
        self.packets: list[Packet] = []
        self.unfit: list[tuple[str, Packet, str]] = []
        self.ups: list[str] = []
        self.downs: list[tuple[str, str, float | None]] = []
        self.lines: list[tuple[str, str]] = []
        self._seq = 0
        self.transport = rig.transport(name, role)
        keys = rig.keys_of(self.transport)
        self.access = access = Access(name, (lambda: keys.roster) if keys is not None else None)
        self.mesh = Mesh(
            Identity(name, journal or f"journal of {name}", boot, fleet, role),
            self.transport,
            listens if listens is not None else list(filter(None, [rig.listen_at if listen is None else listen])),
            peers,
            random.Random(name),
            rig.clock,
            on_packets=lambda peer, packets, size: self.take(packets),
            on_unfit=lambda *news: self._note(self.unfit, news),
            on_peer_up=lambda hello: self._note(self.ups, hello.name),
            on_peer_down=lambda *news: self._note(self.downs, news),
            on_log=lambda *line: self._note(self.lines, line),
            defer=defer,
            times=times,
            access=None if follows else access,
            keys=keys,
            links=links,
            timebase=timebase,
        )
        self.mesh.start()

    @property
    def address(self) -> str:
        """Where it can be dialled; empty where it listens at no address."""
        return next(iter(self.mesh.listen), "")

    def _note(self, kept: list[Any], news: Any) -> None:
        kept.append(news)
        self._rig.note()

    def take(self, packets: Sequence[Packet]) -> None:
        for packet in packets:
            self._note(self.packets, packet)

    def say(self, to: str, body: Any = None, channel: str = "chat", kind: str = "words", retry: bool = False) -> int:
        self._seq += 1
        packet = Packet(channel, kind, f"{self.name}/client/test", to, 0.0, self._seq, body)
        return self.mesh.send(packet, retry=retry)

    def knows(self, *names: str) -> bool:
        return list(self.mesh.connected()) == sorted(names)

    def log(self, level: str) -> str:
        return "\n".join(text for at, text in self.lines if at == level)


@pytest.fixture
def agent(rig: Any) -> Callable[..., Agent]:
    return rig.agent


@pytest.fixture
def timeline() -> Timeline:
    return Timeline()
