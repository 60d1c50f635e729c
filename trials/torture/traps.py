"""Kill a real agent at a named point, found by watching the packets between agents and their files."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from torture.gates import Gate, RecordWatch, WriteGate, file_number, identity_file
from torture.points import Point
from torture.proxy import Verdict
from torture.waits import Waits

from pancakes.durable.record import TaskId
from pancakes.packet import agent_of

LOOK_S = 0.0005
"""How often files are checked for changes, in seconds."""
GATE_S = 0.002
"""How often to check whether the victim has removed a gate, in seconds."""
_never = threading.Event()


@dataclass(frozen=True)
class Field:
    """The files and functions that a trap needs.

    Attributes:
        task_id: the task of the hand-off.
        state: the directory with the agents' state directories, by their names.
        gates: the directory in which the task looks for gates.
        kill: kills an agent, at once.
        waits: the waits of a trap for its victim.
    """

    task_id: TaskId
    state: Path
    gates: Path
    kill: Callable[[str], None]
    waits: Waits = field(default_factory=Waits)


class Trap:
    """Kills one agent at one point.

    Args:
        point: the point.
        field: its files and functions.
        victim: the agent to kill, if the point does not determine it.

    Attributes:
        no_disk_s: how long its gate has kept the victim from writing.
    """

    def __init__(self, point: Point, field: Field, victim: str = "") -> None:
        self.point = point
        self._field = field
        self._victim = victim
        self._lock = threading.Lock()
        self._set = threading.Event()  # the victim is known, and dead or about to come to the gate
        self._dead = ""
        self._gave = ""  # the agent that has promised the task last
        self._gate: Gate | None = None
        self._record: RecordWatch | None = None
        self._laid_s = 0.0
        self.no_disk_s = 0.0

    def begin(self, start: Callable[[str], None] | None = None) -> None:
        """Lay the trap at once, if its point begins with no packet.

        Args:
            start: starts the victim, which is dead; None: it runs.

        Raises:
            InterruptedError: its waits were broken off.
        """
        victim = self._victim
        identity = identity_file(self._field.state, victim) if victim else Path()
        boot = file_number(identity)
        gated = self.point.how in ("start", "resume")
        if gated and not self.point.word:
            self._lay(victim)
        if start is not None:
            start(victim)
            # An agent opens and cleans its journal before it reads its tasks.
            if not gated and not self.point.word:
                self._field.waits.until(lambda for_s: _is_replaced(identity, boot), math.inf)
        if not gated and not self.point.word:
            self._lay(victim)

    def watch(self, row: list[Any]) -> Verdict:
        """Watch a packet between two agents, and return what to do with it. Any thread."""
        sender, receiver = agent_of(row[2]), agent_of(row[3])
        with self._lock:
            if sender == self._dead:
                return Verdict.END
            if not self._concerns(row):
                return Verdict.PASS
            kind, point = row[1], self.point
            if kind == "task.promise":
                self._gave = sender
            lost = Verdict.LOSE if kind == point.lose else Verdict.PASS
            if kind != point.word or self._set.is_set():
                return lost
            if point.how in ("lost", "sent"):
                if self._victim not in ("", sender):
                    return lost
                self._dead = self._victim = sender
                self._field.kill(sender)
                self._set.set()
                return Verdict.END if point.how == "lost" else Verdict.PASS
            if "facts" not in row[7] or receiver == self._gave:  # the new owner tells all agents
                self._lay(receiver)
            return lost

    def spring(self, timeout_s: float) -> str:
        """Wait until the point is reached, and kill the agent there; return its name, or an empty string if none came.

        Raises:
            InterruptedError: its waits were broken off.
        """
        waits = self._field.waits
        if not waits.until(self._set.wait, timeout_s):
            return ""
        if self._dead:
            return self._dead
        if isinstance(self._gate, WriteGate):
            reached = waits.until(self._stands_in_the_write, timeout_s)
        elif self._gate is not None:
            reached = waits.until(self._gate.reached, timeout_s)
        else:
            assert self._record is not None
            reached = waits.until(partial(_is_written, self._record), timeout_s)
        if not reached:
            return ""
        self._field.kill(self._victim)
        self._dead = self._victim
        return self._dead

    @property
    def dead(self) -> str:
        """The agent that was killed, even if it was not at the point."""
        return self._dead

    def clear(self) -> None:
        """Remove the gate. Afterwards the trap must not be shown any packets."""
        with self._lock:
            self._set.set()
            if self._gate is not None:
                if isinstance(self._gate, WriteGate):
                    self.no_disk_s = time.monotonic() - self._laid_s
                self._gate.remove()
                self._gate = None

    def _stands_in_the_write(self, for_s: float) -> bool:
        """Wait until the victim blocks in the intended write; any other write fails and is repeated."""
        gate = self._gate
        assert isinstance(gate, WriteGate)
        if gate.reached(min(for_s, GATE_S)):
            if gate.standing(self._field.task_id) is self.point.standing:
                return True
        elif gate.lies:
            return False
        gate.remove()
        self._gate = WriteGate(self._field.state / self._victim)
        return False

    def _concerns(self, row: list[Any]) -> bool:
        body, sender = row[7], agent_of(row[2])
        if not isinstance(body, dict):
            return False
        # Of what an agent knows, only that it owns the task.
        owned = [it["task_id"] for it in body.get("facts", ()) if it["register"][0][1][0] == sender]
        about = (list(self._field.task_id), str(self._field.task_id))
        return any(it in about for it in (*owned, body.get("task_id")))

    def _lay(self, victim: str) -> None:
        """Put a gate in an agent's way, or look at its present files."""
        field = self._field
        self._victim = victim
        match self.point.how:
            case "write":
                self._gate = WriteGate(field.state / victim)
                self._laid_s = time.monotonic()
            case "written":
                self._record = RecordWatch(field.state, victim, field.task_id)
            case how:
                self._gate = Gate(field.gates / f"{field.task_id.name}.{how}-{victim}")
        self._set.set()


def _is_replaced(path: Path, before: int | None) -> bool:
    """Return whether a file has been replaced; if not, wait a moment first."""
    if file_number(path) == before:
        _never.wait(LOOK_S)
    return file_number(path) != before


def _is_written(record: RecordWatch, for_s: float) -> bool:
    """Return whether a record was written; if not, wait a moment first."""
    if not record.written():
        _never.wait(LOOK_S)
    return record.written()
