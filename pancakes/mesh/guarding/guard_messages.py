"""What the owner of a guarded task, or an agent that is to take it, and its guardians say to each other.

Each is the body of a packet on `network`: from the service that hosts the task to an agent's `kernel/Guardian`, and
back. The network may lose, double, reorder and delay them.

`journal` is the id of the receiver's journal; see `pancakes.mesh.migration.messages`.
"""

from __future__ import annotations

from typing import Annotated, Final, NamedTuple

import msgspec

from pancakes.mesh.migration.epoch import NO_EPOCH, Epoch
from pancakes.mesh.migration.guards import GuardianId, Guards
from pancakes.mesh.migration.record import TaskId, Wanted
from pancakes.packet import packet_type

SHORTEST_LEASE_S: Final = 0.5
LONGEST_LEASE_S: Final = 3600.0
MOST_AGE_S: Final = 1e9
LeaseSeconds = Annotated[float, msgspec.Meta(ge=SHORTEST_LEASE_S, le=LONGEST_LEASE_S)]


class CheckpointId(NamedTuple):
    """Names a checkpoint of a task; the later is the newer.

    Attributes:
        epoch: the epoch under which it was written.
        no: the how-manieth it is under that epoch.
    """

    epoch: Epoch
    no: int


NO_CHECKPOINT: Final = CheckpointId(NO_EPOCH, 0)


class CheckpointBody(msgspec.Struct, frozen=True):
    """What a checkpoint consists of.

    Attributes:
        snapshot: the task, encoded.
        wanted: what is wanted of it.
    """

    snapshot: bytes
    wanted: Wanted = Wanted.RUNNING


@packet_type("guard.keep")
class KeepLease(msgspec.Struct, frozen=True):
    """The owner asks a guardian for a lease, and for its memory.

    Attributes:
        task_id: the task.
        type: entry point name of its class.
        epoch: the epoch under which the sender owns it.
        beat: the how-manieth asking this is since the owner began; the answer repeats it.
        lease_s: for so long the guardian lets no other agent take the task, in host seconds from the arrival of this.
        checkpoint: the newest checkpoint.
        guards: the guardians.
        body: that checkpoint; None: the guardian has it, as far as the owner knows.
        age_s: how long ago the owner knew that the task is as that checkpoint says, in host seconds.
        journal: see the module's text.
    """

    task_id: TaskId
    type: str
    epoch: Epoch
    beat: int
    lease_s: LeaseSeconds
    checkpoint: CheckpointId
    guards: Guards
    body: CheckpointBody | None = None
    age_s: Annotated[float, msgspec.Meta(ge=0.0, le=MOST_AGE_S)] = 0.0
    journal: str = ""


@packet_type("guard.kept")
class LeaseKept(msgspec.Struct, frozen=True):
    """The guardian grants the lease; what it names is on its disk.

    Attributes:
        epoch: the epoch of the owner.
        guardian: the guardian that says so.
        beat: which asking this answers.
        no: the newest checkpoint under that epoch that the guardian has; -1: none.
        version: the newest version of the guards of that epoch that it has; -1: none.
        boot: in which life of its agent it says so.
        told: the newest checkpoint under that epoch that it was told of in that life, also where it has no room for it;
            -1: none.
    """

    task_id: TaskId
    epoch: Epoch
    guardian: GuardianId
    beat: int
    no: int
    version: int
    boot: int = 0
    told: int = -1
    journal: str = ""


@packet_type("guard.seize")
class SeizeTask(msgspec.Struct, frozen=True):
    """An agent that is to take the task asks a guardian for its pledge.

    Attributes:
        type: entry point name of the task's class.
        epoch: the epoch under which the sender is to own it; it has minted it itself.
        guards: the guardians, as far as the sender knows them.
    """

    task_id: TaskId
    type: str
    epoch: Epoch
    guards: Guards
    journal: str = ""


@packet_type("guard.pledge")
class Pledge(msgspec.Struct, frozen=True):
    """The guardian follows no lower epoch any more, and tells what it remembers.

    Attributes:
        epoch: the epoch that it has promised itself to.
        guardian: the guardian that says so.
        checkpoint: the newest checkpoint that it has.
        guards: the newest guards that it knows.
        body: that checkpoint; None: it has none.
    """

    task_id: TaskId
    epoch: Epoch
    guardian: GuardianId
    checkpoint: CheckpointId
    guards: Guards
    body: CheckpointBody | None
    journal: str = ""


@packet_type("guard.deny")
class DenyLease(msgspec.Struct, frozen=True):
    """The guardian grants nothing: it has promised itself to a later epoch, or a lease runs. A hint, and no more.

    Attributes:
        epoch: the epoch of which it was asked.
        guardian: the guardian that says so.
        promised: the highest epoch that it has promised itself to.
        reason: why, as a sentence.
    """

    task_id: TaskId
    epoch: Epoch
    guardian: GuardianId
    promised: Epoch
    reason: str
    journal: str = ""


@packet_type("guard.yield")
class YieldLease(msgspec.Struct, frozen=True):
    """The owner does nothing more until it has asked for a lease again, or has given the task away: its lease may end.

    Attributes:
        epoch: the epoch under which it owned the task.
        beat: the number of its last asking; a lease that was granted on a later one does not end.
        boot: in which life of its agent the guardian was heard last; one that has begun anew since cannot know on which
            asking it granted what, so the lease does not end.
        given: whether it has given the task to another agent, or is frozen for one, which is about to ask.
    """

    task_id: TaskId
    epoch: Epoch
    beat: int
    boot: int
    journal: str = ""
    given: bool = False


GuardAnswer = LeaseKept | Pledge | DenyLease
"""What a guardian says."""
