"""What a service hears of its tasks from other agents: two that own one, and tasks that may be elsewhere."""

from __future__ import annotations

from pancakes.errors import MigrationError
from pancakes.mesh.migration.claim import Claims, OwnerClaim
from pancakes.mesh.migration.epoch import is_out_of_reach
from pancakes.mesh.migration.event import ClaimHeard
from pancakes.mesh.migration.guarded_task import is_by_person
from pancakes.mesh.migration.owner import is_disputed
from pancakes.mesh.migration.record import Phase, Record, TaskId
from pancakes.mesh.migration.rest import DISK_LOST
from pancakes.mesh.migration.snapshot import Snapshot
from pancakes.mesh.net.mesh import Mesh
from pancakes.runtime.hosting.births import BirthRule, Births
from pancakes.runtime.hosting.census_messages import (
    CENSUS,
    CensusNews,
    ClaimsCame,
    CopyNoticed,
    FactsCame,
    HostBegan,
    NeighbourCame,
    Owns,
)
from pancakes.runtime.hosting.copied_tasks import CopiedTasks
from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.hosting.inquiries import Inquiries
from pancakes.runtime.hosting.last_said import LastSaid
from pancakes.runtime.hosting.machine import idle
from pancakes.runtime.hosting.place import OtherOwner, Place, Unsure
from pancakes.runtime.hosting.records import Records
from pancakes.runtime.hosting.snapshots import rules_of
from pancakes.runtime.supervision.slot import Slot


class Disputes:
    """Looks at what other agents say that they own. All in the service's actor.

    Args:
        host: the service.
        records: what this agent knows.
        mesh: says what neighbours there are.
        rule: what is to be asked before a task is born.

    Attributes:
        births: the tasks that are new here.
        copied: those that may be elsewhere, as this agent's disk is an old copy.
        inquiries: those that are to be created.
    """

    def __init__(self, host: HostingService, records: Records, mesh: Mesh, rule: BirthRule) -> None:
        self._host = host
        self._claims = Claims()
        self._told: set[TaskId] = set()  # the tasks that were told not to be born
        self._unbelieved = LastSaid()
        self.births = Births(host, records, mesh, rule, self._fault_of_teller)
        self.inquiries = Inquiries(host, mesh)
        self.copied = CopiedTasks(host, self._fault_of_teller, self._went_on)

    def begin(self) -> None:
        """The service has begun."""
        self.births.begin()
        self._host.kernel.tell(CENSUS, HostBegan(self._host))

    def heard(self, news: CensusNews) -> None:
        """The census has news."""
        match news:
            case ClaimsCame():
                self._owned(news)
            case NeighbourCame():
                self.births.came(news.peer)
            case FactsCame():
                self.births.heard(news.peer, news.told)
                self.copied.heard(news.peer, news.told)
                self.inquiries.heard(news.peer, news.told)
            case CopyNoticed():
                self.copied.noticed(news.peer)

    def unsure(self, slot: Slot, place: Place, starts: bool = True) -> Unsure | None:
        """Returns why a task does not run here now, as its agent does not know what it must know; None: it does.

        Args:
            slot: its slot.
            place: its place.
            starts: whether it is about to start; otherwise it is only looked at.
        """
        return self.copied.of(place) or self._owned_elsewhere(place, starts) or self.births.of(slot, place, starts)

    def _owned_elsewhere(self, place: Place, starts: bool) -> Unsure | None:
        """Returns why a task is not born here that another agent says it owns."""
        host, other, task_id = self._host, place.other, place.task_id
        if other is None or not place.standing.record.may_begin:
            return None
        why = (
            f"{other.peer} owns {task_id} (epoch {other.epoch}), of which {host.agent} knows nothing: its disk was"
            f" lost. It stays there; `pancakes task migrate` brings it here"
        )
        if starts and task_id not in self._told:
            self._told.add(task_id)
            host.log("warning", f"{task_id} is not born: {why}")
            host.event("not_born", task=task_id.name, owner=other.peer, epoch=other.epoch.n)
        return Unsure(DISK_LOST, why, for_good=True)

    def _owned(self, message: ClaimsCame) -> None:
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
        fault = self._host.kernel.access.fault(peer, "host", self._type_of(place))
        if not record.unborn and is_out_of_reach(claim.epoch, record.seen):
            fault = f"the epoch {claim.epoch} is further from {record.seen} than any task comes"
        if fault:
            if self._unbelieved.is_news(peer, f"{place.task_id} {fault}"):
                self._host.log("warning", f"{peer} says that it owns {place.task_id}, and is not believed: {fault}")
            return
        place.other = other
        if record.guarded and claim.epoch != record.epoch and not is_by_person(record, claim.epoch):
            # Which of them may run it the guardians decide; the lower one gives it up by itself.
            if claim.epoch < record.epoch:
                self._host.kernel.tell(CENSUS, Owns(OwnerClaim(place.task_id, record.epoch), peer))
            self._host.feed_place(place, ClaimHeard(peer, claim.epoch))
            return
        if record.phase is not Phase.OWNER:
            return
        # It may have become an owner since this agent told all what it owns.
        self._host.kernel.tell(CENSUS, Owns(OwnerClaim(place.task_id, record.epoch), peer))
        if claim.epoch < record.epoch:
            self._tell(record, other, stands_still=False)
        else:
            self._give_way(place, other)

    def look_for_owner(self, place: Place) -> None:
        """Drops a guarded task that was sent here where another agent has taken it over since.

        Not while this agent asks for pledges itself: its guardians may still decide for it.
        """
        record, claimant = place.standing.record, self.claimant(place.task_id)
        if claimant is None or claimant.epoch <= record.offer or place.taking is not None or not idle(place.standing):
            return
        try:
            guarded = rules_of(record.snapshot, place.task_id)[1].guard is not None
        except MigrationError:
            return
        if guarded and not self._host.kernel.access.fault(claimant.peer, "host", self._type_of(place)):
            self._host.log(
                "info", f"{place.task_id} runs on {claimant.peer}: what {record.peer} has sent of it is dropped"
            )
            self._host.feed_place(place, ClaimHeard(claimant.peer, claimant.epoch))

    def outvoted(self, place: Place, other: OtherOwner) -> None:
        """The guardians of a task follow another owner than this agent; `other.peer`: empty: no other agent."""
        if not other.peer or not is_by_person(place.standing.record, other.epoch):
            self._host.feed_place(place, ClaimHeard(other.peer, other.epoch))
        elif place.other != other:
            place.other = other
            self._give_way(place, other)

    def became_owner(self, place: Place) -> None:
        """This agent owns a task from now on, or under another epoch: all others are told."""
        self._host.kernel.tell(CENSUS, Owns(OwnerClaim(place.task_id, place.standing.record.epoch)))
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

    def _went_on(self, place: Place, other: OtherOwner) -> None:
        """What others know says that a task went on after the copy was made that this agent has for a disk."""
        if place.standing.record.phase is Phase.OWNER and (place.other is None or place.other.epoch < other.epoch):
            place.other = other
            self._give_way(place, other)

    def _fault_of_teller(self, peer: str, place: Place) -> str:
        """Returns why an agent is not believed what it knows of a task; empty: it may host it, or guard it."""
        access, of = self._host.kernel.access, self._type_of(place)
        return access.fault(peer, "host", of) and access.fault(peer, "guard", of)

    def _type_of(self, place: Place) -> str:
        if place.slot is not None and place.slot.spec.type:
            return place.slot.spec.type
        try:
            return Snapshot.decode(place.standing.record.snapshot).type
        except MigrationError:  # it has none, or one that cannot be read here
            return ""
