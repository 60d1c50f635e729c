"""Collect what happened on a mission: paths of bodies, tasks by agent, migrations, and the log. Pure: packets go in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import msgspec

from pancakes.control import Hold
from pancakes.events import Event, LogLine
from pancakes.migration import MigrationReport
from pancakes.packet import CTRL, LOG, SYSTEM, Packet, agent_of
from pancakes.recording.records import TaskDescription
from pancakes.tools.report.losses import AgentLoss
from pancakes.tools.report.time_series import TimeSeries
from pancakes.util import codecs
from pancakes.util.arrays import without_arrays

POSE, WORLD, BATTERY = "pose", "world_state", "battery"
MOST_BODIES = 64


@dataclass
class Body:
    """Something that has a position.

    Attributes:
        name: its name; for an agent, the agent's name.
        kind: `robot`, `sensor` or `mover`, as the world says; `agent` if only its own poses are known.
        path: time in seconds, x and y in metres, heading in radians.
    """

    name: str
    kind: str
    path: TimeSeries = field(default_factory=TimeSeries)


@dataclass(frozen=True)
class CommandSpan:
    """A time in which one task commanded an agent's actuators; `task` is the task's name."""

    task: str
    from_s: float
    to_s: float


@dataclass
class BodyPaths:
    """The paths, commands and batteries of a recording.

    Attributes:
        truth: the bodies of the world, by name.
        poses: each agent's own estimates of its pose.
        commands: which task commanded the actuators of each agent, and when.
        batteries: the level of each agent's battery, from 0 to 1, over time.
    """

    truth: dict[str, Body] = field(default_factory=dict)
    poses: dict[str, Body] = field(default_factory=dict)
    commands: dict[str, list[CommandSpan]] = field(default_factory=dict)
    batteries: dict[str, TimeSeries] = field(default_factory=dict)

    def add(self, agent: str, packet: Packet, t_s: float) -> None:
        """Take a packet that was seen on an agent."""
        if packet.channel == SYSTEM:
            if packet.type == WORLD:
                self._add_world(packet.body, t_s)
            elif packet.type == POSE and packet.source.startswith(f"{agent}/device/"):
                body = self.poses.setdefault(agent, Body(agent, "agent"))
                body.path.add(t_s, packet.body.x_m, packet.body.y_m, packet.body.theta_rad)
            elif packet.type == BATTERY and packet.source.startswith(f"{agent}/device/"):
                self.batteries.setdefault(agent, TimeSeries()).add(t_s, packet.body.level)
        elif packet.channel == CTRL and not isinstance(packet.body, Hold) and agent_of(packet.source) == agent:
            self._add_command(agent, packet.source.rpartition("/")[2], t_s)

    def _add_world(self, state: Any, t_s: float) -> None:
        for it in state.bodies:
            body = self.truth.get(it.name)
            if body is None:
                if len(self.truth) >= MOST_BODIES:
                    continue
                body = self.truth[it.name] = Body(it.name, it.kind)
            body.path.add(t_s, it.x_m, it.y_m, it.theta_rad)

    def _add_command(self, agent: str, task: str, t_s: float) -> None:
        commands = self.commands.setdefault(agent, [])
        if commands and commands[-1].task == task:
            commands[-1] = CommandSpan(task, commands[-1].from_s, t_s)
        else:
            commands.append(CommandSpan(task, t_s, t_s))

    def bodies(self) -> list[Body]:
        """Return the bodies to draw: those of the world, and agents known only by their own poses."""
        shown = [body for body in self.truth.values() if body.path.kept]
        return shown + [body for name, body in self.poses.items() if name not in self.truth]


LOST, NOT_RECORDED = "lost", "not recorded"
"""How a task ended whose agent was lost, and whose recording began again."""
INNER: Final = ("log", "network", "device")
"""Services whose tasks belong to the agent itself, not to a mission."""
ENDS: Final = {
    "task_stopped": "stopped",
    "task_handed_over": "handed over",
    "task_failed": "failed",
    "task_given_up": "given up",
}


@dataclass
class Span:
    """A time in which a task ran on an agent.

    Attributes:
        from_s: when it began.
        to_s: when it ended, or the recording did.
        epoch: how often the task had migrated before; None if unknown.
        ended: how it ended; empty if it ran until the end of the recording.
    """

    from_s: float
    to_s: float
    epoch: int | None
    ended: str = ""


@dataclass
class TaskLane:
    """A task on one agent.

    Attributes:
        agent: the agent.
        task: the task's name.
        service: its service.
        task_id: its identity for life; empty if unknown.
        spans: when it ran there.
    """

    agent: str
    task: str
    service: str
    task_id: str = ""
    spans: list[Span] = field(default_factory=list)


@dataclass
class TaskTimeline:
    """Which agent ran which task, and when.

    Attributes:
        lanes: the tasks on agents, by agent, service and task.
        seen_s: the time of each agent's last packet.
    """

    lanes: dict[tuple[str, str, str], TaskLane] = field(default_factory=dict)
    seen_s: dict[str, float] = field(default_factory=dict)

    def add(self, agent: str, packet: Packet, t_s: float) -> None:
        """Take a packet that was seen on an agent."""
        before_s, self.seen_s[agent] = self.seen_s.get(agent, t_s), t_s
        body = packet.body
        if isinstance(body, Event) and body.kind == "recording_started" and packet.source == f"{agent}/log/Recorder":
            self._unseen(agent, before_s)
        elif packet.channel == LOG and isinstance(body, Event) and agent_of(packet.source) == agent:
            self._happened(agent, packet.source, body, t_s)
        elif isinstance(body, TaskDescription):
            _, service, task = (*body.address.split("/"), "", "")[:3]
            self._runs(agent, service, task, t_s, body.epoch if body.task_id else None, body.task_id)
        elif packet.fence is not None and packet.source.startswith(agent + "/"):
            parts = packet.source.split("/")
            if len(parts) == 3:
                self._runs(agent, parts[1], parts[2], t_s, packet.fence.epoch[0], packet.fence.task_id)

    def _unseen(self, agent: str, since_s: float) -> None:
        """End the open spans of an agent whose recording begins again: the time in between was not recorded."""
        for lane in self.lanes.values():
            if lane.agent == agent and lane.spans and not lane.spans[-1].ended:
                lane.spans[-1].to_s, lane.spans[-1].ended = since_s, NOT_RECORDED

    def _happened(self, agent: str, source: str, event: Event, t_s: float) -> None:
        fields: Mapping[str, Any] = event.fields
        task = str(fields.get("task", ""))
        service = str(fields.get("service", "")) or (*source.split("/"), "")[1]
        if event.kind == "task_started":
            self._runs(agent, service, task, t_s, fields.get("epoch"), "")
        elif event.kind in ENDS:
            lane = self.lanes.get((agent, service, task))
            if lane is not None and lane.spans and not lane.spans[-1].ended:
                span = lane.spans[-1]
                span.to_s, span.ended = t_s, str(fields.get("reason") or ENDS[event.kind])

    def _runs(self, agent: str, service: str, task: str, t_s: float, epoch: int | None, task_id: str) -> None:
        if service in INNER or not task:
            return
        lane = self.lanes.setdefault((agent, service, task), TaskLane(agent, task, service))
        lane.task_id = lane.task_id or task_id
        open_span = lane.spans[-1] if lane.spans and not lane.spans[-1].ended else None
        if open_span is None and lane.spans and t_s == lane.spans[-1].to_s:
            return  # its last packet, from just before it ended
        if open_span is None:
            lane.spans.append(Span(t_s, t_s, epoch))
        else:
            open_span.to_s = t_s
            open_span.epoch = epoch if epoch is not None else open_span.epoch

    def close(self) -> None:
        """End the recording: tasks that still run are taken to have run until the last packet of their agent."""
        for lane in self.lanes.values():
            if lane.spans and not lane.spans[-1].ended:
                lane.spans[-1].to_s = self.seen_s[lane.agent]

    def lost(self, agent: str, at_s: float) -> None:
        """Note that an agent was lost when its recording ended: so did the tasks that ran there."""
        for lane in self.lanes.values():
            for span in lane.spans:
                if lane.agent == agent and span.to_s == at_s and span.ended in ("", NOT_RECORDED):
                    span.ended = LOST

    def only(self, task_id: str) -> None:
        """Forget all tasks but one, given by its identity for life."""
        name = task_id.rpartition("/")[2]
        self.lanes = {
            key: lane
            for key, lane in self.lanes.items()
            if lane.task_id == task_id or (not lane.task_id and lane.task == name)
        }


MOST_MOVES: Final = 500
AWAIT_S: Final = 30.0
"""How long after a migration the start of the task on its new agent may follow, in seconds of mission time."""


@dataclass
class TaskMove:
    """One migration, or an attempt that failed.

    Attributes:
        at_s: when it ended.
        ledger: which agents were asked, their answers, and the outcome.
        frozen_s: when the task was paused at its source; None if this was not recorded.
        started_s: when it ran again at the winner; None if this was not recorded.
        silence_s: the time between its last packet from the source and its first from the winner.
    """

    at_s: float
    ledger: MigrationReport
    frozen_s: float | None = None
    started_s: float | None = None
    silence_s: float | None = None

    @property
    def outcome(self) -> str:
        """The outcome, for people: of a task that its guardians moved, that it was taken over."""
        taken = self.ledger.outcome == "moved" and self.ledger.asked_by == "guardians"
        return "taken over" if taken else self.ledger.outcome

    @property
    def task(self) -> str:
        """The task's name."""
        return self.ledger.task_id.rpartition("/")[2]

    def goes(self, task_id: str, source: str, winner: str) -> bool:
        """Return whether this is the migration of a task from `source` to `winner`."""
        return (self.ledger.task_id, self.ledger.source, self.ledger.winner) == (task_id, source, winner)

    def plain(self) -> dict[str, Any]:
        """Return it as plain values, with the lines of the ledger as `answers`."""
        ledger = msgspec.to_builtins(self.ledger)
        answers = ledger.pop("lines")
        times = {key: getattr(self, key) for key in ("at_s", "frozen_s", "started_s", "silence_s")}
        return {**ledger, **times, "answers": answers}


@dataclass
class Moves:
    """All migrations of a recording.

    Attributes:
        moves: the migrations, in the order of time.
        left_out: how many more there were than are kept.
    """

    moves: list[TaskMove] = field(default_factory=list)
    left_out: int = 0
    _frozen_s: dict[tuple[str, str], float] = field(default_factory=dict)
    _arrived_s: dict[tuple[str, str], float] = field(default_factory=dict)
    _last_packet: dict[str, tuple[str, float]] = field(default_factory=dict)
    _changes: dict[tuple[str, str, str], tuple[float, float]] = field(default_factory=dict)

    def add(self, agent: str, packet: Packet, t_s: float) -> None:
        """Take a packet that was seen on an agent."""
        if agent_of(packet.source) != agent:
            return
        if packet.fence is not None:
            self._note_packet(agent, packet.fence.task_id, t_s)
        body = packet.body
        if packet.channel != LOG or not isinstance(body, Event):
            return
        task = str(body.fields.get("task", ""))
        if body.kind == "task_frozen":
            self._frozen_s[agent, task] = t_s
        elif body.kind == "task_started":
            self._arrived_s[agent, task] = t_s
            self._settle(agent, task, t_s)
        elif body.kind == "migration":
            self._note_migration(body.fields, t_s)

    def _note_packet(self, agent: str, task_id: str, t_s: float) -> None:
        before = self._last_packet.get(task_id)
        self._last_packet[task_id] = (agent, t_s)
        if before is None or before[0] == agent:
            return
        self._changes[task_id, before[0], agent] = (t_s, t_s - before[1])
        for move in reversed(self.moves[-20:]):
            if move.goes(task_id, before[0], agent) and move.silence_s is None:
                move.silence_s = t_s - before[1]
                return

    def _settle(self, agent: str, task: str, t_s: float) -> None:
        """Note that a task has started. Its migration may be known already, as both agents report it."""
        for move in reversed(self.moves[-20:]):
            awaited = (move.task, move.ledger.winner) == (task, agent) and move.ledger.outcome == "moved"
            if awaited and move.started_s is None and t_s - move.at_s < AWAIT_S:
                move.started_s = t_s
                return

    def _note_migration(self, fields: Mapping[str, Any], t_s: float) -> None:
        if len(self.moves) >= MOST_MOVES:
            self.left_out += 1
            return
        try:
            move = TaskMove(t_s, codecs.convert(fields, MigrationReport))
        except msgspec.ValidationError:
            return  # a user's event with the same name
        self.moves.append(move)
        ledger = move.ledger
        if ledger.outcome != "moved":
            return
        frozen_s = self._frozen_s.pop((ledger.source, move.task), None)
        move.frozen_s = frozen_s
        started_s = self._arrived_s.get((ledger.winner, move.task))
        if started_s is not None and frozen_s is not None and started_s >= frozen_s:
            move.started_s = started_s
        change = self._changes.pop((ledger.task_id, ledger.source, ledger.winner), None)
        if change is not None and frozen_s is not None and change[0] >= frozen_s:
            move.silence_s = change[1]

    def only(self, task_id: str) -> None:
        """Forget the migrations of all tasks except one."""
        self.moves = [move for move in self.moves if move.ledger.task_id == task_id]


MOST: Final = 300
"""The most different entries of each list."""
LONGEST: Final = 300
GRAVE: Final = (
    "task_failed",
    "task_given_up",
    "task_stuck",
    "service_failed",
    "handoff_failed",
    "command_refused",
    "recording_stopped",
)
"""Events about failures."""
USUAL: Final = (
    "ready",
    "asked",
    "task_started",
    "task_stopped",
    "task_arrived",
    "task_frozen",
    "task_resumed",
    "task_handed_over",
    "service_started",
    "service_stopped",
    "migration",
    "migration_asked",
    "migration_bid",
    "migration_refused",
    "recording_started",
)
"""Events that other parts of the report show, or that say little."""


@dataclass
class DigestEntry:
    """A log entry, which may occur several times with the same text.

    Attributes:
        t_s: when it first occurred.
        agent: the agent that logged it.
        kind: `warning`, `error`, or the event's kind.
        text: its text.
        count: how often it occurred.
    """

    t_s: float
    agent: str
    kind: str
    text: str
    count: int = 1


@dataclass
class EventDigest:
    """The entries on `log`, grouped by text.

    Attributes:
        grave: warnings, errors and failures.
        events: the mission's own events.
        left_out: how many more different entries there were than are kept.
    """

    grave: list[DigestEntry] = field(default_factory=list)
    events: list[DigestEntry] = field(default_factory=list)
    left_out: int = 0
    _known: dict[tuple[str, str, str], DigestEntry] = field(default_factory=dict)

    def add(self, agent: str, packet: Packet, t_s: float) -> None:
        """Take a packet that was seen on an agent."""
        if packet.channel != LOG or agent_of(packet.source) != agent:
            return
        body = packet.body
        if isinstance(body, LogLine) and body.level in ("warning", "error"):
            self._note(self.grave, t_s, agent, body.level, body.text)
        elif isinstance(body, Event) and body.kind in GRAVE:
            self._note(self.grave, t_s, agent, body.kind, _text(body.fields))
        elif isinstance(body, Event) and body.kind not in USUAL:
            self._note(self.events, t_s, agent, body.kind, _text(body.fields))

    def lost(self, loss: AgentLoss) -> None:
        """Note that an agent was lost."""
        self._note(self.grave, loss.at_s, loss.agent, "agent_lost", loss.noticed)

    def _note(self, into: list[DigestEntry], t_s: float, agent: str, kind: str, text: str) -> None:
        text = text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"
        known = self._known.get((agent, kind, text))
        if known is not None:
            known.count += 1
        elif len(into) >= MOST:
            self.left_out += 1
        else:
            entry = self._known[agent, kind, text] = DigestEntry(t_s, agent, kind, text)
            into.append(entry)


def _text(fields: Any) -> str:
    plain: dict[str, Any] = msgspec.to_builtins(without_arrays(fields))
    return ", ".join(f"{key} {_short(value)}" for key, value in plain.items() if value not in ("", None, {}, []))


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
