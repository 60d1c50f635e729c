"""Writes down hosted tasks while they run, each when its state has changed (`durability`)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Final

from pancakes.errors import PancakesError
from pancakes.mesh.migration.event import Checkpoint
from pancakes.mesh.migration.record import TaskId
from pancakes.runtime.hosting.checkpoints import last_checkpoint, plain_of
from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.hosting.machine import idle
from pancakes.runtime.hosting.place import Place
from pancakes.runtime.kernel.tell import tell
from pancakes.runtime.life.life import State
from pancakes.runtime.supervision.slot import Slot
from pancakes.runtime.supervision.task_messages import Carried, Look, Looked

CHECKPOINT_S: Final = 1.0
"""How often, in host time, a task whose state has changed is written down (`durability = "lazy"`)."""
AT_ONCE: Final = 20
"""So many tasks are looked at in one go; a look at a thousand would make all of them 20 ms late, each second."""


class Checkpointing:
    """Looks at the tasks of one service, and writes down what has changed. All in that service's actor.

    Args:
        host: the service.

    Attributes:
        late: the places of tasks whose checkpoint had to wait for the disk.
    """

    def __init__(self, host: HostingService) -> None:
        self._host = host
        self.late: dict[TaskId, Place] = {}
        self._begun = False

    def begin(self) -> None:
        """Looks at all tasks from now on, as long as there are any."""
        if not self._begun:
            self._begun = True
            self._host.after_host(CHECKPOINT_S, self._look_at_all)

    def _look_at_all(self) -> None:
        self._begun = False
        # A guarded task has a time of its own.
        names = [name for name in self._host.slots if self._host.places.at[name].tenancy is None]
        batches = [names[start : start + AT_ONCE] for start in range(0, len(names), AT_ONCE)]
        for number, batch in enumerate(batches):
            if number == 0:
                self.look_at(batch)
            else:
                self._host.after_host(number * CHECKPOINT_S / len(batches), partial(self.look_at, batch))
        if self._host.slots:
            self.begin()

    def look_at(self, names: Sequence[str]) -> None:
        """Looks at some tasks, by name."""
        places = self._host.places
        for name in names:
            slot = self._host.slots.get(name)
            if slot is None or slot.task is None or slot.life.state is not State.RUNNING:
                continue
            # Its duplicate filter cannot have changed either: a letter that it is given leaves it owing an answer.
            place = places.at[slot.name]
            written, kernel = place.written, self._host.kernel
            note, timers = kernel.tasks.settings_of(slot.address), kernel.task_timers.of(slot.address)
            if place.owes or written is None or not written.surely_holds(note, timers):
                tell(slot.task, Look())
            else:
                place.looked_s = kernel.host.now()

    def look_at_late(self) -> None:
        """The disk has written something: looks at the tasks whose checkpoint had to wait."""
        late, self.late = self.late, {}
        for place in late.values():
            slot = place.slot
            if slot is not None and (slot.spec.durability == "each" or place.owes):
                self.look_at([slot.name])

    def looked(self, slot: Slot, looked: Looked) -> None:
        """A task says what it carries."""
        if looked.carried is None:
            self._tell_unwritable(slot, looked.reason)
        else:
            self.save(slot, looked.carried)

    def save(self, slot: Slot, carried: Carried) -> None:
        """Writes down a running task, if anything has changed."""
        if slot.life.state is not State.RUNNING:
            return
        place = self._host.places.at[slot.name]
        standing = place.standing
        if not idle(standing):
            # The disk is slow, or a hand-off under way: the next time will do, and nothing piles up meanwhile.
            self.late[place.task_id] = place
            return
        try:
            plain = plain_of(carried)
            if place.written is not None and place.written.plain == plain and not place.owes:
                place.looked_s, place.unwritable = self._host.kernel.host.now(), False
                return
            snapshot = self._host.snapshot(slot, carried)
        except PancakesError as error:
            self._tell_unwritable(slot, str(error))
            return
        place.unwritable = False
        place.written, place.looked_s = last_checkpoint(slot.spec.cls, carried, plain), self._host.kernel.host.now()
        consumed = place.letters.consumed(carried.heard) if place.letters is not None else ()
        record = standing.record
        self._host.feed_place(place, Checkpoint(record.epoch, record.incarnation, snapshot, consumed))

    def _tell_unwritable(self, slot: Slot, why: str) -> None:
        """Tells `log` once what a task carries that cannot be written down, until it can again."""
        place = self._host.places.at[slot.name]
        if not place.unwritable:
            place.unwritable = True
            self._host.log("error", f"what {slot.address} carries cannot be written down: {why}")
