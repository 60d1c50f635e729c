"""Cause and effect: from a packet back to what led to it, across agents, with the time that each step took. Pure."""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

import msgspec

from pancakes.packet import Cause, Packet, agent_of
from pancakes.tools.recording.recorded_packet import NANOSECONDS, RecordedPacket

LONGEST: Final = 64
"""No chain is followed further: a task that answers itself for ever would make one without an end."""


class ChainStep(msgspec.Struct, frozen=True):
    """One packet of a chain.

    Attributes:
        packet: the packet.
        time_ns: when it was first seen.
        travel_s: how long it then took to the agent where it led to the next step; 0 where that was its own.
        handling_s: the time from there to the next step: it waited, and was handled. 0 for the last.
        sent: whether it was seen where it was published. Else no recorder ran there: it is known only from its arrival
            on, and `travel_s` is 0.
    """

    packet: Packet
    time_ns: int
    travel_s: float
    handling_s: float
    sent: bool = True

    @property
    def name(self) -> str:
        """The publisher and the packet type, which are the same for all steps of this kind."""
        return f"{self.packet.source} {self.packet.type}"


class Chain(msgspec.Struct, frozen=True):
    """A packet with all that led to it, the first cause first.

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
        """The publishers and packet types in order, which all chains of this kind have in common."""
        return tuple(step.name for step in self.steps)


class Causes:
    """Remembers packets, and finds the chain that a packet stands at the end of.

    Args:
        limit: so many packets are remembered; the oldest is forgotten.
    """

    def __init__(self, limit: int = 1_000_000) -> None:
        self._limit = limit
        self._packets: OrderedDict[Cause, Packet] = OrderedDict()
        self._seen_ns: dict[Cause, dict[str, int]] = {}

    def add(self, entry: RecordedPacket) -> None:
        """Remembers a packet and where it was seen; in the order of time."""
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
        """Returns the chain that ends with a packet; None where the packet is not known."""
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
