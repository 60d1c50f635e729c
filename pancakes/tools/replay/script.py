"""What a task got and gave in the course of a stay, read from a recording. Pure."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final

from msgspec.structs import asdict, replace

from pancakes.errors import RemoteProtocolError
from pancakes.events import Event
from pancakes.mesh.migration.post import Letter
from pancakes.packet import LOG, NEIGHBOURS, TO_TASK, Cause, Packet, agent_of, covers
from pancakes.runtime.foundation.arrays import alike
from pancakes.runtime.kernel.handlers import subscriptions_of
from pancakes.task import Task
from pancakes.tools.recording.description import CHANNEL, TaskDescription
from pancakes.tools.recording.message import packet_from_bytes
from pancakes.tools.recording.recorded_packet import NANOSECONDS, RecordedPacket
from pancakes.tools.replay.overtaken import Overtaken
from pancakes.tools.replay.ran_ticks import UNKNOWN_TICKS, RanTicks, TicksReader
from pancakes.tools.replay.stays import ENDS, Stay
from pancakes.tools.replay.steps import CHANGES, Change, Given

CLOSE_S: Final = 0.005
"""In less host time than this a task is not surely given a turn."""
END_S: Final = 0.05
"""A task may have ended this much earlier than its service says, in host time."""
_LINGERING_NS: Final = 5 * NANOSECONDS
"""A packet may have arrived this long before a stay, and have its effect only in the stay."""


@dataclass
class Script:
    """All that a task got and gave in the course of a stay.

    Attributes:
        steps: what it got and what was done to it, in order.
        outputs: the packets that it published, in order.
        end_s: the mission time at which the stay ended.
        channels: the channels that were spoken on at its agent.
        spoken_s: when it published what no packet had led to, such as in a tick, and when it had published something
            before that; in order, in mission time.
        superseded: how many packets were left out of `steps`, because a newer one took their place in the mailbox
            before the task came to them, or the task's end came first.
        speed: mission seconds for each second of host time then.
        ticks: which ticks ran, by timer; None: all did, or the recording does not tell.
        notes: sentences on what the recording does not tell.
    """

    steps: list[Given | Change] = field(default_factory=list)
    outputs: list[Packet] = field(default_factory=list)
    end_s: float = 0.0
    channels: list[str] = field(default_factory=list)
    spoken_s: list[tuple[float, float]] = field(default_factory=list)
    superseded: int = 0
    speed: float = 1.0
    ticks: dict[str, RanTicks] | None = None
    notes: list[str] = field(default_factory=list)


def read_script(
    entries: Iterable[RecordedPacket], stay: Stay, cls: type[Task], speed: float = 1.0, virtual: bool = False
) -> Script:
    """Reads what a task got and gave.

    Args:
        entries: the recording, in the order of time.
        stay: the stay.
        cls: the present class: what it subscribes to counts as well as what the recorded one did.
        speed: mission seconds for each second of the recording.
        virtual: whether it was made in virtual time: there nothing takes time.
    """
    reader = _StayReader(stay, cls)
    seen = [entry for entry in entries if reader.take(entry)]
    times = _MissionTimes(stay, speed, seen)
    script = Script(channels=list(reader.channels), speed=speed)
    script.outputs = [entry.packet for entry in seen if reader.is_output(entry.packet) and not reader.lingers(entry)]
    handled_s: dict[Cause, float] = {}
    for packet in script.outputs:
        if packet.cause is not None:
            handled_s.setdefault((packet.cause[0], packet.cause[1]), packet.stamp)
    now_s = stay.begins_s
    steps: list[Given | Change] = []
    for entry in seen:
        packet = entry.packet
        if reader.is_output(packet):
            continue
        at_s = times.of(entry)
        if reader.is_change(packet):
            now_s = max(now_s, at_s)
            steps.append(Change(now_s, packet.body))
            continue
        for inner, letter in reader.inputs(packet):
            now_s = max(now_s, at_s, min(handled_s.get((inner.source, inner.seq), 0.0), times.end_s))
            steps.append(Given(now_s, at_s, inner, letter))
    before_s = 0.0
    for packet in script.outputs:
        if packet.cause is None:
            script.spoken_s.append((packet.stamp, before_s))
        before_s = packet.stamp
    script.end_s = max(now_s, times.end_s)
    overtaken = Overtaken(steps, reader.limits, handled_s, 0.0 if virtual else CLOSE_S * speed)
    end_s = times.end_s - END_S * speed if stay.end and not virtual else math.inf
    script.steps = [step for step in steps if not overtaken.fell_out(step) and not overtaken.came_late(step, end_s)]
    script.superseded = len(steps) - len(script.steps)
    script.ticks = reader.ticks.ticks()
    if script.ticks is None and stay.task.timers and not virtual:
        script.notes.append(UNKNOWN_TICKS)
    return script


class _StayReader:
    """Tells what of a recording has to do with a stay."""

    def __init__(self, stay: Stay, cls: type[Task]) -> None:
        self._stay = stay
        self._address = stay.task.address
        subscriptions = [subscription for subscription, _ in subscriptions_of(cls)]
        self._wants = {(subscription.channel, subscription.type) for subscription in subscriptions}
        self.limits = {
            (it.channel, it.type): it.keep.limit for it in subscriptions if it.type is not None and not it.keep.reliable
        }
        self.channels: dict[str, None] = {}
        self.ticks = TicksReader(stay)
        self._letters: dict[Cause, None] = {}
        self._before: dict[Cause, None] = {}
        self._lives = False
        self._over = False

    def take(self, entry: RecordedPacket) -> bool:
        """Returns whether an entry is an input, an output or a change of the stay; in the order of time."""
        stay, packet = self._stay, entry.packet
        self.ticks.take(entry)
        if not self._lives and isinstance(packet.body, TaskDescription):
            self._lives = alike(asdict(packet.body), asdict(stay.task))
        if self._over or entry.agent != stay.agent or entry.time_ns > stay.to_ns or packet.channel == CHANNEL:
            return False
        # In virtual time its successor may live from the very same moment on.
        self._over = bool(stay.end) and entry.time_ns == stay.to_ns and self._is_told(packet, ENDS)
        if entry.time_ns < stay.from_ns or (entry.time_ns == stay.from_ns and not self._begun(entry)):
            if not stay.whole and entry.time_ns >= stay.from_ns - _LINGERING_NS:
                self._before[packet.source, packet.seq] = None
            return False
        self.channels[packet.channel] = None
        return self.is_output(packet) or self.is_change(packet) or self._is_input(packet)

    def _begun(self, entry: RecordedPacket) -> bool:
        """Returns whether a stay has begun, at the very moment at which it does so.

        In virtual time much happens at one moment, before that and after: the task has said something, its service has
        said that it runs, or it has been described.
        """
        if self._stay.whole and not self._lives:
            self._lives = self.is_output(entry.packet) or self._is_told(entry.packet, ("task_started",))
        return self._lives

    def is_output(self, packet: Packet) -> bool:
        """Returns whether the task published it."""
        return packet.source == self._address

    def lingers(self, entry: RecordedPacket) -> bool:
        """Returns whether a packet is the effect of one that came before the stay."""
        cause = entry.packet.cause
        return cause is not None and (cause[0], cause[1]) in self._before

    def is_change(self, packet: Packet) -> bool:
        """Returns whether it tells of a change of the task."""
        return self._is_told(packet, CHANGES)

    def _is_told(self, packet: Packet, kinds: Collection[str]) -> bool:
        """Returns whether a packet is one of these events, about the task."""
        body = packet.body
        return (
            packet.channel == LOG
            and packet.source == self._stay.service
            and isinstance(body, Event)
            and body.kind in kinds
            and body.fields.get("task") == self._stay.name
        )

    def _is_input(self, packet: Packet) -> bool:
        if self._letter_of(packet) is not None:
            return True
        destination, agent = packet.destination, self._stay.agent
        if destination == NEIGHBOURS:
            here = agent_of(packet.source) != agent
        else:
            here = destination in ("", agent) or covers(destination, self._address)
        return here and self._reads(packet)

    def _reads(self, packet: Packet) -> bool:
        wants = (packet.channel, packet.type) in self._wants or (packet.channel, None) in self._wants
        return wants or self._stay.task.reads_packet(packet.channel, packet.type)

    def _letter_of(self, packet: Packet) -> Packet | None:
        """Returns the packet to this task, wherever it is, that this one is or brings."""
        if packet.destination == TO_TASK + self._stay.task.task_id and agent_of(packet.source) == self._stay.agent:
            return packet
        body = packet.body
        if isinstance(body, Letter) and body.task_id == self._stay.task.task_id and packet.source != self._address:
            try:
                inner = packet_from_bytes(body.packet)
            except RemoteProtocolError:
                return None
            return inner if agent_of(packet.destination) == self._stay.agent else None
        return None

    def inputs(self, packet: Packet) -> Iterator[tuple[Packet, bool]]:
        """Yields the packet as the task got it, and whether it was a letter; a letter that came twice only once."""
        letter = self._letter_of(packet)
        if letter is None:
            yield packet, False
        elif (letter.source, letter.seq) not in self._letters:
            self._letters[letter.source, letter.seq] = None
            yield replace(letter, destination=self._address), True


class _MissionTimes:
    """Turns a recording's time into the mission time of a stay's agent."""

    def __init__(self, stay: Stay, speed: float, entries: Iterable[RecordedPacket]) -> None:
        self._stay = stay
        self._speed = speed
        own = [(entry.packet.stamp, entry.time_ns) for entry in entries if self._is_own(entry.packet)]
        # A packet bears the mission time of its making, and is seen the moment after, or a little later.
        offsets = [stamp - self._elapsed_s(time_ns) for stamp, time_ns in own if stamp > 0.0]
        # While a mission is held it has no time that could be compared.
        self._offset_s = max(offsets, default=stay.begins_s)
        self.end_s = max(self._of_ns(stay.to_ns), stay.begins_s)

    def of(self, entry: RecordedPacket) -> float:
        """Returns the mission time at which a packet was seen."""
        return entry.packet.stamp if self._is_own(entry.packet) else self._of_ns(entry.time_ns)

    def _is_own(self, packet: Packet) -> bool:
        return agent_of(packet.source) == self._stay.agent

    def _of_ns(self, time_ns: int) -> float:
        return max(0.0, self._offset_s + self._elapsed_s(time_ns))

    def _elapsed_s(self, time_ns: int) -> float:
        return (time_ns - self._stay.from_ns) / NANOSECONDS * self._speed
