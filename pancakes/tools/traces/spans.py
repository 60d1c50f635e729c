"""Make spans of the packets of an agent: a trace from a reading to its command, over agents. Pure.

A trace is a first cause (a reading, a tick) and all packets that it led to, and each packet is a span, whose parent is
its cause. The ids are digests of the names of packets (source and number), so agents that meet in a trace need not
agree on any. Whether a trace is sampled follows from its id, so all of them decide alike.

A packet names only its cause, not its first cause. If a packet with a longer history leaves the agent, its first cause
follows in a note (`RootNote`). So a packet waits for `HOLD_S` before it becomes a span: the note of its cause may still
be on its way, over several agents.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from functools import lru_cache
from hashlib import blake2b
from typing import Final, Literal, NamedTuple

import msgspec

from pancakes.packet import CTRL, Cause, agent_of, number_in_life
from pancakes.recording.causal_chains import LONGEST

HOLD_S: Final = 2.0
"""A packet becomes a span this much later, in seconds of the host."""
REMEMBERED: Final = 20_000
"""The number of packets, and that of notes, that are remembered as causes of later packets."""
HOLD: Final = "hold"
"""The type of the packets with which a task takes and leaves an actuator. They move nothing."""


class Heard(NamedTuple):
    """A packet that was seen on this agent.

    Attributes:
        time_s: when, in host time.
        channel: its channel.
        type: the name of its type.
        source: the address of its publisher.
        destination: where it goes; empty: to all subscribers here.
        seq: its number.
        cause: the packet that led to it.
        stamp_s: the mission time at its publisher.
        task_id: the durable task that published it; empty: none.
    """

    time_s: float
    channel: str
    type: str
    source: str
    destination: str
    seq: int
    cause: Cause | None
    stamp_s: float
    task_id: str = ""


class RootNote(NamedTuple):
    """The first cause of a packet that goes to another agent.

    Attributes:
        to: the agent, or `*` for all neighbours.
        packet: the packet.
        root: its first cause.
    """

    to: str
    packet: Cause
    root: Cause


class Span(msgspec.Struct, frozen=True):
    """One packet of a sampled trace.

    Attributes:
        trace_id: 128 bits, the same for all packets with this first cause.
        span_id: 64 bits.
        parent_id: the span of its cause; 0: it is the first cause.
        is_parent_elsewhere: whether another agent published its cause.
        name: publisher and type, without the agent.
        kind: whether it leaves the agent, answers a packet of another, or neither.
        start_s: when its cause was seen here: from then on that waited in a mailbox and was handled. Host time.
        end_s: when the packet was published.
        attributes: what else is known of the packet.
    """

    trace_id: int
    span_id: int
    parent_id: int
    is_parent_elsewhere: bool
    name: str
    kind: Literal["internal", "producer", "consumer"]
    start_s: float
    end_s: float
    attributes: dict[str, str | int | float | bool]


@lru_cache(maxsize=4096)
def trace_id_of(root: Cause) -> int:
    """Return the id of the trace with a first cause; never 0."""
    return int.from_bytes(_digest(root, 16, b"trace"), "big") or 1


def span_id_of(packet: Cause) -> int:
    """Return the id of the span of a packet; never 0."""
    return int.from_bytes(_digest(packet, 8, b"span"), "big") or 1


def is_sampled(root: Cause, ratio: float) -> bool:
    """Return whether a trace is sampled, as `TraceIdRatioBased` of OpenTelemetry decides it.

    Args:
        root: its first cause.
        ratio: the share of traces that are, from 0 to 1.
    """
    return (trace_id_of(root) & (2**64 - 1)) < round(ratio * 2**64)


def _digest(packet: Cause, size: int, person: bytes) -> bytes:
    return blake2b(f"{packet[0]}\0{packet[1]}".encode(), digest_size=size, person=person).digest()


class _Known(NamedTuple):
    """What is remembered of a packet: when it was seen here first, and its cause."""

    time_s: float
    cause: Cause | None


class SpanMaker:
    """Takes the packets that are seen on one agent, and returns the spans of those that it published.

    Args:
        agent: the agent's name.
        ratio: the share of traces that are sampled, from 0 to 1.
    """

    def __init__(self, agent: str, ratio: float) -> None:
        self._agent = agent
        self._ratio = ratio
        self._known: OrderedDict[Cause, _Known] = OrderedDict()
        self._roots: OrderedDict[Cause, Cause] = OrderedDict()  # of packets of other agents, as these say
        self._waiting: deque[Heard] = deque()
        self._leaving: deque[Heard] = deque()

    def hear(self, packet: Heard) -> None:
        """Take a packet that was seen here, in the order of time; a second time it does not count."""
        key = (packet.source, packet.seq)
        if key in self._known:
            return
        self._known[key] = _Known(packet.time_s, packet.cause)
        if len(self._known) > REMEMBERED:
            self._known.popitem(last=False)
        if agent_of(packet.source) != self._agent:
            return
        self._waiting.append(packet)
        if packet.cause is not None and packet.destination and agent_of(packet.destination) != self._agent:
            self._leaving.append(packet)

    def hear_root(self, packet: Cause, root: Cause) -> None:
        """Take the first cause of a packet of another agent."""
        self._roots[packet] = root
        if len(self._roots) > REMEMBERED:
            self._roots.popitem(last=False)

    def take_notes(self, now_s: float) -> list[RootNote]:
        """Return what other agents should be told now of packets that they got from here."""
        notes: list[RootNote] = []
        left: deque[Heard] = deque()
        for it in self._leaving:
            assert it.cause is not None
            root, is_sure = self._root_of((it.source, it.seq))
            if not is_sure and it.time_s > now_s - HOLD_S:
                left.append(it)  # a note about it may still come
            # Without a note the other agent would take the cause for the first one.
            elif is_sampled(root, self._ratio) or is_sampled(it.cause, self._ratio):
                name = agent_of(it.destination)
                notes.append(RootNote("*" if name == "*" or ":" in name else name, (it.source, it.seq), root))
        self._leaving = left
        return notes

    def take_spans(self, now_s: float, *, all_: bool = False) -> list[Span]:
        """Return the spans that are complete now.

        Args:
            now_s: host time.
            all_: whether no more packets come, so that nothing is waited for.
        """
        spans = []
        while self._waiting and (all_ or self._waiting[0].time_s <= now_s - HOLD_S):
            it = self._waiting.popleft()
            root, _ = self._root_of((it.source, it.seq))
            if is_sampled(root, self._ratio):
                spans.append(self._span(it, root))
        return spans

    def _root_of(self, packet: Cause) -> tuple[Cause, bool]:
        """Return the first cause of a packet, and whether it is known to be that: its own cause may be unknown here."""
        for _ in range(LONGEST):
            if (told := self._roots.get(packet)) is not None:
                return told, True
            known = self._known.get(packet)
            if known is None:
                return packet, False
            if known.cause is None:
                return packet, True
            packet = (known.cause[0], known.cause[1])
        return packet, True  # a task that answers itself makes an endless chain

    def _span(self, it: Heard, root: Cause) -> Span:
        key, cause = (it.source, it.seq), it.cause
        known = self._known.get(cause) if cause is not None else None
        elsewhere = cause is not None and agent_of(cause[0]) != self._agent
        leaves = bool(it.destination) and agent_of(it.destination) != self._agent
        attributes: dict[str, str | int | float | bool] = {
            "pancakes.source": it.source,
            "pancakes.number": number_in_life(it.seq),
            "pancakes.channel": it.channel,
            "pancakes.type": it.type,
            "pancakes.mission_s": it.stamp_s,
            "pancakes.command": it.channel == CTRL and it.type != HOLD,
        }
        if it.destination:
            attributes["pancakes.destination"] = it.destination
        if it.task_id:
            attributes["pancakes.task"] = it.task_id
        place = it.source.partition("/")[2]
        return Span(
            trace_id_of(root),
            span_id_of(key),
            span_id_of(cause) if cause is not None and key != root else 0,
            elsewhere,
            f"{place} {it.type}".strip(),
            "producer" if leaves else "consumer" if elsewhere else "internal",
            min(known.time_s, it.time_s) if known is not None else it.time_s,
            it.time_s,
            attributes,
        )
