"""Collect everything that a report shows of a recording: packets go in, plain data comes out. Pure, bounded memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from pancakes.packet import Packet
from pancakes.recording.clock_alignment import MissionTime
from pancakes.recording.records import CHANNEL, RecordedPacket
from pancakes.recording.task_statistics import TaskFigures
from pancakes.tools.report.command_latency import PickedCommands, Reactions
from pancakes.tools.report.losses import Losses
from pancakes.tools.report.mission import BodyPaths, EventDigest, Moves, TaskTimeline
from pancakes.tools.report.performance import Rates, Traffic

MOST_TOPICS: Final = 2000


@dataclass
class Findings:
    """What a recording shows, in mission time.

    Attributes:
        task_id: the only task to report on; empty: all.
        packets: how many packets the recording has.
        first_ns: when the first packet was recorded; see `RecordedPacket`.
        last_ns: when the last packet was recorded.
        topics: how many packets there were, by agent, channel and type.
        strange: how many packets were skipped because their types are unknown here, or had other fields then.
        time: converts recording time to mission time.
    """

    task_id: str = ""
    packets: int = 0
    first_ns: int = 0
    last_ns: int = 0
    topics: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    strange: int = 0
    time: MissionTime = MissionTime()
    paths: BodyPaths = field(default_factory=BodyPaths)
    timeline: TaskTimeline = field(default_factory=TaskTimeline)
    rates: Rates = field(default_factory=Rates)
    traffic: Traffic = field(default_factory=Traffic)
    moves: Moves = field(default_factory=Moves)
    reactions: Reactions = field(default_factory=Reactions)
    events: EventDigest = field(default_factory=EventDigest)
    losses: Losses = field(default_factory=Losses)

    @classmethod
    def of(cls, entries: Iterable[RecordedPacket], task_id: str = "", time: MissionTime = MissionTime()) -> Findings:  # noqa: B008
        """Collect the findings of packets.

        Args:
            entries: the packets, in the order of time.
            task_id: report only on this task: its agents, rates, migrations, commands and packets; empty: all.
            time: converts recording time to mission time.
        """
        findings = cls(task_id, time=time, reactions=Reactions(task_id, picked=PickedCommands(time)))
        for entry in entries:
            findings._add(entry)
        findings.timeline.close()
        findings.losses.close()
        for loss in findings.losses.losses:
            findings.timeline.lost(loss.agent, loss.at_s)
            findings.events.lost(loss)
        findings.traffic.close()
        findings.reactions.close()
        if task_id:
            findings.timeline.only(task_id)
            findings.rates.only(task_id)
            findings.moves.only(task_id)
        return findings

    @property
    def begin_s(self) -> float:
        """The mission time of the first packet."""
        return self.time.at(self.first_ns)

    @property
    def end_s(self) -> float:
        """The mission time of the last packet."""
        return self.time.at(self.last_ns)

    @property
    def duration_s(self) -> float:
        """The mission time from the first packet to the last."""
        return self.end_s - self.begin_s

    @property
    def agents(self) -> list[str]:
        """The agents that were recorded, by name."""
        return sorted(self.timeline.seen_s)

    def _add(self, entry: RecordedPacket) -> None:
        packet = entry.packet
        if not self.packets:
            self.first_ns = entry.time_ns
        self.packets += 1
        self.last_ns = max(self.last_ns, entry.time_ns)
        t_s = self.time.at(entry.time_ns)
        self._count(entry.agent, packet)
        try:
            self._look(entry, packet, t_s)
        except (AttributeError, KeyError, TypeError, ValueError):
            # A type that is not installed here comes as a mapping, and names are not protected: a report on the
            # rest is better than none.
            self.strange += 1

    def _look(self, entry: RecordedPacket, packet: Packet, t_s: float) -> None:
        agent = entry.agent
        self.timeline.add(agent, packet, t_s)
        self.losses.add(agent, packet, t_s)
        if packet.channel == CHANNEL:
            if isinstance(packet.body, TaskFigures):
                self.rates.add(agent, packet.body, t_s)
            return
        self.paths.add(agent, packet, t_s)
        if not self.task_id or (packet.fence is not None and packet.fence.task_id == self.task_id):
            self.traffic.add(agent, packet, t_s - self.begin_s)
        self.moves.add(agent, packet, t_s)
        self.events.add(agent, packet, t_s)
        self.reactions.add(entry)

    def _count(self, agent: str, packet: Packet) -> None:
        key = (agent, packet.channel, packet.type)
        if key in self.topics or len(self.topics) < MOST_TOPICS:
            self.topics[key] += 1

    def plain(self) -> dict[str, Any]:
        """Return the figures of the report as plain values, for other programs."""
        return {
            "task_id": self.task_id,
            "agents": self.agents,
            "packets": self.packets,
            "time": self.time.name,
            "begin_s": self.begin_s,
            "end_s": self.end_s,
            "duration_s": self.duration_s,
            "tasks": [asdict(lane) for lane in self.timeline.lanes.values()],
            "timers": [
                {
                    "agent": timer.agent,
                    "task": timer.task,
                    "timer": timer.timer,
                    "rates": [{"asked_hz": at.asked_hz, "achieved_hz": at.achieved_hz} for at in timer.at],
                    "ticks": timer.ticks,
                    "missed": timer.missed,
                    "lateness_mean_s": timer.lateness_mean_s,
                    "lateness_p50_s": timer.lateness_quantile_s(0.5),
                    "lateness_p99_s": timer.lateness_quantile_s(0.99),
                    "lateness_max_s": timer.lateness_max_s,
                }
                for timer in self.rates.timers.values()
            ],
            "dropped": [
                {"agent": drops.agent, "task": drops.task, "packets": drops.total}
                for drops in self.rates.drops.values()
                if drops.total
            ],
            "links": [
                {
                    "link": name,
                    "packets": self.traffic.links.packets.total(name),
                    "bytes": self.traffic.links.bytes.total(name),
                }
                for name in self.traffic.links.names()
            ],
            "lost": [asdict(loss) for loss in self.losses.losses],
            "moves": [move.plain() for move in self.moves.moves],
            "reactions": [
                {
                    "steps": list(it.steps),
                    "count": it.count,
                    "step_means_s": it.step_means_s,
                    **{f"{name}_s": value_s for name, value_s in it.latency_s.quantiles().items()},
                    "max_s": it.latency_s.largest,
                }
                for it in self.reactions.reactions()
            ],
        }
