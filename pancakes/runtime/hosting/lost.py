"""A task whose record was lost: what is known of it all the same, and what a person has to know to decide."""

from __future__ import annotations

from typing import Final

import msgspec

from pancakes.mesh.migration.epoch import MORE_THAN_MOVES, NO_EPOCH, Epoch
from pancakes.mesh.migration.record import Phase, Record, TaskId

WAS: Final = {
    Phase.ABSENT: "was not here",
    Phase.OWNER: "was here",
    Phase.FROZEN: "was here, and about to be handed over to {peer}",
    Phase.COMMITTED: "was given to {peer}",
    Phase.PREPARED: "was on its way here from {peer}",
    Phase.RELEASED: "was handed over to {peer}",
}
"""What the phase of a record says of the past, for people."""


class Lost(msgspec.Struct, frozen=True):
    """A task of which an agent had a record that it cannot believe. The task may run elsewhere.

    Attributes:
        task_id: the task.
        why: what became of what this agent knew of it, as a clause.
        read: what can be read of it: it is whole, but of another journal; None: nothing.
        times: how often the agent has lost a record of this task.
        heard: the highest epoch that other agents know of.
    """

    task_id: TaskId
    why: str
    read: Record | None = None
    times: int = 1
    heard: Epoch = NO_EPOCH

    @property
    def seen(self) -> Epoch:
        """The highest epoch that is known of the task."""
        return max(self.read.seen, self.heard) if self.read is not None else self.heard

    @property
    def jump(self) -> int:
        """By how much the epoch is higher under which the task is adopted."""
        return self.times * MORE_THAN_MOVES

    @property
    def snapshot(self) -> bytes:
        """What the task can go on from, encoded; empty: nothing."""
        return self.read.snapshot if self.read is not None else b""

    def story(self) -> str:
        """Returns what has happened, as a clause."""
        if self.read is None:
            return self.why
        was = "was removed" if self.read.removed else WAS[self.read.phase].format(peer=self.read.peer)
        return f"{self.why}; as far as it can be read, the task {was}"

    def undecided(self, me: str) -> str:
        """Returns why the task is not started, and what a person can do who wants it to run on `me`."""
        name = f"{me}/{self.task_id.name}"
        return (
            f"it may run elsewhere, and {self.story()}. It stays at rest until you decide: where `pancakes task list`"
            f" shows it on no agent, and none that may have it is off or cut off, `pancakes task adopt {name} --force`"
            f" runs it here; where it runs elsewhere, `pancakes task forget {name}` leaves it there"
        )

    def meaning(self, me: str) -> str:
        """Returns what adopting the task on the agent `me` would mean, for a person who has not yet said `force`."""
        begins = "from what is in that record" if self.snapshot else "as its configuration says, its state is lost"
        return (
            f"of {self.task_id}, {self.story()}. Adopted by force, it runs on {me} ({begins}), under a new epoch. Where"
            f" it runs elsewhere, or rests on an agent that is off or cut off and comes back, there are two of it. So"
            f" first see with `pancakes task list`, while all agents are on, that it runs nowhere. Where it does run,"
            f" `pancakes task forget {me}/{self.task_id.name}` leaves it there. Nothing was done"
        )
