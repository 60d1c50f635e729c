"""What the services of an agent have noted of the guardians of their tasks, for all of its threads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from pancakes.packet import Fence


class GuardianNote(msgspec.Struct, frozen=True):
    """One guardian of a task, as its owner knows it. Times are host times.

    Attributes:
        agent: the agent that it is on.
        checkpoint: the newest checkpoint that it has said it has; -1: none.
        as_of_s: when the task was known last to be as that checkpoint says; None: that is not known.
        heard_s: when it has said something last.
    """

    agent: str
    checkpoint: int
    as_of_s: float | None
    heard_s: float


class GuardNote(msgspec.Struct, frozen=True):
    """How a task is guarded, as its owner knows it.

    Attributes:
        epoch: the epoch under which it is owned, as text.
        right: the right under which it acts, and which its permit limits.
        number: how many guardians it is to have.
        lease_s: how long a lease is, in host seconds.
        guardians: those that it has.
        checkpoint: the newest checkpoint that more than half of them have; -1: none.
        as_of_s: as in `GuardianNote`, of that checkpoint.
    """

    epoch: str
    right: Fence
    number: int
    lease_s: float
    guardians: tuple[GuardianNote, ...]
    checkpoint: int = -1
    as_of_s: float | None = None

    def answering(self, now_s: float) -> int:
        """Returns how many guardians have said something within a lease."""
        return sum(now_s - one.heard_s < self.lease_s for one in self.guardians)

    def age_s(self, now_s: float) -> float | None:
        """Returns how long ago the task was known to be as the checkpoint says that more than half have."""
        return _since(self.as_of_s, now_s)

    def plain(self, now_s: float, permit_s: float | None) -> dict[str, Any]:
        """Returns it as plain values.

        Args:
            now_s: host time.
            permit_s: for how long the task may act yet; None or 0: it stands still.
        """
        return {
            "epoch": self.epoch,
            "guard": self.number,
            "lease_s": self.lease_s,
            "permit_s": permit_s or 0.0,
            "checkpoint": self.checkpoint,
            "age_s": self.age_s(now_s),
            "answering": self.answering(now_s),
            "guardians": [
                {
                    "agent": one.agent,
                    "checkpoint": one.checkpoint,
                    "age_s": _since(one.as_of_s, now_s),
                    "silent_s": now_s - one.heard_s,
                }
                for one in self.guardians
            ],
        }


def _since(then_s: float | None, now_s: float) -> float | None:
    return now_s - then_s if then_s is not None else None


class GuardNotes:
    """The notes on guarded tasks that this agent owns, by address. Any thread; each task's service enters its own."""

    def __init__(self) -> None:
        self._notes: dict[str, GuardNote] = {}

    def enter(self, address: str, note: GuardNote) -> None:
        """Enters what is known now."""
        self._notes[address] = note

    def drop(self, address: str) -> None:
        """Forgets a task: it is not guarded any more, or not here."""
        self._notes.pop(address, None)

    def of(self, address: str) -> GuardNote | None:
        """Returns what is known of a task; None: it is not guarded, or not owned here."""
        return self._notes.get(address)

    def all(self) -> Mapping[str, GuardNote]:
        """Returns all notes, by address."""
        return dict(self._notes)
