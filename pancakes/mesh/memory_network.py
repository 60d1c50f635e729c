"""A network in memory and in virtual time with faults on demand, for simulations and tests.

It takes the same addresses as the real network, so the same configurations run. Faults are latency, jitter, limited
bandwidth, partitions and broken links. It reads no clock and no random number of its own, so a run repeats itself.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, Protocol

from pancakes.errors import PancakesError
from pancakes.mesh.address import LOCAL, is_local, is_loopback, parse_address
from pancakes.mesh.transport import Connection, ConnectionHandler, Scheduled, Transport

_FIRST_FREE_PORT: Final = 49_152
_TRICKLE_S: Final = 0.05  # the length of one portion of sending, if the rate is limited
_DIAL_TIMEOUT_S: Final = 5.0  # after which a dial into a partition fails


class CallAt(Protocol):
    """Run a function at a point in virtual time; what is due at the same time runs in the order of the calls."""

    def __call__(self, time_s: float, function: Callable[[], None]) -> Scheduled: ...


@dataclass(frozen=True, slots=True)
class Quality:
    """The quality of the network between two agents.

    Attributes:
        latency_s: how long a byte travels.
        jitter_s: how much longer it may travel, at most; drawn for each send. The order is kept.
        bytes_per_s: how fast bytes leave a connection.
    """

    latency_s: float = 0.0005
    jitter_s: float = 0.0
    bytes_per_s: float = math.inf


@dataclass(slots=True)
class _Partition:
    """Agents of `one` side and of the `other` cannot reach each other, from one point in time to another."""

    one: frozenset[str]
    other: frozenset[str] | None
    from_s: float
    until_s: float

    def parts(self, a: str, b: str, now_s: float) -> bool:
        return self.from_s <= now_s < self.until_s and (self._splits(a, b) or self._splits(b, a))

    def _splits(self, a: str, b: str) -> bool:
        return a in self.one and (b not in self.one if self.other is None else b in self.other)


class MemoryNetwork:
    """The network between the agents of a simulation.

    Args:
        call_at: the virtual scheduler.
        now: the virtual clock.
        source: random numbers for the jitter.
        quality: the quality between agents that have no other one.

    Attributes:
        pipes: the connections that exist, in the order in which they were made.
    """

    def __init__(
        self, call_at: CallAt, now: Callable[[], float], source: random.Random, quality: Quality | None = None
    ) -> None:
        self.call_at = call_at
        self.now = now
        self._random = source
        self.default = quality or Quality()
        self.qualities: dict[tuple[str, str], Quality] = {}
        self.partitions: list[_Partition] = []
        self._listeners: dict[str, tuple[MemoryTransport, Callable[[], ConnectionHandler]]] = {}
        self._exempt: dict[str, None] = {}
        self.pipes: dict[_Pipe, None] = {}
        self._next_port = _FIRST_FREE_PORT

    def transport(self, agent: str, due_s: Callable[[float], float] | None = None) -> MemoryTransport:
        """Return a transport for an agent; faults refer to it by name.

        Args:
            agent: its name.
            due_s: returns the virtual time at which a number of seconds of the agent's clock will have passed; None: it
                uses the virtual clock.
        """
        return MemoryTransport(self, agent, due_s or (lambda delay_s: self.now() + delay_s))

    def set_quality(self, a: str, b: str, quality: Quality) -> None:
        """Set the quality between two agents, both ways, for all that is sent from now on."""
        self.qualities[(a, b)] = self.qualities[(b, a)] = quality

    def exempt(self, address: str) -> None:
        """Exempt connections to `address` from faults and from all delays but the default (a hardware bus)."""
        self._exempt[address] = None

    def partition(
        self,
        one: Sequence[str],
        other: Sequence[str] | None = None,
        from_s: float | None = None,
        until_s: float = math.inf,
        at_once: bool = False,
    ) -> None:
        """Cut the network between two groups of agents for a while.

        Bytes that are sent in that time are lost, and so is their connection; dials fail.

        Args:
            one: names of agents.
            other: names of the agents in the other group; None: all that are not in `one`.
            from_s: virtual time at which it begins; None: at once.
            until_s: virtual time at which it heals.
            at_once: whether both ends of each connection see it break when it begins. Otherwise they notice only the
                silence.
        """
        begin_s = self.now() if from_s is None else from_s
        cut = _Partition(frozenset(one), None if other is None else frozenset(other), begin_s, until_s)
        self.partitions.append(cut)

        def begin() -> None:
            for pipe in list(self.pipes):
                if not pipe.exempt and cut.parts(pipe.agents[0], pipe.agents[1], self.now()):
                    pipe.break_off("the network was cut", at_once)

        if begin_s <= self.now():
            begin()
        else:
            self.call_at(begin_s, begin)

    def heal(self) -> None:
        """End all partitions, also future ones."""
        self.partitions.clear()

    def break_links(self, a: str, b: str, at_once: bool = True) -> None:
        """Break all connections between two agents; bytes on their way are lost. They may dial again.

        Args:
            a: name of an agent.
            b: name of the other.
            at_once: whether both ends see it break; otherwise they notice only the silence.
        """
        for pipe in list(self.pipes):
            if not pipe.exempt and pipe.agents in ((a, b), (b, a)):
                pipe.break_off(f"the link between {a} and {b} was broken", at_once)

    def parted(self, a: str, b: str) -> bool:
        """Return whether two agents are separated by a partition now."""
        now_s = self.now()
        return any(cut.parts(a, b, now_s) for cut in self.partitions)

    # For the transports

    def quality(self, a: str, b: str) -> Quality:
        """Return the quality between two agents."""
        return self.qualities.get((a, b), self.default)

    def travel_s(self, quality: Quality) -> float:
        """Draw how long bytes travel."""
        if quality.jitter_s > 0:
            return quality.latency_s + self._random.uniform(0.0, quality.jitter_s)
        return quality.latency_s

    def listen(self, address: str, owner: MemoryTransport, accept: Callable[[], ConnectionHandler]) -> str:
        """See `Transport.listen`."""
        try:
            parts = parse_address(address)
        except ValueError as error:
            raise PancakesError(f"cannot listen at {address}: {error}") from None
        if parts.any_port:
            address = f"{parts.scheme}://{parts.host}:{self._next_port}"
            self._next_port += 1
        if address in self._listeners:
            raise PancakesError(f"cannot listen at {address}: address already in use")
        self._listeners[address] = (owner, accept)
        return address

    def dial(self, address: str, owner: MemoryTransport, handler: ConnectionHandler) -> None:
        """See `Transport.dial`."""
        found = self._listeners.get(address)
        exempt = address in self._exempt
        travel_s = self.travel_s(self.default if exempt or found is None else self.quality(owner.agent, found[0].agent))

        def fail(reason: str) -> None:
            owner.dials.pop(handler, None)
            handler.closed(reason)

        def arrive() -> None:
            if handler not in owner.dials:
                return  # its transport was closed
            there = self._listeners.get(address)
            if there is None:
                fail(f"{address} cannot be reached: connection refused")
            elif not exempt and self.parted(owner.agent, there[0].agent):
                late = f"{address} did not answer within {_DIAL_TIMEOUT_S:g} s"
                wait_s = max(0.0, _DIAL_TIMEOUT_S - travel_s)
                self.call_at(self.now() + wait_s, lambda: fail(late) if handler in owner.dials else None)
            else:
                del owner.dials[handler]
                pipe = _Pipe(self, (owner, there[0]), exempt, address)
                self.pipes[pipe] = None
                pipe.ends[1].begin(there[1]())
                pipe.ends[0].begin(handler)

        owner.dials[handler] = None
        self.call_at(self.now() + travel_s, arrive)

    def stop_listening(self, owner: MemoryTransport, address: str = "") -> None:
        """Free one address of a transport, or all of them."""
        for found in [it for it, (other, _) in self._listeners.items() if other is owner and address in ("", it)]:
            del self._listeners[found]

    def forget(self, owner: MemoryTransport) -> None:
        """End all connections of a transport."""
        for pipe in list(self.pipes):
            for end in pipe.ends:
                if end.owner is owner:
                    end.close("the transport was closed")

    def ended(self, pipe: _Pipe) -> None:
        """Remove a pipe whose ends are both closed."""
        self.pipes.pop(pipe, None)


class MemoryTransport(Transport):
    """The transport of one agent on a `MemoryNetwork`. Made by `MemoryNetwork.transport`."""

    def __init__(self, network: MemoryNetwork, agent: str, due_s: Callable[[float], float]) -> None:
        self.agent = agent
        self.dials: dict[ConnectionHandler, None] = {}
        self._network = network
        self._due_s = due_s
        self._closed = False

    def listen(self, address: str, accept: Callable[[], ConnectionHandler]) -> str:
        return self._network.listen(address, self, accept)

    def stop_listening(self, address: str) -> None:
        self._network.stop_listening(self, address)

    def dial(self, address: str, handler: ConnectionHandler) -> None:
        if not self._closed:
            self._network.dial(address, self, handler)

    def call_later(self, delay_s: float, function: Callable[[], None]) -> Scheduled:
        return self._network.call_at(self._due_s(delay_s), lambda: None if self._closed else function())

    def close(self) -> None:
        """Free the addresses, and close all connections after what is due now, as with real sockets."""
        self._network.stop_listening(self)
        self._network.call_at(self._network.now(), self._close)

    def _close(self) -> None:
        if self._closed:
            return
        self._closed = True
        dials, self.dials = list(self.dials), {}
        for handler in dials:
            handler.closed("the transport was closed")
        self._network.forget(self)


class _Pipe:
    """A connection with both of its ends."""

    def __init__(
        self, network: MemoryNetwork, owners: tuple[MemoryTransport, MemoryTransport], exempt: bool, address: str
    ) -> None:
        self.network = network
        self.agents = (owners[0].agent, owners[1].agent)
        self.exempt = exempt
        self.cut = False  # nothing gets through from now on
        self.ends = (_End(self, owners[0], address), _End(self, owners[1], _dialler(owners[0].agent, address)))
        self.ends[0].other, self.ends[1].other = self.ends[1], self.ends[0]

    def quality(self) -> Quality:
        network = self.network
        return network.default if self.exempt else network.qualities.get(self.agents, network.default)

    def is_cut(self) -> bool:
        """Whether bytes that are sent now are lost: then all that follow are lost too, as in a stream."""
        if self.network.partitions and not self.cut and not self.exempt:
            self.cut = self.network.parted(*self.agents)
        return self.cut

    def break_off(self, reason: str, at_once: bool) -> None:
        self.cut = True
        if at_once:
            for end in self.ends:
                end.finish_later(reason)


def _dialler(agent: str, address: str) -> str:
    """Return the address of the agent that dialled `address`, as seen at the other end."""
    if is_local(address):
        return f"{LOCAL}://{agent}"
    return "tcp://127.0.0.1:0" if is_loopback(address) else f"tcp://{agent}:0"


class _End(Connection):
    """One end of a pipe."""

    other: _End

    def __init__(self, pipe: _Pipe, owner: MemoryTransport, remote: str) -> None:
        self.remote = remote
        self.owner = owner
        self._pipe = pipe
        self._network = pipe.network
        self._handler: ConnectionHandler | None = None
        self._closing = False
        self.closed = False
        self._unsent = 0
        self._free_s = 0.0  # when the earlier bytes have left
        self._arrival_s = 0.0  # of the bytes that were sent last
        self.coming: list[bytes] = []  # parts that arrive at the same time are delivered together, as in a stream
        self.coming_s = -1.0
        self.on_the_way: deque[list[bytes]] = deque()  # in order of sending, which is that of arrival
        self.arrive = self._arrived  # bound once, not for each send

    def begin(self, handler: ConnectionHandler) -> None:
        self._handler = handler
        handler.opened(self)

    def send(self, data: bytes) -> int:
        if self._closing or not data:
            return self._unsent
        network, quality = self._network, self._pipe.quality()
        if quality.bytes_per_s == math.inf:
            self._send_part(data, network.now(), quality)
            return self._unsent
        # A slow stream trickles: the other side gets bytes all the time, not all of them at the end.
        part_bytes = max(1, int(quality.bytes_per_s * _TRICKLE_S))
        self._unsent += len(data)
        for start in range(0, len(data), part_bytes):
            part = data[start : start + part_bytes]
            self._free_s = max(self._free_s, network.now()) + len(part) / quality.bytes_per_s
            network.call_at(self._free_s, partial(self._left, len(part)))
            self._send_part(part, self._free_s, quality)
        return self._unsent

    def _send_part(self, data: bytes, left_s: float, quality: Quality) -> None:
        network = self._network
        arrival_s = left_s + network.travel_s(quality)
        if arrival_s < self._arrival_s:
            arrival_s = self._arrival_s
        self._arrival_s = arrival_s
        if self._pipe.is_cut():
            return
        other = self.other
        if arrival_s == other.coming_s:
            other.coming.append(data)
            return
        other.coming, other.coming_s = [data], arrival_s
        other.on_the_way.append(other.coming)
        network.call_at(arrival_s, other.arrive)

    def unsent(self) -> int:
        return self._unsent

    def close(self, reason: str = "") -> None:
        if self._closing:
            return
        self.finish_later(reason or "this side closed the connection")
        # The other end sees it after all that was sent before.
        arrival_s = max(self._arrival_s, self._network.now() + self._network.travel_s(self._pipe.quality()))
        if not self._pipe.is_cut():
            self._network.call_at(arrival_s, self.other.hang_up)

    def finish_later(self, reason: str) -> None:
        """Close this end. The handler is called later, not from here."""
        self._closing = True
        self._network.call_at(self._network.now(), lambda: self._finish(reason))

    def _arrived(self) -> None:
        parts = self.on_the_way.popleft()
        if parts is self.coming:
            self.coming_s = -1.0  # bytes that are sent from now on come later, even if at the same time
        if self._closing or self._pipe.is_cut():
            return
        if self._handler is not None:
            self._handler.received(parts[0] if len(parts) == 1 else b"".join(parts))

    def hang_up(self) -> None:
        if not self._closing and not self._pipe.is_cut():
            self._closing = True
            self._finish("the other side closed the connection")

    def _left(self, count: int) -> None:
        self._unsent -= count
        if self._unsent == 0 and not self._closing and self._handler is not None:
            self._handler.drained()

    def _finish(self, reason: str) -> None:
        if self.closed:
            return
        self.closed = True
        if self.other.closed:
            self._network.ended(self._pipe)
        if self._handler is not None:
            self._handler.closed(reason)
