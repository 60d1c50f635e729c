"""What the services of an agent have noted of the guardians of their tasks, for all of its threads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from pancakes.mesh.guarding.tenure import Tenure
from pancakes.mesh.migration.guards import GuardianId, Guards
from pancakes.packet import Fence


class GuardNote(msgspec.Struct, frozen=True):
    """How a task is guarded, as its owner knows it. Times are host times.

    Attributes:
        right: the right under which it acts, and which its permit limits.
        number: how many guardians it is to have.
        lease_s: how long a lease is, in host seconds.
        guards: the guardians that it has.
        tenure: what they have said.
        heard_s: when each of them has said something last.
        as_of_s: when the task was known last to be as each of the newest checkpoints says, by number.
    """

    right: Fence
    number: int
    lease_s: float
    guards: Guards
    tenure: Tenure
    heard_s: Mapping[GuardianId, float]
    as_of_s: Mapping[int, float]

    def answering(self, now_s: float) -> int:
        """Returns how many guardians have said something within a lease."""
        return sum(now_s - self.heard_s[one] < self.lease_s for one in self.guards.members())

    def age_s(self, now_s: float) -> float | None:
        """Returns how long ago the task was known to be as the checkpoint says that more than half have."""
        return self._age_s(self.tenure.replicated_no(self.guards), now_s)

    def _age_s(self, checkpoint: int, now_s: float) -> float | None:
        then_s = self.as_of_s.get(checkpoint)
        return now_s - then_s if then_s is not None else None

    def plain(self, now_s: float, permit_s: float | None) -> dict[str, Any]:
        """Returns it as plain values.

        Args:
            now_s: host time.
            permit_s: for how long the task may act yet; None or 0: it stands still.
        """
        return {
            "task_id": self.right.task_id,
            "epoch": str(self.tenure.epoch),
            "guard": self.number,
            "lease_s": self.lease_s,
            "permit_s": permit_s or 0.0,
            "copied": self.tenure.original == self.right.epoch,
            "checkpoint": self.tenure.replicated_no(self.guards),
            "age_s": self.age_s(now_s),
            "answering": self.answering(now_s),
            "guardians": [
                {
                    "agent": one.agent,
                    "checkpoint": self.tenure.of(one).no,
                    "age_s": self._age_s(self.tenure.of(one).no, now_s),
                    "silent_s": now_s - self.heard_s[one],
                }
                for one in self.guards.members()
            ],
        }


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
