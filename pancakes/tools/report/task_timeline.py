"""Which agent ran which task and when: from the events of services, and from the packets of tasks. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from pancakes.events import Event
from pancakes.packet import LOG, Packet, agent_of
from pancakes.tools.recording.description import TaskDescription

INNER: Final = ("log", "network", "device")
"""Services whose tasks belong to the agent itself, and to no mission."""
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
        epoch: how often it had been handed over; None where that is not known.
        ended: how it ended; empty where it ran to the end.
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
        task_id: its identity for life; empty where it is not known.
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
        seen_s: when something was last seen of each agent.
    """

    lanes: dict[tuple[str, str, str], TaskLane] = field(default_factory=dict)
    seen_s: dict[str, float] = field(default_factory=dict)

    def add(self, agent: str, packet: Packet, t_s: float) -> None:
        """Takes a packet that was seen on an agent."""
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
        """Another recording of an agent begins, or one goes on: what was between, such as a crash, was seen by none."""
        for lane in self.lanes.values():
            if lane.agent == agent and lane.spans and not lane.spans[-1].ended:
                lane.spans[-1].to_s, lane.spans[-1].ended = since_s, "not recorded"

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
            return  # what it said as it ended
        if open_span is None:
            lane.spans.append(Span(t_s, t_s, epoch))
        else:
            open_span.to_s = t_s
            open_span.epoch = epoch if epoch is not None else open_span.epoch

    def close(self) -> None:
        """The recording has ended: what still ran did so as long as its agent was seen."""
        for lane in self.lanes.values():
            if lane.spans and not lane.spans[-1].ended:
                lane.spans[-1].to_s = self.seen_s[lane.agent]

    def only(self, task_id: str) -> None:
        """Forgets all tasks but one, given by its identity for life."""
        name = task_id.rpartition("/")[2]
        self.lanes = {
            key: lane
            for key, lane in self.lanes.items()
            if lane.task_id == task_id or (not lane.task_id and lane.task == name)
        }
