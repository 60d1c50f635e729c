"""Read from a recording what a task received and published between its start and its end on one agent. Pure.

A `Stay` is the time that a task spent on one agent. `read_script` collects its packets, changes and ticks. A recording
does not contain which packets were dropped from the mailbox: `Overtaken` infers that.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from msgspec.structs import asdict, replace

from pancakes.durable.delivery import Letter
from pancakes.errors import RemoteProtocolError
from pancakes.events import Event
from pancakes.kernel.handlers import Tick, subscriptions_of
from pancakes.packet import LOG, NEIGHBOURS, TO_TASK, Cause, Packet, agent_of, covers
from pancakes.recording.message_format import packet_from_bytes
from pancakes.recording.records import CHANNEL, NANOSECONDS, RecordedPacket, RecordingError, TaskDescription
from pancakes.recording.task_statistics import NEAR_S, TaskTicks, TickRun
from pancakes.task import Task
from pancakes.util.arrays import alike
from pancakes.util.text import did_you_mean

CHANGES: Final = ("rate_changed", "settings_changed", "task_frozen", "task_resumed")
"""The events of a service about changes of a running task."""


@dataclass(frozen=True, slots=True)
class Given:
    """A packet that the task received.

    Attributes:
        time_s: mission time at which it was handled, if its effects show that; otherwise when it was published.
        published_s: mission time at which it was published on the task's agent.
        packet: the packet.
        letter: whether it was a letter: addressed to the task on any agent, without a subscription.
    """

    time_s: float
    published_s: float
    packet: Packet
    letter: bool


@dataclass(frozen=True, slots=True)
class Change:
    """A change of the task.

    Attributes:
        time_s: mission time.
        event: the event about it; one of `CHANGES`.
    """

    time_s: float
    event: Event


STOPPED: Final = "stopped"
FAILED: Final = "failed"
ENDS: Final = {"task_stopped": STOPPED, "task_failed": FAILED}
"""The events of a service about the end of a task, and how the task ended."""


@dataclass
class Stay:
    """The time that one actor of a task spent on one agent, from its start or the beginning of the recording.

    Attributes:
        agent: the agent.
        task: the description of the task at the beginning.
        from_ns: when the stay began, in recording time.
        to_ns: when the stay or the recording ended.
        end: `stopped`, `failed`, or empty if the recording ended first.
        reason: why the stay ended.
    """

    agent: str
    task: TaskDescription
    from_ns: int
    to_ns: int
    end: str = ""
    reason: str = ""

    @property
    def task_id(self) -> str:
        """The task's identity for life, or its address if it has none."""
        return self.task.task_id or self.task.address

    @property
    def whole(self) -> bool:
        """Whether the recording contains its start."""
        return self.task.began is not None

    @property
    def begins_s(self) -> float:
        """The mission time at which it began."""
        return float(self.task.began["mission_s"]) if self.task.began is not None else self.task.mission_s

    @property
    def service(self) -> str:
        """The address of the task's service."""
        return self.task.address.rpartition("/")[0]

    @property
    def name(self) -> str:
        """The task's name."""
        return self.task.address.rpartition("/")[2]


def find_stays(entries: Iterable[RecordedPacket]) -> list[Stay]:
    """Return all stays in a recording, in the order in which they began.

    Args:
        entries: the recording, in the order of time.
    """
    found: list[Stay] = []
    open_: dict[str, Stay] = {}  # by the task's address, which names its agent
    last_ns: dict[str, int] = {}

    def close(stay: Stay, to_ns: int, end: str = "", reason: str = "") -> None:
        stay.to_ns, stay.end, stay.reason = to_ns, end, reason
        del open_[stay.task.address]

    for entry in entries:
        body = entry.packet.body
        if isinstance(body, TaskDescription):
            before = open_.get(body.address)
            from_ns = body.began["time_ns"] if body.began is not None else body.time_ns
            if before is not None:
                close(before, from_ns)
            stay = open_[body.address] = Stay(entry.agent, body, from_ns, from_ns)
            found.append(stay)
        elif entry.packet.channel == LOG and isinstance(body, Event):
            if body.kind == "recording_started" and entry.packet.source == f"{entry.agent}/log/Recorder":
                # Another recording of this agent begins: the time between the two was not recorded.
                for stay in [stay for stay in open_.values() if stay.agent == entry.agent]:
                    close(stay, last_ns[entry.agent])
            ended = open_.get(f"{entry.packet.source}/{body.fields.get('task')}")
            if ended is not None and body.kind in ENDS:
                reason = str(body.fields.get("error") or body.fields.get("reason") or "")
                close(ended, entry.time_ns, ENDS[body.kind], reason)
        last_ns[entry.agent] = entry.time_ns
    for stay in list(open_.values()):
        close(stay, max(last_ns[stay.agent], stay.from_ns))
    return sorted(found, key=lambda stay: (stay.from_ns, stay.task.address))


def choose_stays(stays: Sequence[Stay], task: str, agent: str = "", number: int | None = None) -> list[Stay]:
    """Return the stays of one task.

    Args:
        stays: all stays in a recording.
        task: the task's identity for life (`birthplace/name`), its address (`agent/service/name`), or its name if only
            one task has that name.
        agent: only stays on this agent; empty: on any.
        number: only the stay with this number, from 1; None: all.

    Raises:
        RecordingError: no such task or no such stay exists, or `task` fits several.
    """
    if not stays:
        raise RecordingError(
            "the recording has no descriptions of tasks: record with pancakes record start without --channel and"
            " --type, or with --task"
        )
    known = list(dict.fromkeys(stay.task_id for stay in stays))
    meant = list(dict.fromkeys(stay.task_id for stay in stays if task in (stay.task_id, stay.task.address)))
    meant = meant or [task_id for task_id in known if task_id.rpartition("/")[2] == task]
    if not meant:
        names = [*known, *(task_id.rpartition("/")[2] for task_id in known)]
        hint = did_you_mean(task, names, otherwise=f", only {', '.join(known)}")
        raise RecordingError(f"the recording has no task {task!r}{hint}")
    if len(meant) > 1:
        raise RecordingError(f"the recording has several tasks {task!r}: choose {' or '.join(meant)}")
    all_stays = [stay for stay in stays if stay.task_id == meant[0]]
    chosen = [stay for stay in all_stays if agent in ("", stay.agent)]
    if not chosen:
        agents = ", ".join(dict.fromkeys(stay.agent for stay in all_stays))
        raise RecordingError(f"{meant[0]} was never on {agent!r} in the recording, only on {agents}")
    if number is None:
        return chosen
    if number > len(chosen):
        stayed = f"{len(chosen)} stays" if len(chosen) > 1 else "one stay"
        raise RecordingError(f"{meant[0]} has only {stayed} in the recording" + (f" on {agent}" if agent else ""))
    return [chosen[number - 1]]


class Overtaken:
    """Infer which packets were dropped from the mailbox before the task handled them. A recording does not contain it.

    Args:
        steps: the packets that arrived, and the changes.
        limits: how many packets of a type on a channel can wait.
        handled: packets that had an effect, and so were certainly handled.
        close_s: within this mission time, a task may not get a turn.
    """

    def __init__(
        self,
        steps: Iterable[Given | Change],
        limits: Mapping[tuple[str, str], int],
        handled: Collection[Cause],
        close_s: float,
    ) -> None:
        self._limits = limits
        self._handled = handled
        self._close_s = close_s
        self._given: dict[tuple[str, str], list[Given]] = {}
        self._number: dict[int, int] = {}
        for step in steps:
            if isinstance(step, Given) and not step.letter:
                alike = self._given.setdefault((step.packet.channel, step.packet.type), [])
                self._number[id(step)] = len(alike)
                alike.append(step)

    def was_dropped(self, step: Given | Change) -> bool:
        """Return whether a packet was dropped because newer packets of its type took its place."""
        if not isinstance(step, Given) or step.letter or self._is_handled(step):
            return False
        key = (step.packet.channel, step.packet.type)
        limit = self._limits.get(key)
        last = self._number[id(step)] + (limit or 0)
        if limit is None or last >= len(self._given[key]):
            return False
        newer = self._given[key][last]
        if newer.published_s < step.time_s:
            return True  # the task was still busy when the newer packet arrived
        # Several packets arrived at once from one source, and only the last had an effect.
        while limit == 1 and newer.packet.source == step.packet.source and self._at_once(step, newer):
            if self._is_handled(newer):
                return True
            last += 1
            if last >= len(self._given[key]):
                break
            step, newer = newer, self._given[key][last]
        return False

    def came_late(self, step: Given | Change, end_s: float) -> bool:
        """Return whether a packet came too late: the task may have ended before it could handle it."""
        return isinstance(step, Given) and step.published_s > end_s and not self._is_handled(step)

    def _at_once(self, one: Given, other: Given) -> bool:
        return other.published_s - one.published_s <= self._close_s

    def _is_handled(self, given: Given) -> bool:
        return (given.packet.source, given.packet.seq) in self._handled


UNKNOWN_TICKS: Final = (
    "the recording does not contain which ticks ran: packets of ticks that were missed or late then may differ"
)


class RanTicks:
    """The ticks of one timer that ran.

    Args:
        period_s: the period in the task's description.
        runs: the ticks that ran.
        complete: whether these are all ticks up to the end of the stay.
    """

    def __init__(self, period_s: float, runs: Iterable[TickRun], complete: bool) -> None:
        self._period_s = period_s
        self._runs = sorted(runs, key=lambda run: run.first_s)
        self._firsts_s = [run.first_s - NEAR_S for run in self._runs]
        self._complete = complete

    def tick_at(self, deadline_s: float, period_s: float) -> Tick | None:
        """Return a tick as the task got it then, with its lateness if it was late; None: it did not run.

        A tick that the recording cannot know of counts as one that ran: if the timer had another period then, or the
        recording ended before.
        """
        after = bisect_right(self._firsts_s, deadline_s)
        if after:
            run = self._runs[after - 1]
            number = round((deadline_s - run.first_s) / run.period_s) if run.period_s else 0
            if number < run.count and abs(run.first_s + number * run.period_s - deadline_s) < NEAR_S:
                return Tick(deadline_s) if number else Tick(deadline_s, run.missed, run.lateness_s)
        if after == len(self._runs) and not self._complete:
            return Tick(deadline_s)
        periods_s = [run.period_s for run in self._runs[max(0, after - 1) : after + 1]] or [self._period_s]
        return None if any(math.isclose(period_s, then_s) for then_s in periods_s) else Tick(deadline_s)


class TicksReader:
    """Collect the recorded ticks of a stay."""

    def __init__(self, stay: Stay) -> None:
        self._stay = stay
        self._runs: dict[str, list[TickRun]] = {}
        self._number = 0
        self._has_ticks = False
        self._has_gaps = False
        self._complete = False
        self._over = False

    def take(self, entry: RecordedPacket) -> None:
        """Take an entry of the recording; in the order of time."""
        stay, packet = self._stay, entry.packet
        if self._over or entry.agent != stay.agent:
            return
        if isinstance(packet.body, TaskTicks):
            self._take_ticks(entry.time_ns, packet.body)
        elif isinstance(packet.body, Event) and packet.body.kind == "recording_started":
            if packet.source == f"{stay.agent}/log/Recorder":  # another recording
                self._number = 0
                self._over = entry.time_ns >= stay.to_ns

    def _take_ticks(self, time_ns: int, ticks: TaskTicks) -> None:
        stay = self._stay
        follows, self._number = ticks.number == self._number + 1, ticks.number
        if time_ns <= stay.from_ns or (time_ns > stay.to_ns and not stay.end):
            return
        self._has_ticks = True
        self._has_gaps |= not follows
        for timer in ticks.timers:
            if timer.address == stay.task.address:
                self._runs.setdefault(timer.timer, []).extend(TickRun(*run) for run in timer.runs)
        # If the recording ends before the task does, its last entry is this one, written after all others.
        self._complete = self._over = time_ns >= stay.to_ns

    def ticks(self) -> dict[str, RanTicks] | None:
        """Return the ticks that ran, by timer; None: unknown."""
        if not self._has_ticks or self._has_gaps:
            return None
        periods_s = {it["timer"]: 1.0 / it["rate_hz"] if it["rate_hz"] else math.inf for it in self._stay.task.timers}
        return {
            timer: RanTicks(period_s, self._runs.get(timer, ()), self._complete)
            for timer, period_s in periods_s.items()
        }


CLOSE_S: Final = 0.005
"""Within this time, a task may not get a turn, in seconds of host time."""
END_S: Final = 0.05
"""A task may have ended this much earlier than its service reports, in seconds of host time."""
_LINGERING_NS: Final = 5 * NANOSECONDS
"""A packet that arrived at most this long before a stay may have its effect in the stay."""


@dataclass
class Script:
    """Everything that a task received and published during a stay.

    Attributes:
        steps: the packets that it received and its changes, in order.
        outputs: the packets that it published, in order.
        end_s: the mission time at which the stay ended.
        channels: the channels with packets on its agent.
        spontaneous_s: for each packet without a cause, such as from a tick: when it was published, and when the packet
            before it was published; in order, in mission time.
        superseded: how many packets `steps` lacks, because a newer one replaced them in the mailbox, or the task ended
            before it handled them.
        speed: mission seconds per second of host time then.
        ticks: which ticks ran, by timer; None: all of them, or unknown.
        notes: sentences about what the recording lacks.
    """

    steps: list[Given | Change] = field(default_factory=list)
    outputs: list[Packet] = field(default_factory=list)
    end_s: float = 0.0
    channels: list[str] = field(default_factory=list)
    spontaneous_s: list[tuple[float, float]] = field(default_factory=list)
    superseded: int = 0
    speed: float = 1.0
    ticks: dict[str, RanTicks] | None = None
    notes: list[str] = field(default_factory=list)


def read_script(
    entries: Iterable[RecordedPacket], stay: Stay, cls: type[Task], speed: float = 1.0, virtual: bool = False
) -> Script:
    """Read what a task received and published during a stay.

    Args:
        entries: the recording, in the order of time.
        stay: the stay.
        cls: the present class of the task: its subscriptions are used in addition to the recorded ones.
        speed: mission seconds per second of the recording.
        virtual: whether the recording is from virtual time, in which handlers take no time.
    """
    reader = _StayReader(stay, cls)
    seen = [entry for entry in entries if reader.take(entry)]
    times = _MissionTimes(stay, speed, seen)
    script = Script(channels=list(reader.channels), speed=speed)
    script.outputs = [entry.packet for entry in seen if reader.is_output(entry.packet) and not reader.lingers(entry)]
    handled_s: dict[Cause, float] = {}
    for packet in script.outputs:
        if packet.cause is not None:
            handled_s.setdefault((packet.cause[0], packet.cause[1]), packet.stamp_s)
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
            script.spontaneous_s.append((packet.stamp_s, before_s))
        before_s = packet.stamp_s
    script.end_s = max(now_s, times.end_s)
    overtaken = Overtaken(steps, reader.limits, handled_s, 0.0 if virtual else CLOSE_S * speed)
    end_s = times.end_s - END_S * speed if stay.end and not virtual else math.inf
    script.steps = [step for step in steps if not overtaken.was_dropped(step) and not overtaken.came_late(step, end_s)]
    script.superseded = len(steps) - len(script.steps)
    script.ticks = reader.ticks.ticks()
    if script.ticks is None and stay.task.timers and not virtual:
        script.notes.append(UNKNOWN_TICKS)
    return script


class _StayReader:
    """Recognize the entries of a recording that belong to a stay."""

    def __init__(self, stay: Stay, cls: type[Task]) -> None:
        self._stay = stay
        self._address = stay.task.address
        subscriptions = [subscription for subscription, _ in subscriptions_of(cls)]
        self._wants = {(subscription.channel, subscription.type) for subscription in subscriptions}
        self.limits = {
            (it.channel, it.type): it.queue.limit
            for it in subscriptions
            if it.type is not None and not it.queue.reliable
        }
        self.channels: dict[str, None] = {}
        self.ticks = TicksReader(stay)
        self._letters: dict[Cause, None] = {}
        self._before: dict[Cause, None] = {}
        self._lives = False
        self._over = False

    def take(self, entry: RecordedPacket) -> bool:
        """Return whether an entry is an input, an output or a change of the stay; in the order of time."""
        stay, packet = self._stay, entry.packet
        self.ticks.take(entry)
        if not self._lives and isinstance(packet.body, TaskDescription):
            self._lives = alike(asdict(packet.body), asdict(stay.task))
        if self._over or entry.agent != stay.agent or entry.time_ns > stay.to_ns or packet.channel == CHANNEL:
            return False
        # In virtual time, its successor may start at the same moment.
        self._over = bool(stay.end) and entry.time_ns == stay.to_ns and self._is_task_event(packet, ENDS)
        if entry.time_ns < stay.from_ns or (entry.time_ns == stay.from_ns and not self._begun(entry)):
            if not stay.whole and entry.time_ns >= stay.from_ns - _LINGERING_NS:
                self._before[packet.source, packet.seq] = None
            return False
        self.channels[packet.channel] = None
        return self.is_output(packet) or self.is_change(packet) or self._is_input(packet)

    def _begun(self, entry: RecordedPacket) -> bool:
        """Return whether the stay has already begun, for an entry at the very moment of its beginning.

        In virtual time, other entries before and after the beginning have the same time. The stay has begun once the
        task has published something, its service has reported the start, or the task has been described.
        """
        if self._stay.whole and not self._lives:
            self._lives = self.is_output(entry.packet) or self._is_task_event(entry.packet, ("task_started",))
        return self._lives

    def is_output(self, packet: Packet) -> bool:
        """Return whether the task published a packet."""
        return packet.source == self._address

    def lingers(self, entry: RecordedPacket) -> bool:
        """Return whether a packet was caused by one from before the stay."""
        cause = entry.packet.cause
        return cause is not None and (cause[0], cause[1]) in self._before

    def is_change(self, packet: Packet) -> bool:
        """Return whether a packet is an event about a change of the task."""
        return self._is_task_event(packet, CHANGES)

    def _is_task_event(self, packet: Packet, kinds: Collection[str]) -> bool:
        """Return whether a packet is one of these events, about the task."""
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
        """Return the letter to this task that a packet is or contains; None: neither."""
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
        """Yield the packet as the task got it, and whether it was a letter; skip a letter that came before."""
        letter = self._letter_of(packet)
        if letter is None:
            yield packet, False
        elif (letter.source, letter.seq) not in self._letters:
            self._letters[letter.source, letter.seq] = None
            yield replace(letter, destination=self._address), True


class _MissionTimes:
    """Convert recording time to the mission time of a stay's agent."""

    def __init__(self, stay: Stay, speed: float, entries: Iterable[RecordedPacket]) -> None:
        self._stay = stay
        self._speed = speed
        own = [(entry.packet.stamp_s, entry.time_ns) for entry in entries if self._is_own(entry.packet)]
        # A packet has the mission time of its publication as stamp, and is recorded at that moment or a little later.
        offsets = [stamp - self._elapsed_s(time_ns) for stamp, time_ns in own if stamp > 0.0]
        # While a mission is held, all stamps are 0 and cannot be compared.
        self._offset_s = max(offsets, default=stay.begins_s)
        self.end_s = max(self._of_ns(stay.to_ns), stay.begins_s)

    def of(self, entry: RecordedPacket) -> float:
        """Return the mission time at which an entry was recorded."""
        return entry.packet.stamp_s if self._is_own(entry.packet) else self._of_ns(entry.time_ns)

    def _is_own(self, packet: Packet) -> bool:
        return agent_of(packet.source) == self._stay.agent

    def _of_ns(self, time_ns: int) -> float:
        return max(0.0, self._offset_s + self._elapsed_s(time_ns))

    def _elapsed_s(self, time_ns: int) -> float:
        return (time_ns - self._stay.from_ns) / NANOSECONDS * self._speed
