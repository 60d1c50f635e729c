"""How one task stands on this agent, besides its life: its record, and what its hand-off is about to do."""

from __future__ import annotations

import msgspec

from pancakes.mesh.migration.effect import Effect, Persist, StartTask
from pancakes.mesh.migration.event import Event
from pancakes.mesh.migration.owner import is_disputed
from pancakes.mesh.migration.record import Record
from pancakes.mesh.migration.volatile import Volatile


class Standing(msgspec.Struct, frozen=True):
    """What is known of a task on this agent, and what is still to be carried out.

    Attributes:
        record: its durable record, as it is on disk.
        volatile: what is known until the next crash.
        trouble: why the record could not be written when that was tried last; empty where it could.
        events: those of its hand-off that wait until all effects of the one before are carried out.
        effects: those of its hand-off that are still to be carried out, in this order.
        waits: the effect that is being carried out and takes time; None: none.
        begins: whether its life has taken up the `StartTask` that `waits` is.
        leaving: whether it was given away, and its place is cleared once its actor has ended.
        unanswered: how often its actor was told to stand still, and has not answered.
        rests: whether its life waits until its rest is on disk.
        to_conclude: how much of what follows its hand-over is still to be done.
    """

    record: Record
    volatile: Volatile = Volatile()
    trouble: str = ""
    events: tuple[Event, ...] = ()
    effects: tuple[Effect, ...] = ()
    waits: Persist | StartTask | None = None
    begins: bool = False
    leaving: bool = False
    unanswered: int = 0
    rests: bool = False
    to_conclude: int = 0


def disputed_in(standing: Standing) -> Record | None:
    """Returns the record that says that another agent owns the task too, also where it is not on disk yet."""
    writing = standing.waits.record if isinstance(standing.waits, Persist) else None
    records = (standing.record, standing.volatile.again, writing)
    return next((record for record in records if record is not None and is_disputed(record)), None)
