"""A summary of a recording: its packets by topic, and where its tasks were."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final

from pancakes.packet import agent_of
from pancakes.tools.recording.recorded_packet import NANOSECONDS, RecordedPacket

LEAST_SPAN_S: Final = 1.0
"""A rate is told of packets that came over so long a time."""


@dataclass
class TopicCount:
    """What was seen of one packet type on one channel of one agent."""

    agent: str
    channel: str
    type: str
    packets: int = 0
    first_ns: int = 0
    last_ns: int = 0

    def row(self) -> dict[str, Any]:
        """Returns it as plain values."""
        span_s = (self.last_ns - self.first_ns) / NANOSECONDS
        # Packets that came at once, and never again, have no rate.
        rate_hz = (self.packets - 1) / span_s if self.packets > 1 and span_s >= LEAST_SPAN_S else None
        return {
            "agent": self.agent,
            "channel": self.channel,
            "type": self.type,
            "packets": self.packets,
            "rate_hz": round(rate_hz, 3) if rate_hz is not None else None,
        }


@dataclass
class TaskPresence:
    """A time that a task spent on one agent.

    Attributes:
        task_id: the task's identity for life.
        agent: where it was.
        epoch: how often it had been handed over.
        published: how many packets it published there.
    """

    task_id: str
    agent: str
    epoch: int
    first_ns: int
    last_ns: int
    published: int


@dataclass
class Summary:
    """What is in a recording.

    Attributes:
        packets: how many packets.
        first_ns: when the first was recorded.
        last_ns: when the last was.
        topics: by agent, channel and type.
        stays: where each task that has an identity was, in the order of time.
    """

    packets: int = 0
    first_ns: int = 0
    last_ns: int = 0
    topics: dict[tuple[str, str, str], TopicCount] = field(default_factory=dict)
    stays: list[TaskPresence] = field(default_factory=list)

    @classmethod
    def of(cls, entries: Iterable[RecordedPacket]) -> Summary:
        """Makes it from packets in the order of time."""
        summary = cls()
        for entry in entries:
            summary._add(entry)
        return summary

    def _add(self, entry: RecordedPacket) -> None:
        packet = entry.packet
        if not self.packets:
            self.first_ns = entry.time_ns
        self.packets += 1
        self.last_ns = entry.time_ns
        key = (entry.agent, packet.channel, packet.type)
        topic = self.topics.get(key)
        if topic is None:
            topic = self.topics[key] = TopicCount(*key, first_ns=entry.time_ns)
        topic.packets += 1
        topic.last_ns = entry.time_ns
        if packet.fence is not None and agent_of(packet.source) == entry.agent:
            self._add_to_stay(entry, packet.fence.task_id, packet.fence.epoch[0])

    def _add_to_stay(self, entry: RecordedPacket, task_id: str, epoch: int) -> None:
        for stay in reversed(self.stays):
            if (stay.task_id, stay.agent, stay.epoch) == (task_id, entry.agent, epoch):
                stay.last_ns = entry.time_ns
                stay.published += 1
                return
        self.stays.append(TaskPresence(task_id, entry.agent, epoch, entry.time_ns, entry.time_ns, 1))
