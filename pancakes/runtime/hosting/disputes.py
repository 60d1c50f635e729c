"""Tasks that two agents own: which of them stands still, and who is told."""

from __future__ import annotations

from pancakes.errors import MigrationError
from pancakes.mesh.migration.claim import Claims, OwnerClaim
from pancakes.mesh.migration.event import ClaimHeard
from pancakes.mesh.migration.guarded_task import is_by_person
from pancakes.mesh.migration.owner import is_disputed
from pancakes.mesh.migration.record import Phase, Record, TaskId
from pancakes.mesh.migration.snapshot import Snapshot
from pancakes.runtime.hosting.census_messages import ClaimsCame, Owns
from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.hosting.place import OtherOwner, Place


class Disputes:
    """Looks at what other agents say that they own. All in the service's actor.

    Args:
        host: the service.
    """

    def __init__(self, host: HostingService) -> None:
        self._host = host
        self._claims = Claims()

    def heard(self, message: ClaimsCame) -> None:
        """Another agent has told what it owns."""
        for task_id, claim in message.claims.items():
            self._claims.heard(message.peer, claim)
            place = self._host.places.get(task_id)
            if place is not None:
                self._claimed(place, message.peer, claim)

    def claimant(self, task_id: TaskId) -> OtherOwner | None:
        """Returns the agent that has made the highest claim on a task, whether it was believed or not; None: none."""
        found = self._claims.of(task_id)
        return OtherOwner(found[0], found[1].epoch) if found is not None else None

    def _claimed(self, place: Place, peer: str, claim: OwnerClaim) -> None:
        other, record = OtherOwner(peer, claim.epoch), place.standing.record
        if place.other == other or (place.other is not None and place.other.epoch > other.epoch):
            return
        if fault := self._host.kernel.access.fault(peer, "host", self._type_of(place)):
            self._host.log("warning", f"{peer} says that it owns {place.task_id}, and is not believed: {fault}")
            return
        place.other = other
        if record.guarded and claim.epoch != record.epoch and not is_by_person(record, claim.epoch):
            # Which of them may run it the guardians decide; the lower one gives it up by itself.
            if claim.epoch < record.epoch:
                self._host.tell_census(Owns(OwnerClaim(place.task_id, record.epoch), peer))
            self._host.feed_place(place, ClaimHeard(peer, claim.epoch))
            return
        if record.phase is not Phase.OWNER:
            return
        # It may have become an owner since this agent told all what it owns.
        self._host.tell_census(Owns(OwnerClaim(place.task_id, record.epoch), peer))
        if claim.epoch < record.epoch:
            self._tell(record, other, stands_still=False)
        else:
            self._give_way(place, other)

    def outvoted(self, place: Place, other: OtherOwner) -> None:
        """The guardians of a task follow another owner than this agent; `other.peer`: empty: no other agent."""
        if not other.peer or not is_by_person(place.standing.record, other.epoch):
            self._host.feed_place(place, ClaimHeard(other.peer, other.epoch))
        elif place.other != other:
            place.other = other
            self._give_way(place, other)

    def became_owner(self, place: Place) -> None:
        """This agent owns a task from now on, or under another epoch: all others are told."""
        self._host.tell_census(Owns(OwnerClaim(place.task_id, place.standing.record.epoch)))
        other = place.other
        if other is not None and other.epoch >= place.standing.record.epoch:
            self._give_way(place, other)
        else:
            place.other = None  # it owned the task before

    def _give_way(self, place: Place, other: OtherOwner) -> None:
        record = place.standing.record
        decided = record.guarded and other.epoch != record.epoch and not is_by_person(record, other.epoch)
        if not is_disputed(record) and not decided:
            self._tell(place.standing.record, other, stands_still=True)
        self._host.feed_place(place, ClaimHeard(other.peer, other.epoch))

    def _tell(self, record: Record, other: OtherOwner, stands_still: bool) -> None:
        task_id, agent = record.task_id, self._host.agent
        what = f"{task_id} is owned by {agent} (epoch {record.epoch}) and by {other.peer} (epoch {other.epoch})"
        if not stands_still:
            does = f"it goes on here, and must stand still on {other.peer}"
        elif other.epoch == record.epoch:
            does = "one of them is a copy of the other, so it stands still on both"
        else:
            does = f"it stands still here, and goes on on {other.peer}"
        resolve = f"`pancakes task resolve AGENT/{task_id.name}` says which of the two lives"
        self._host.log("error", f"{what}: {does}. {resolve}")
        self._host.event(
            "task_disputed", task=task_id.name, peer=other.peer, epoch=other.epoch.n, stands_still=stands_still
        )

    def _type_of(self, place: Place) -> str:
        if place.slot is not None and place.slot.spec.type:
            return place.slot.spec.type
        try:
            return Snapshot.decode(place.standing.record.snapshot).type
        except MigrationError:  # it has none, or one that cannot be read here
            return ""
