"""All that a service knows of one task that it hosts, or has ever had to do with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import msgspec

from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.migration.ledger import Ledger
from pancakes.mesh.migration.messages import Solicit
from pancakes.mesh.migration.post import STREAMS
from pancakes.mesh.migration.record import TaskId
from pancakes.mesh.migration.snapshot import Snapshot
from pancakes.runtime.hosting.bidding_messages import HasMoved
from pancakes.runtime.hosting.checkpoints import LastCheckpoint
from pancakes.runtime.hosting.standing import Standing
from pancakes.runtime.hosting.task_letters import TaskLetters
from pancakes.runtime.hosting.tenancy import Taking, Tenancy
from pancakes.runtime.kernel.timer import OneShot
from pancakes.runtime.life.request import Request
from pancakes.runtime.supervision.slot import Slot
from pancakes.task import TaskSpec


class Move(msgspec.Struct):
    """A move that is under way.

    Attributes:
        request: what the neighbours are asked.
        then: a task to start here once the other has gone.
        answer: the request to answer; None where a rule asked.
        dry_run: whether nothing is to be moved.
        ledger: the account as it stands while a hand-off is under way; None before the first, and between two.
    """

    request: Solicit
    then: str
    answer: Request | None
    dry_run: bool
    ledger: Ledger | None = None

    def take_ledger(self) -> Ledger | None:
        """Returns the account as it stood: the hand-off has come to nothing."""
        ledger, self.ledger = self.ledger, None
        return ledger


class Adoption(msgspec.Struct, frozen=True):
    """A person has said that the task shall run here; the answer waits until that is decided.

    Attributes:
        request: the request to answer.
        peer: the agent that is gone; empty: the record was lost.
        reason: what was decided, as a sentence.
        ledger: the account of the hand-off that was in doubt.
        as_it_stands: whether it is here already, and goes on as it stands.
    """

    request: Request
    peer: str
    reason: str
    ledger: Ledger | None
    as_it_stands: bool = False


class Creation(msgspec.Struct, frozen=True):
    """A task is to be created here.

    Attributes:
        request: the request to answer.
        spec: how it is started.
        snapshot: how it begins, encoded.
        dry_run: whether it is not to begin.
        silent: the agents that have not said whether they know it.
    """

    request: Request
    spec: TaskSpec
    snapshot: bytes
    dry_run: bool
    silent: tuple[str, ...] = ()


class OtherOwner(msgspec.Struct, frozen=True):
    """Another agent that owns the task too, as it says.

    Attributes:
        peer: that agent.
        epoch: under which epoch.
    """

    peer: str
    epoch: Epoch


class BeganFrom(msgspec.Struct, frozen=True):
    """What a task began from where it is owned.

    Attributes:
        epoch_n: the number of the epoch under which it began.
        heard: the duplicate filter in the snapshot that it began from.
        life: as `began_life` of `pancakes.mesh.migration.post.Receipt`.
    """

    epoch_n: int
    heard: Mapping[str, int]
    life: int = 0

    def upto(self, stream: str) -> int:
        """Returns up to which letter of a stream it had the effects; -1: that is not known."""
        # Of more streams than it remembers it has forgotten some.
        return self.heard.get(stream, 0 if len(self.heard) < STREAMS else -1)


def began_from(epoch: Epoch, snapshot: Snapshot, life: int = 0) -> BeganFrom:
    """Returns what a task begins from that is owned under an epoch; `life`: 0 where it has just come under that."""
    return BeganFrom(epoch.n, snapshot.heard, life)


class Unsure(msgspec.Struct, frozen=True):
    """Why a task does not run here now: its agent does not know what it must know.

    Attributes:
        word: that in a word; see `pancakes.mesh.migration.rest`.
        why: as a sentence.
        for_good: whether only a person, or the task's coming here, changes that.
    """

    word: str = ""
    why: str = ""
    for_good: bool = False


SURE: Final = Unsure()
"""Its agent knows what it must know."""


class Place(msgspec.Struct):
    """The place of one task, whether it runs here or has left only its record.

    Its life is in its slot, as that of every task; a task without one has no life here.

    Attributes:
        task_id: the task.
        slot: its slot; None: it has none.
        standing: its record, and what its hand-off is about to do.
        letters: what is known of the letters that have come for it; None: none has.
        written: what was written down of it last; None: nothing since it began.
        began: what it began from here, as far as letters are concerned; None: it is not owned here.
        looked_s: when the task was known last to be as `written` says, in host time.
        promised: the agent to which this one said RESERVED last, and its offer; None: to none since it began.
        came_from: the agent that it is on its way from; empty: none.
        move: the move that was asked for; None: none.
        ask_again_s: its rule leaves it alone until this host time.
        account: the account of its move, which the Task Migrator has not kept yet; None: there is none.
        adoption: the adoption that waits for its start; None: none.
        forgetting: the requests to forget it that wait for the disk.
        creation: the creation that waits for its start; None: none.
        removal: the request to remove it that waits for its end, or for the disk; None: none.
        follows: the task that it is started after; None: none.
        permit: of a guarded task: whether it may act, as far as its service has looked; its actor looks at the clock.
        tenancy: of a guarded task that is owned here: what its guardians have said; None: it is none.
        taking: what guardians have said of a task that this agent is to take; None: it is to take none.
        other: the agent that said of all others that it owns it under the highest epoch; None: none has said so.
        unsure: why it does not run, where this agent does not know what it must know.
        unwritable: whether what it carries could not be written down when it was last looked at.
        reminders: the timers that its hand-off waits for, by the event that each feeds.
    """

    task_id: TaskId
    standing: Standing
    slot: Slot | None = None
    letters: TaskLetters | None = None
    written: LastCheckpoint | None = None
    began: BeganFrom | None = None
    looked_s: float = 0.0
    promised: tuple[str, Epoch] | None = None
    came_from: str = ""
    move: Move | None = None
    ask_again_s: float = 0.0
    account: HasMoved | None = None
    adoption: Adoption | None = None
    forgetting: tuple[Request, ...] = ()
    creation: Creation | None = None
    removal: Request | None = None
    follows: TaskId | None = None
    permit: bool = False
    tenancy: Tenancy | None = None
    taking: Taking | None = None
    other: OtherOwner | None = None
    unsure: Unsure = SURE
    unwritable: bool = False
    reminders: dict[type, OneShot] = msgspec.field(default_factory=dict)

    @property
    def owes(self) -> bool:
        """Whether something that the task has handled waits for the disk."""
        return self.letters is not None and bool(self.letters.owed)
