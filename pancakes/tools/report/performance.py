"""Measure how agents performed: rates, lateness and drops from sampled figures; traffic by link and channel. Pure."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Final

from pancakes.errors import LocalProtocolError
from pancakes.mesh.codec import encode_packet
from pancakes.packet import NEIGHBOURS, TO_TASK, Packet, agent_of
from pancakes.recording.task_statistics import OneLink, OneTask, TaskFigures, TimerFigures, quantile_s
from pancakes.tools.report.time_series import Counts, TimeSeries


@dataclass
class AtRate:
    """The ticks of a timer while one rate was requested, and the mission time that this took."""

    asked_hz: float
    ticks: int = 0
    during_s: float = 0.0

    @property
    def achieved_hz(self) -> float | None:
        """Ticks per second; None if the time was too short to measure it."""
        return self.ticks / self.during_s if self.during_s * self.asked_hz >= 3.0 else None


@dataclass
class TimerRates:
    """A time-driven method of a task on one agent.

    Attributes:
        agent: the agent.
        task: the task, as `service/task`.
        task_id: its identity for life; empty if it cannot migrate.
        timer: the method.
        at: its ticks at each requested rate, in the order of time.
        ticks: how often it was called.
        missed: ticks that were skipped.
        lateness_sum_s: the sum over all ticks, in mission time.
        lateness_max_s: the largest lateness, in mission time.
        lateness: over time, the mean of the ticks since the sample before, in seconds.
        lateness_counts: how many ticks were how late, by the number of the bucket (see `latenesses.bucket_of`); empty
            if this was not recorded.
    """

    agent: str
    task: str
    task_id: str
    timer: str
    at: list[AtRate] = field(default_factory=list)
    ticks: int = 0
    missed: int = 0
    lateness_sum_s: float = 0.0
    lateness_max_s: float = 0.0
    lateness: TimeSeries = field(default_factory=TimeSeries)
    lateness_counts: dict[int, int] = field(default_factory=dict)
    _before: tuple[float, int, TimerFigures] | None = None

    @property
    def lateness_mean_s(self) -> float:
        """The mean of all ticks."""
        return self.lateness_sum_s / self.ticks if self.ticks else 0.0

    def lateness_quantile_s(self, share: float) -> float | None:
        """Return a quantile of the lateness, accurate to 10 %; None: no tick was counted."""
        return quantile_s(self.lateness_counts, share)

    def add(self, t_s: float, mission_s: float, incarnation: int, now: TimerFigures) -> None:
        """Take a sample."""
        for bucket, count in now.lateness_counts:
            self.lateness_counts[bucket] = self.lateness_counts.get(bucket, 0) + count
        before, self._before = self._before, (mission_s, incarnation, now)
        # Ticks before the recording began do not count. The largest lateness may be from before: its time is unknown.
        # If mission time has gone back, the agent was restarted, and all its counters began at 0 again.
        if before is not None and (mission_s < before[0] or before[1] != incarnation or now.ticks < before[2].ticks):
            before = (mission_s, incarnation, TimerFigures(now.timer, now.rate_hz, 0, 0, 0.0, 0.0))
        if before is None:
            return
        since_s, _, was = before
        ticks, late_s = now.ticks - was.ticks, now.lateness_sum_s - was.lateness_sum_s
        self.ticks += ticks
        self.missed += now.missed - was.missed
        self.lateness_sum_s += late_s
        self.lateness_max_s = max(self.lateness_max_s, now.lateness_max_s)
        if ticks > 0:
            self.lateness.add(t_s, late_s / ticks)
        if now.rate_hz > 0 and mission_s > since_s and was.rate_hz == now.rate_hz:
            if not self.at or self.at[-1].asked_hz != now.rate_hz:
                self.at.append(AtRate(now.rate_hz))
            self.at[-1].ticks += ticks
            self.at[-1].during_s += mission_s - since_s


@dataclass
class Drops:
    """Packets dropped from a task's mailbox on one agent: the total, and the count over time."""

    agent: str
    task: str
    total: int = 0
    over_time: TimeSeries = field(default_factory=TimeSeries)
    _before: int | None = None

    def add(self, t_s: float, dropped: int) -> None:
        """Take a sample; a mailbox outlives the actors of its task."""
        if self._before is not None:
            self.total += max(0, dropped - self._before)
        self._before = dropped
        self.over_time.add(t_s, self.total)


@dataclass
class Rates:
    """The figures of tasks and links.

    Attributes:
        samples: how many samples the recording has.
        timers: the timers, by agent, task and timer.
        drops: the dropped packets, by agent and task.
        links: the newest figures of each link, by the agent that counts and its peer.
        undelivered: packets that no subscriber took, by agent.
        dead_letters: packets whose handlers failed, by agent.
    """

    samples: int = 0
    timers: dict[tuple[str, str, str], TimerRates] = field(default_factory=dict)
    drops: dict[tuple[str, str], Drops] = field(default_factory=dict)
    links: dict[tuple[str, str], OneLink] = field(default_factory=dict)
    undelivered: dict[str, int] = field(default_factory=dict)
    dead_letters: dict[str, int] = field(default_factory=dict)

    def name(self, timer: TimerRates) -> str:
        """Return what a timer is called: after its task, and its method too if the task has several timers."""
        several = sum(key[:2] == (timer.agent, timer.task) for key in self.timers) > 1
        return f"{timer.task}.{timer.timer}" if several else timer.task

    def add(self, agent: str, figures: TaskFigures, t_s: float) -> None:
        """Take a sample of an agent."""
        self.samples += 1
        for task in figures.tasks:
            self._add_task(agent, task, figures.mission_s, t_s)
        for link in figures.links:
            self.links[agent, link.peer] = link
        self.undelivered[agent], self.dead_letters[agent] = figures.undelivered, figures.dead_letters

    def _add_task(self, agent: str, task: OneTask, mission_s: float, t_s: float) -> None:
        drops = self.drops.setdefault((agent, task.task), Drops(agent, task.task))
        drops.add(t_s, task.dropped)
        for figures in task.timers:
            if figures.rate_hz <= 0 and not figures.ticks:
                continue  # a driver without readings of its own
            key = (agent, task.task, figures.timer)
            timer = self.timers.setdefault(key, TimerRates(agent, task.task, task.task_id, figures.timer))
            timer.add(t_s, mission_s, task.incarnation, figures)

    def only(self, task_id: str) -> None:
        """Forget all tasks but one, given by its identity for life."""
        self.timers = {key: timer for key, timer in self.timers.items() if timer.task_id == task_id}
        kept = {key[:2] for key in self.timers}
        self.drops = {key: drops for key, drops in self.drops.items() if key in kept}


@dataclass
class Flow:
    """The traffic between agents, or on channels.

    Attributes:
        packets: the number of packets over time, by name.
        bytes: their size on the wire over time, by name.
    """

    packets: Counts = field(default_factory=Counts)
    bytes: Counts = field(default_factory=Counts)

    def add(self, t_s: float, name: str, size: int) -> None:
        """Count a packet."""
        self.packets.add(t_s, name)
        self.bytes.add(t_s, name, size)

    def take(self, other: Flow, name: str) -> None:
        """Add the counts of another flow under a name."""
        for counts, of in ((self.packets, other.packets), (self.bytes, other.bytes)):
            for slot, number in of.slots[name].items():
                counts.add((slot + 0.5) * of.slot_s, name, number)

    def names(self) -> list[str]:
        """Return the names, those with the most bytes first."""
        return sorted(self.packets.slots, key=lambda name: (-self.bytes.total(name), name))


_TERMINAL: Final = re.compile(r"cli-\d+-[0-9a-f]+")


def is_terminal(name: str) -> bool:
    """Return whether a name is that of a terminal or another client: agents have no dot in theirs."""
    return "." in name or _TERMINAL.fullmatch(name) is not None


@dataclass
class Traffic:
    """The packets that travelled between agents.

    A packet may be recorded twice: by its sender and by its receiver. It is counted at the receiver; if the receiver
    was not recorded, at the sender.

    Attributes:
        links: the traffic by link, as `FROM → TO`.
        channels: the traffic by channel, all links together.
        heard: the agents that were recorded.
        terminals: how many packets were from or to terminals; no link or channel counts them.
    """

    links: Flow = field(default_factory=Flow)
    channels: Flow = field(default_factory=Flow)
    heard: set[str] = field(default_factory=set)
    terminals: int = 0
    _leaving: Flow = field(default_factory=Flow)
    _leaving_channels: dict[str, Flow] = field(default_factory=dict)

    def add(self, agent: str, packet: Packet, t_s: float) -> None:
        """Take a packet that was seen on an agent."""
        self.heard.add(agent)
        source, destination = agent_of(packet.source), packet.destination
        if is_terminal(source) or is_terminal(agent_of(destination)):
            self.terminals += 1
        elif source != agent:
            size = self._size(packet)
            self.links.add(t_s, f"{source} → {agent}", size)
            self.channels.add(t_s, packet.channel, size)
        elif destination and not destination.startswith(TO_TASK) and agent_of(destination) != agent:
            to = NEIGHBOURS if destination == NEIGHBOURS else agent_of(destination)
            name = f"{agent} → {to}"
            size = self._size(packet)
            self._leaving.add(t_s, name, size)
            self._leaving_channels.setdefault(name, Flow()).add(t_s, packet.channel, size)

    def _size(self, packet: Packet) -> int:
        try:
            return len(encode_packet(packet))
        except LocalProtocolError:  # if its class is not installed here, a body may have no wire format
            return 0

    def close(self) -> None:
        """End the recording: count packets to agents that were not recorded at their sender."""
        for name in list(self._leaving.packets.slots):
            to = name.rpartition(" → ")[2]
            if to in self.heard or (to == NEIGHBOURS and len(self.heard) > 1):
                continue
            self.links.take(self._leaving, name)
            for channel in self._leaving_channels[name].packets.slots:
                self.channels.take(self._leaving_channels[name], channel)
        self._leaving, self._leaving_channels = Flow(), {}
