"""What agents ask each other about tasks of which one of them cannot know by itself where they are. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, Final

import msgspec

from pancakes.mesh.migration.epoch import NO_EPOCH, Epoch
from pancakes.mesh.migration.record import Phase, Record, TaskId
from pancakes.packet import packet_type

MOST_ASKED: Final = 256
"""So many tasks are asked about at once."""


class TaskFact(msgspec.Struct, frozen=True):
    """What an agent knows of a task.

    Attributes:
        task_id: the task.
        owner: the agent that has it, as far as is known; empty: it is not known.
        epoch: the highest epoch that is known of it.
        removed: whether it was removed, and is nowhere.
    """

    task_id: TaskId
    owner: str
    epoch: Epoch
    removed: bool = False


Asked = Annotated[tuple[TaskId, ...], msgspec.Meta(max_length=MOST_ASKED)]


@packet_type("task.ask")
class AskTasks(msgspec.Struct, frozen=True):
    """Asks the census of another agent what that one knows of tasks.

    Attributes:
        task_ids: the tasks.
    """

    task_ids: Asked


@packet_type("task.known")
class TasksKnown(msgspec.Struct, frozen=True):
    """The answer to `AskTasks`.

    Attributes:
        task_ids: the tasks that were asked about.
        facts: what the sender knows; of the other tasks nothing.
    """

    task_ids: Asked
    facts: Annotated[tuple[TaskFact, ...], msgspec.Meta(max_length=MOST_ASKED)]


def fact_of(me: str, record: Record) -> TaskFact | None:
    """Returns what the record of a task on the agent `me` says; None: nothing."""
    if record.unborn:
        return None
    ours = record.phase in (Phase.OWNER, Phase.FROZEN)
    offered = record.offer if record.phase in (Phase.COMMITTED, Phase.PREPARED) else NO_EPOCH
    owner, epoch = me if ours else record.peer, max(record.seen, record.epoch, offered)
    return TaskFact(record.task_id, owner, epoch, record.removed)


def newest_fact(facts: Iterable[TaskFact | None]) -> TaskFact | None:
    """Returns the fact with the highest epoch; None: there is none. A task is removed under the epoch that it has."""
    known = [fact for fact in facts if fact is not None]
    return max(known, key=lambda fact: (fact.epoch, fact.removed), default=None)


def questions(task_ids: Sequence[TaskId]) -> list[AskTasks]:
    """Returns the packets that ask about tasks."""
    return [AskTasks(tuple(task_ids[at : at + MOST_ASKED])) for at in range(0, len(task_ids), MOST_ASKED)]
