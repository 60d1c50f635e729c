"""Where a task is, as far as one agent knows: asked by agents whose actuators a task is to command. Pure."""

from __future__ import annotations

import msgspec

from pancakes.mesh.migration.epoch import NO_EPOCH, Epoch
from pancakes.mesh.migration.record import Phase, Record
from pancakes.packet import packet_type


@packet_type("task.where")
class WhereIs(msgspec.Struct, frozen=True):
    """Asks an agent's courier which agent has a task. Answered by `TaskAt`.

    Attributes:
        task_id: the task, as `birthplace/name`.
    """

    task_id: str


@packet_type("task.at")
class TaskAt(msgspec.Struct, frozen=True):
    """Says which agent has a task, as far as is known here.

    Attributes:
        task_id: the task.
        peer: the agent that has it, which may be the one that says so; empty: that is not known here.
        epoch: the highest epoch that is known of it; where it is here, the one that it runs under.
        acts: if it is here and guarded: whether its guardians let it act now. Else they may have another agent run it.
    """

    task_id: str
    peer: str = ""
    epoch: Epoch = NO_EPOCH
    acts: bool = True


def whereabouts(me: str, task_id: str, record: Record | None) -> TaskAt:
    """Returns what an agent says of a task of which it has this record; None: it has none."""
    if record is None:
        return TaskAt(task_id)
    match record.phase:
        case Phase.OWNER | Phase.FROZEN:
            return TaskAt(task_id, me, record.epoch)
        case Phase.COMMITTED:
            return TaskAt(task_id, record.peer, record.offer)
        case Phase.RELEASED:
            return TaskAt(task_id, record.peer, record.seen)
        case _:  # any agent may offer a task, and only one that gave it away knows to which other
            return TaskAt(task_id)
