"""What guardians say to each other before a task is taken over, and to the agent that is to take it."""

from __future__ import annotations

import msgspec

from pancakes.mesh.guarding.guard_messages import CheckpointId
from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.migration.guards import GuardianId, Guards
from pancakes.mesh.migration.record import TaskId
from pancakes.packet import packet_type


@packet_type("guard.poll")
class AskLease(msgspec.Struct, frozen=True):
    """A guardian asks another one whether a lease on a task runs there; answered by `LeaseSeen`, promises nothing."""

    task_id: TaskId
    journal: str = ""


@packet_type("guard.seen")
class LeaseSeen(msgspec.Struct, frozen=True):
    """Says whether a lease runs at a guardian.

    Attributes:
        guardian: who says so.
        runs: whether one runs.
        promised: the latest epoch that it follows.
        guards: the newest guards that it knows of.
    """

    task_id: TaskId
    guardian: GuardianId
    runs: bool
    promised: Epoch
    guards: Guards
    journal: str = ""


@packet_type("guard.call")
class TakeTask(msgspec.Struct, frozen=True):
    """A guardian tells the service of an agent to take a task whose owner is silent. No safety hangs on it.

    Attributes:
        type: entry point name of the task's class.
        promised: the latest epoch that any guardian follows, as far as is known: the next one must be higher.
        guards: the guardians.
        checkpoint: the newest checkpoint that the sender has.
        silent_s: for how long the owner has been silent, in host seconds.
    """

    task_id: TaskId
    type: str
    promised: Epoch
    guards: Guards
    checkpoint: CheckpointId
    silent_s: float = 0.0
    journal: str = ""
