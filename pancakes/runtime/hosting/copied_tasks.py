"""The tasks of a service whose agent has an old copy for a disk, as others say: they stand still meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import msgspec

from pancakes.mesh.migration.knowledge import TaskFact, TasksKnown, newest_fact
from pancakes.mesh.migration.old_copy import CopiedTask, CopyVerdict, copied_task
from pancakes.mesh.migration.record import Phase, TaskId
from pancakes.mesh.migration.rest import OLD_COPY
from pancakes.runtime.hosting.census_messages import CENSUS, AskAbout
from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.hosting.machine import idle
from pancakes.runtime.hosting.place import OtherOwner, Place, Unsure
from pancakes.runtime.life.life import State
from pancakes.runtime.life.life_event import Retry, StopAsked

HERE: Final = (Phase.OWNER, Phase.FROZEN)
"""The phases in which the task is here, as the disk says. Of a hand-off the other side knows how far it is."""

LOOK_S: Final = 1.0
ASK_AGAIN_S: Final = 0.9


class _Heard(msgspec.Struct):
    """What those that take the disk for an old copy have told of one task.

    Attributes:
        by: the agents that have told.
        known: the newest that each of them knows.
    """

    by: set[str] = msgspec.field(default_factory=set)
    known: dict[str, TaskFact] = msgspec.field(default_factory=dict)


class CopiedTasks:
    """Has tasks stand still where their disk is an old copy. All in the service's actor.

    Args:
        host: the service.
        fault: returns why an agent is not believed what it knows of a task; empty: it is.
        went_on: called with the place of a task that went on elsewhere, and what is known of that.
    """

    def __init__(
        self,
        host: HostingService,
        fault: Callable[[str, Place], str],
        went_on: Callable[[Place, OtherOwner], None],
    ) -> None:
        self._host = host
        self._fault = fault
        self._went_on = went_on
        self._sayers: set[str] = set()
        self._copied: set[TaskId] = set()  # what came later is no copy
        self._told: dict[TaskId, _Heard] = {}
        self._decided: set[TaskId] = set()  # by a person
        self._asked_s = 0.0

    def noticed(self, peer: str) -> None:
        """Another agent takes the disk for an old copy."""
        if peer in self._sayers:
            return
        self._sayers.add(peer)
        places = self._host.places.values()
        self._copied.update(place.task_id for place in places if not place.standing.record.unborn)
        copied = [place for place in places if place.standing.record.phase in HERE]
        if any(self._verdict(place).verdict is CopyVerdict.WAITS for place in copied):
            sayers = " and ".join(sorted(self._sayers))
            self._host.log(
                "error",
                f"the disk of {self._host.agent} is an old copy, as {sayers} say: its tasks stand still until these"
                " have told where they are",
            )
            self._host.event("old_copy", peers=", ".join(sorted(self._sayers)))
        self._ask(copied)
        self._look()

    def heard(self, peer: str, told: TasksKnown) -> None:
        """Another agent has told what it knows."""
        if peer not in self._sayers:
            return
        facts = {fact.task_id: fact for fact in told.facts}
        for task_id in told.task_ids:
            place = self._host.places.get(task_id)
            if place is None or self._fault(peer, place):
                continue
            heard = self._told.setdefault(task_id, _Heard())
            heard.by.add(peer)
            if (fact := newest_fact((facts.get(task_id), heard.known.get(peer)))) is not None:
                heard.known[peer] = fact
            self._look_again(place)

    def of(self, place: Place) -> Unsure | None:
        """Returns why a task stands still; None: it need not, for all that this knows."""
        copied = self._verdict(place)
        if copied.verdict is not CopyVerdict.WAITS or place.standing.record.phase is not Phase.OWNER:
            return None
        name = f"{self._host.agent}/{place.task_id.name}"
        why = (
            f"the disk of {self._host.agent} is an old copy, as {' and '.join(sorted(self._sayers))} say, and"
            f" {place.task_id} may be elsewhere by now: it stands still until {', '.join(copied.missing)} told what"
            f" they know of it. `pancakes task adopt {name} --force` has it go on here"
        )
        self._ask_again()
        return Unsure(OLD_COPY, why)

    def undecided(self, name: str) -> list[Place]:
        """Returns the places of the tasks of a name that stand still, for a person to decide."""
        return [
            place
            for place in self._host.places.named(name)
            if self._verdict(place).verdict is CopyVerdict.WAITS and place.standing.record.phase is Phase.OWNER
        ]

    def decide(self, place: Place) -> None:
        """A person says that a task is to go on here."""
        self._decided.add(place.task_id)
        self._retry(place)

    def _verdict(self, place: Place) -> CopiedTask:
        record = place.standing.record
        if record.phase not in HERE or place.task_id not in self._copied or place.task_id in self._decided:
            return CopiedTask(CopyVerdict.GOES_ON)
        sayers = [peer for peer in self._sayers if not self._fault(peer, place)]
        told = self._told.get(place.task_id, _Heard())
        return copied_task(record.seen, sayers, told.by, tuple(told.known.values()))

    def _look(self) -> None:
        """Has what runs stand still; one that is being handed over does, and is looked at again once that is over."""
        waiting = [it for it in self._host.places.values() if self._verdict(it).verdict is CopyVerdict.WAITS]
        reason = f"the disk of {self._host.agent} is an old copy, and it may be elsewhere by now"
        for place in waiting:
            slot, standing = place.slot, place.standing
            lives = slot is not None and slot.life.state in (State.STARTING, State.RUNNING)
            if lives and idle(standing) and not standing.volatile.asked and standing.record.phase is Phase.OWNER:
                self._host.feed_place(place, StopAsked(reason=reason, again=True))
        if waiting:
            self._host.after_host(LOOK_S, self._look)

    def _look_again(self, place: Place) -> None:
        copied = self._verdict(place)
        if copied.verdict is CopyVerdict.ELSEWHERE and copied.fact is not None:
            peer = copied.fact.owner if copied.fact.owner not in ("", self._host.agent) else min(self._sayers)
            self._went_on(place, OtherOwner(peer, copied.fact.epoch))
        if copied.verdict is CopyVerdict.GOES_ON:
            self._retry(place)

    def _retry(self, place: Place) -> None:
        if place.slot is not None and place.slot.life.state is State.REFUSED:
            self._host.feed_place(place, Retry())

    # Asking ----------------------------------------------------------------------------------------------------

    def _ask(self, places: list[Place]) -> None:
        self._asked_s = self._host.kernel.host.now()
        if places:
            task_ids = tuple(place.task_id for place in places)
            self._host.kernel.tell(CENSUS, AskAbout(tuple(sorted(self._sayers)), task_ids))

    def _ask_again(self) -> None:
        """A question or an answer may be lost. What waits looks again each second."""
        if self._host.kernel.host.now() >= self._asked_s + ASK_AGAIN_S:
            waiting = [it for it in self._host.places.values() if self._verdict(it).verdict is CopyVerdict.WAITS]
            self._ask(waiting)
