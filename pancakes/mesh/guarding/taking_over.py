"""What guardians say to each other before a task is taken over, and to the agent that is to take it."""

from __future__ import annotations

import msgspec

from pancakes.mesh.guarding.guard_messages import NO_CHECKPOINT, CheckpointId
from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.migration.guards import GuardianId, Guards
from pancakes.mesh.migration.record import TaskId
from pancakes.packet import packet_type


@packet_type("guard.poll")
class AskLease(msgspec.Struct, frozen=True):
    """A guardian asks another one whether a lease on a task runs there; answered by `LeaseSeen`, promises nothing."""

    task_id: TaskId
    journal: str = ""


class HeldUntil(msgspec.Struct, frozen=True):
    """The newest checkpoint that a guardian has.

    Attributes:
        checkpoint: which one.
        age_s: how old it was when the owner was heard last, in host seconds; None: that is not known any more. What the
            task has done since is lost.
    """

    checkpoint: CheckpointId = NO_CHECKPOINT
    age_s: float | None = None

    def story(self) -> str:
        """Returns it as a clause."""
        age = f"{self.age_s:.1f} s old" if self.age_s is not None else "of an age that is not known"
        return f"checkpoint {self.checkpoint.epoch}/{self.checkpoint.no}, {age} at its last word"


@packet_type("guard.seen")
class LeaseSeen(msgspec.Struct, frozen=True):
    """Says whether a lease runs at a guardian.

    Attributes:
        guardian: the guardian that says so.
        runs: whether one runs.
        promised: the latest epoch that it follows.
        guards: the newest guards that it knows of.
        held: the newest checkpoint that it has.
    """

    task_id: TaskId
    guardian: GuardianId
    runs: bool
    promised: Epoch
    guards: Guards
    held: HeldUntil = HeldUntil()
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
