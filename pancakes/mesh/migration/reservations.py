"""The places that a candidate keeps for tasks that are about to arrive."""

from __future__ import annotations

import msgspec

from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.migration.record import TaskId


class Reservation(msgspec.Struct, frozen=True):
    """A place kept for one task.

    Attributes:
        peer: the agent that it would come from.
        offer: the hand-off that it is kept for.
        until_s: host time at which it is given up.
    """

    peer: str
    offer: Epoch
    until_s: float


class Reservations:
    """Keeps the slots, at most one for each task. Advisory: no safety hangs on it, and a crash empties it."""

    def __init__(self) -> None:
        self._slots: dict[TaskId, Reservation] = {}

    def keep(self, task_id: TaskId, slot: Reservation) -> None:
        """Keeps a slot; it replaces an older one for the same task."""
        self._slots[task_id] = slot

    def free(self, task_id: TaskId) -> None:
        """Gives the slot for a task up, if there is one: it has arrived, or does not come."""
        self._slots.pop(task_id, None)

    def peer_of(self, task_id: TaskId, now_s: float) -> str:
        """Returns the agent that a slot for a task is kept for at `now_s` (host time); empty: none is."""
        slot = self._slots.get(task_id)
        return slot.peer if slot is not None and slot.until_s > now_s else ""

    def number(self, peer: str, now_s: float) -> int:
        """Returns how many slots are kept for a peer at `now_s` (host time)."""
        return sum(slot.peer == peer and slot.until_s > now_s for slot in self._slots.values())

    def kept(self, now_s: float) -> tuple[TaskId, ...]:
        """Returns the tasks that a slot is kept for at `now_s` (host time), in order; drops what has expired."""
        self._slots = {task_id: slot for task_id, slot in self._slots.items() if slot.until_s > now_s}
        return tuple(sorted(self._slots))
