"""Cause and effect: from a packet back to its causes, across agents, with the time of each step.

`CommandChains` gives the commands to actuators, each with its chain. Pure, in bounded memory; agents use it live.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Iterable, Mapping
from typing import Any, Final

import msgspec

from pancakes.control import Hold
from pancakes.packet import CTRL, Cause, Packet, agent_of, field_names
from pancakes.recording.records import NANOSECONDS, RecordedPacket

LONGEST: Final = 64
"""The longest chain that is followed: a task that answers itself would make an endless one."""


class ChainStep(msgspec.Struct, frozen=True):
    """One packet of a chain.

    Attributes:
        packet: the packet.
        time_ns: when it was first seen.
        travel_s: how long it took to the agent where it led to the next step; 0 if that was its own agent.
        handling_s: the time from there to the next step, in a mailbox and in a handler; 0 for the last.
        sent: whether it was recorded where it was published. If no recorder ran there, it is known only from its
            arrival, and `travel_s` is 0.
    """

    packet: Packet
    time_ns: int
    travel_s: float
    handling_s: float
    sent: bool = True

    @property
    def name(self) -> str:
        """The publisher and the packet type, common to all steps of this kind."""
        return f"{self.packet.source} {self.packet.type}"


class Chain(msgspec.Struct, frozen=True):
    """A packet with all its causes, the first cause first.

    Attributes:
        steps: the packets.
    """

    steps: tuple[ChainStep, ...]

    @property
    def latency_s(self) -> float:
        """The time from the first cause to the last effect."""
        return (self.steps[-1].time_ns - self.steps[0].time_ns) / NANOSECONDS

    @property
    def shape(self) -> tuple[str, ...]:
        """The publishers and packet types in order, common to all chains of this kind."""
        return tuple(step.name for step in self.steps)


class Causes:
    """Remember packets, and find the chain that ends with a packet.

    Args:
        limit: how many packets are remembered; the oldest is forgotten.
    """

    def __init__(self, limit: int = 1_000_000) -> None:
        self._limit = limit
        self._packets: OrderedDict[Cause, Packet] = OrderedDict()
        self._seen_ns: dict[Cause, dict[str, int]] = {}

    def add(self, entry: RecordedPacket) -> None:
        """Add a packet and where it was seen. Call it in the order of time."""
        packet = entry.packet
        key = (packet.source, packet.seq)
        if key not in self._packets:
            self._packets[key] = packet
            self._seen_ns[key] = {}
            if len(self._packets) > self._limit:
                oldest, _ = self._packets.popitem(last=False)
                del self._seen_ns[oldest]
        self._seen_ns[key].setdefault(entry.agent, entry.time_ns)

    def chain(self, source: str, seq: int) -> Chain | None:
        """Return the chain that ends with a packet; None if the packet is not known."""
        keys: list[Cause] = []
        key: Cause | None = (source, seq)
        while key is not None and key in self._packets and key not in keys and len(keys) < LONGEST:
            keys.insert(0, key)
            cause = self._packets[key].cause
            key = (cause[0], cause[1]) if cause is not None else None
        if not keys:
            return None
        effects: list[Cause | None] = [*keys[1:], None]
        return Chain(tuple(self._step(key, effect) for key, effect in zip(keys, effects, strict=True)))

    def _step(self, key: Cause, effect: Cause | None) -> ChainStep:
        packet, seen_ns = self._packets[key], self._seen_ns[key]
        first_ns = min(seen_ns.values())
        sent = agent_of(key[0]) in seen_ns
        if effect is None:
            return ChainStep(packet, first_ns, 0.0, 0.0, sent)
        next_ns = min(self._seen_ns[effect].values())
        # The publisher of the effect had the packet by then, even if the recorder there saw it only later.
        arrived_ns = max(first_ns, min(seen_ns.get(agent_of(effect[0]), first_ns), next_ns))
        travel_s, handling_s = (arrived_ns - first_ns) / NANOSECONDS, (next_ns - arrived_ns) / NANOSECONDS
        return ChainStep(packet, first_ns, travel_s, handling_s, sent)


REMEMBERED: Final = 50_000
"""The number of packets that are remembered as causes of later ones."""
HELD_NS: Final = NANOSECONDS
"""A chain is followed this much later: if the clocks of two machines disagree, a cause may seem later."""
BODY_CHARACTERS: Final = 160
"""At most this many characters of a packet's body are shown."""


def chain_rows(chain: Chain) -> list[dict[str, Any]]:
    """Return the steps of a chain as plain rows, without bodies; times in milliseconds.

    `at_ms` counts from the first step. `travel_ms` is None for a packet that no recorder saw where it was published.
    """
    first_ns = chain.steps[0].time_ns
    return [
        {
            "source": step.packet.source,
            "seq": step.packet.seq,
            "number": step.packet.number,
            "channel": step.packet.channel,
            "type": step.packet.type,
            "at_ms": _ms((step.time_ns - first_ns) / NANOSECONDS),
            "travel_ms": _ms(step.travel_s) if step.sent else None,
            "handling_ms": _ms(step.handling_s),
        }
        for step in chain.steps
    ]


def _ms(seconds: float) -> float:
    return round(1e3 * seconds, 3)


def is_command(agent: str, packet: Packet) -> bool:
    """Return whether a packet that was seen on an agent's channel commands an actuator of that agent."""
    return packet.channel == CTRL and not isinstance(packet.body, Hold) and agent_of(packet.source) == agent


class ActuatorCommand(msgspec.Struct, frozen=True):
    """A command, and why it was given.

    Attributes:
        time_ns: when it was recorded, see `RecordedPacket`.
        packet: the command; its type names the actuator, its stamp is the mission time.
        chain: what led to it; if no cause is known, only the command.
    """

    time_ns: int
    packet: Packet
    chain: Chain

    @property
    def agent(self) -> str:
        """The agent whose actuator it is."""
        return agent_of(self.packet.source)

    @property
    def caused(self) -> bool:
        """Whether its cause is known: otherwise a timer led to it, or its cause was not recorded."""
        return len(self.chain.steps) > 1


class CommandChains:
    """Take packets, and return the commands among them with their chains.

    Args:
        bodies: whether to keep the bodies of the packets in a chain; that of the command is always kept. Without them,
            less memory is needed.
        limit: how many packets are remembered.
    """

    def __init__(self, bodies: bool = True, limit: int = REMEMBERED) -> None:
        self._bodies = bodies
        self._causes = Causes(limit)
        self._waiting: deque[tuple[int, Packet]] = deque()

    def add(self, entry: RecordedPacket) -> list[ActuatorCommand]:
        """Take a packet, in the order of time; return the commands whose chains are now complete, oldest first."""
        packet = entry.packet
        kept = packet if self._bodies else msgspec.structs.replace(packet, body=None)
        self._causes.add(RecordedPacket(entry.time_ns, entry.agent, kept))
        if is_command(entry.agent, packet):
            self._waiting.append((entry.time_ns, packet))
        return self._followed(entry.time_ns - HELD_NS)

    def close(self) -> list[ActuatorCommand]:
        """Return the rest, now that no more packets come."""
        return self._followed(None)

    def _followed(self, until_ns: int | None) -> list[ActuatorCommand]:
        found = []
        while self._waiting and (until_ns is None or self._waiting[0][0] <= until_ns):
            time_ns, packet = self._waiting.popleft()
            chain = self._causes.chain(packet.source, packet.seq)
            if chain is not None:
                found.append(ActuatorCommand(time_ns, packet, chain))
        return found


def body_text(body: Any, longest: int = BODY_CHARACTERS) -> str:
    """Return the body of a packet as one short line."""
    items = _items(body)
    text = _value(body) if items is None else ", ".join(f"{name} {_value(value)}" for name, value in items)
    return text if len(text) <= longest else text[: longest - 1] + "…"


def _items(value: Any) -> Iterable[tuple[Any, Any]] | None:
    """Return the fields of a body, or of a part of one; None if it has none.

    It reads the fields directly: first converting the body to plain values is slower, and agents do this for each
    command while a web page is open.
    """
    if isinstance(value, Mapping):
        return value.items()
    names = field_names(type(value))
    return ((name, getattr(value, name)) for name in names) if names else None


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, str | int | None):
        return str(value)
    if isinstance(value, list | tuple):
        if len(value) > 4 or any(_items(it) is not None for it in value):
            return f"{len(value)} values"
        return f"({', '.join(_value(it) for it in value)})"
    if hasattr(value, "tolist"):
        size = getattr(value, "size", 1)
        return _value(value.tolist()) if size <= 4 else f"{size} values"
    items = _items(value)
    return str(value) if items is None else f"({', '.join(f'{name} {_value(it)}' for name, it in items)})"
