"""Moves of tasks between agents: the account of each, and how long its parts took. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import msgspec

from pancakes.events import Event
from pancakes.packet import LOG, Packet, agent_of
from pancakes.runtime.foundation import codecs

MOST_MOVES: Final = 500
AWAIT_S: Final = 30.0
"""A task that publishes on its new agent within this time after a hand-over counts as having moved there."""


@dataclass
class NeighbourAnswer:
    """What one neighbour said: see `pancakes.mesh.migration.ledger.Line`."""

    peer: str
    answer: str
    fate: str
    cost: float | None = None
    reason: str = ""


@dataclass
class TaskMove:
    """One move, or one that came to nothing; see `pancakes.mesh.migration.ledger.Ledger`.

    Attributes:
        at_s: when it was over.
        task_id: the task.
        source: where it was.
        asked_by: `rule`, or the address that asked for it.
        cost: the cost function.
        outcome: `moved`, `stayed`, `undecided` or `dry run`.
        winner: the agent that has the task now; empty where it stayed.
        duration_s: host time from the first asking to the outcome.
        answers: what the neighbours said.
        to: the only neighbour that was asked; empty: all were.
        frozen_s: when the task stood still at its source; None where that was not recorded.
        started_s: when it ran again at the winner.
        silence_s: between its last packet there and its first here.
    """

    at_s: float
    task_id: str
    source: str
    asked_by: str
    cost: str
    outcome: str
    winner: str
    duration_s: float
    answers: list[NeighbourAnswer]
    to: str = ""
    frozen_s: float | None = None
    started_s: float | None = None
    silence_s: float | None = None

    @property
    def task(self) -> str:
        """The task's name."""
        return self.task_id.rpartition("/")[2]


@dataclass
class Moves:
    """All moves of a recording.

    Attributes:
        moves: them, in the order of time.
        left_out: how many there were beyond those that are kept.
    """

    moves: list[TaskMove] = field(default_factory=list)
    left_out: int = 0
    _frozen_s: dict[tuple[str, str], float] = field(default_factory=dict)
    _arrived_s: dict[tuple[str, str], float] = field(default_factory=dict)
    _spoke: dict[str, tuple[str, float]] = field(default_factory=dict)
    _changes: dict[tuple[str, str, str], tuple[float, float]] = field(default_factory=dict)

    def add(self, agent: str, packet: Packet, t_s: float) -> None:
        """Takes a packet that was seen on an agent."""
        if agent_of(packet.source) != agent:
            return
        if packet.fence is not None:
            self._spoken(agent, packet.fence.task_id, t_s)
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
            self._told(body.fields, t_s)

    def _spoken(self, agent: str, task_id: str, t_s: float) -> None:
        before = self._spoke.get(task_id)
        self._spoke[task_id] = (agent, t_s)
        if before is None or before[0] == agent:
            return
        self._changes[task_id, before[0], agent] = (t_s, t_s - before[1])
        for move in reversed(self.moves[-20:]):
            if (move.task_id, move.source, move.winner) == (task_id, before[0], agent) and move.silence_s is None:
                move.silence_s = t_s - before[1]
                return

    def _settle(self, agent: str, task: str, t_s: float) -> None:
        """A task runs. Its move may be known already, because each of the two agents reports it."""
        for move in reversed(self.moves[-20:]):
            awaited = (move.task, move.winner, move.outcome) == (task, agent, "moved") and move.started_s is None
            if awaited and t_s - move.at_s < AWAIT_S:
                move.started_s = t_s
                return

    def _told(self, fields: Mapping[str, Any], t_s: float) -> None:
        if len(self.moves) >= MOST_MOVES:
            self.left_out += 1
            return
        try:
            move = codecs.convert({**fields, "at_s": t_s, "answers": fields.get("lines", ())}, TaskMove)
        except msgspec.ValidationError:
            return  # an event of a user's own that bears the same name
        self.moves.append(move)
        if move.outcome != "moved":
            return
        frozen_s = self._frozen_s.pop((move.source, move.task), None)
        move.frozen_s = frozen_s
        started_s = self._arrived_s.get((move.winner, move.task))
        if started_s is not None and frozen_s is not None and started_s >= frozen_s:
            move.started_s = started_s
        change = self._changes.pop((move.task_id, move.source, move.winner), None)
        if change is not None and frozen_s is not None and change[0] >= frozen_s:
            move.silence_s = change[1]

    def only(self, task_id: str) -> None:
        """Forgets the moves of all tasks but one."""
        self.moves = [move for move in self.moves if move.task_id == task_id]
