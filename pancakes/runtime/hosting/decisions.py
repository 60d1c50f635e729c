"""What a person decides about tasks of which their agent cannot know by itself where they are: adopt, or forget."""

from __future__ import annotations

from msgspec.structs import replace

from pancakes.control import Adopt, Command, Forget, Revive
from pancakes.errors import ControlRefused
from pancakes.mesh.migration.epoch import MORE_THAN_MOVES, NO_EPOCH, Epoch
from pancakes.mesh.migration.event import AdoptionAsked, ForgettingAsked, GuardsChosen
from pancakes.mesh.migration.owner import is_disputed
from pancakes.mesh.migration.record import Phase, Record, TaskId, Wanted
from pancakes.mesh.migration.snapshot import Snapshot
from pancakes.packet import Fence, agent_of, join
from pancakes.runtime.hosting import adoption
from pancakes.runtime.hosting.arrivals import Arrivals
from pancakes.runtime.hosting.bidding_messages import MIGRATOR, AttemptOver
from pancakes.runtime.hosting.disputes import Disputes
from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.hosting.lost import Lost
from pancakes.runtime.hosting.mover import Mover
from pancakes.runtime.hosting.place import Adoption, Place
from pancakes.runtime.hosting.records import Records
from pancakes.runtime.hosting.standing import Standing
from pancakes.runtime.life.request import Request


class Decisions:
    """Carries out `Adopt`, `Forget` and `Revive` for one service. All in that service's actor.

    Args:
        host: the service.
        records: knows of tasks whose records were lost.
        mover: looks after their moves.
        arrivals: builds what is revived.
        disputes: knows what other agents own.
    """

    def __init__(
        self, host: HostingService, records: Records, mover: Mover, arrivals: Arrivals, disputes: Disputes
    ) -> None:
        self._host = host
        self._records = records
        self._mover = mover
        self._arrivals = arrivals
        self._disputes = disputes

    def _known(self, name: str) -> list[Record]:
        return [place.standing.record for place in self._host.places.named(name)]

    def _lost(self, name: str) -> list[Lost]:
        return [
            lost
            for lost in self._records.all_lost()
            if lost.task_id.name == name and self._records.decider_of(lost) == self._host.name
        ]

    def carry_out(self, body: Adopt | Forget | Revive, request: Request) -> None:
        """Carries out what a person has decided.

        Raises:
            ControlRefused: it cannot be done; the sentence says why.
        """
        match body:
            case Adopt():
                self.adopt(body, request)
            case Forget():
                self.forget(body, request)
            case Revive():
                self.revive(body, request)

    def adopt(self, body: Adopt, request: Request) -> None:
        """Runs a task here, on a person's word.

        Raises:
            ControlRefused: it is not in doubt, the other agent is there, or the request does not say `force`.
        """
        host = self._host
        copied = [it for it in self._disputes.copied.undecided(body.target) if body.birthplace in ("", it.task_id[0])]
        if copied:
            self._adopt_copied(copied[0], body, request)
            return
        known, lost = self._known(body.target), self._lost(body.target)
        lost += self._disputes.births.undecided(body.target)
        chosen = adoption.chosen(host.address, body.target, body.birthplace, known, lost)
        if isinstance(chosen, Record) and adoption.was_forgotten(chosen):
            chosen = Lost(chosen.task_id, f"{host.agent} was told to forget it, after its record was lost")
        if isinstance(chosen, Lost):
            self._adopt_lost(chosen, body, request)
        elif is_disputed(chosen):
            if not body.force:
                raise ControlRefused(adoption.meaning(chosen, host.agent))
            why = f"{chosen.peer}, which owns it too, is to have it no longer"
            self._run_here(chosen.task_id, AdoptionAsked(), chosen.peer, why, body.dry_run, request)
        else:
            self._adopt_doubtful(chosen, body, request)

    def _adopt_copied(self, place: Place, body: Adopt, request: Request) -> None:
        host, task_id = self._host, place.task_id
        if not body.force:
            raise ControlRefused(adoption.meaning_of_copy(place.standing.record, host.agent))
        if not body.dry_run:
            self._tell_asked("adopt", task_id, request)
            host.log("warning", f"{task_id} goes on on {host.agent}, from an old copy, as {request.by} asked")
            self._disputes.copied.decide(place)
        host.reply(request, result={"task_id": str(task_id), "peer": ""})

    def _adopt_doubtful(self, record: Record, body: Adopt, request: Request) -> None:
        host, task_id, peer = self._host, record.task_id, record.peer
        if host.kernel.actor(MIGRATOR) is None:
            raise ControlRefused(
                f"{task_id} is not adopted: the Network Service of {host.agent} is stopped, so it is unknown whether"
                f" {peer} is there"
            )
        if host.connected(peer):
            raise ControlRefused(
                f"{task_id} is not adopted: {peer} is connected, so it is not gone. The hand-off goes on by itself;"
                f" where {peer} has lost its disk, switch it off first"
            )
        if not body.force:
            raise ControlRefused(adoption.meaning(record, host.agent))
        self._run_here(task_id, AdoptionAsked(), peer, f"{peer} is gone for good", body.dry_run, request)

    def _adopt_lost(self, lost: Lost, body: Adopt, request: Request) -> None:
        host, task_id = self._host, lost.task_id
        slot = host.slots.get(task_id.name)
        if slot is not None and host.places.at[slot.name].task_id != task_id:
            raise ControlRefused(f"{task_id} is not adopted: {host.address} has a task named {slot.name} already")
        # What it would begin with that begins as its configuration says.
        snapshot = lost.snapshot or (host.snapshot(slot, slot.carried) if slot is not None else b"")
        if not snapshot:
            raise ControlRefused(
                f"{task_id} cannot be adopted: nothing is left here to run it from, for {lost.story()}."
                f" `pancakes task forget {host.agent}/{task_id.name}` lets it rest"
            )
        if not body.force:
            raise ControlRefused(lost.meaning(host.agent))
        event = AdoptionAsked(snapshot, lost.seen.n, lost.jump)
        self._run_here(task_id, event, "", f"{request.by} says that it runs nowhere else", body.dry_run, request)

    def revive(self, body: Revive, request: Request) -> None:
        """Runs a task here that a lost agent had, from a checkpoint or as its configuration says.

        Raises:
            ControlRefused: it is here, or may be elsewhere, it cannot run here, or the request does not say `force`.
        """
        host, task_id, held = self._host, TaskId.parse(body.task_id), body.checkpoint
        type_name = Snapshot.decode(held.snapshot).type if held is not None else body.type
        command = Command(request.number, request.cause, "", body)
        if fault := host.kernel.access.fault(agent_of(request.by), "host", type_name):
            raise ControlRefused(f"{task_id} cannot run on {host.agent}: {fault}")
        if host.state.imports_first(host, agent_of(request.by), type_name, command):
            return
        place = host.places.get(task_id) or Place(task_id, Standing(Record(task_id)))
        record, lost = place.standing.record, self._records.lost(task_id)
        stands_still = record.guarded and not host.kernel.permits.may_act(Fence(str(task_id), record.epoch))
        if record.phase is Phase.OWNER and stands_still and not is_disputed(record):
            self._stand_alone(place, body, request)
            return
        if lost is not None or record.here:
            raise ControlRefused(f"{task_id} is known on {host.agent}: see `pancakes task adopt` and `task resolve`")
        other = self._disputes.claimant(task_id)
        if other is not None and host.connected(other.peer):
            raise ControlRefused(
                f"{task_id} is not revived: {other.peer} is connected, and owns it (epoch {other.epoch})"
            )
        snapshot = held.snapshot if held is not None else self._arrivals.as_configured(body)
        refusal = self._arrivals.cannot_build(agent_of(request.by), place, snapshot)
        if refusal or body.dry_run or not body.force:
            host.kernel.registry.unreserve(join(host.address, task_id.name))
        if refusal:
            raise ControlRefused(f"{task_id} cannot run on {host.agent}: {refusal}")
        if not body.force:
            raise ControlRefused(adoption.cost_of_revival(task_id, host.agent, held.story if held is not None else ""))
        seen = max(record.seen.n, other.epoch.n if other is not None else 0, body.seen)
        event = AdoptionAsked(snapshot, seen, MORE_THAN_MOVES)
        why = f"{request.by} says that its agent is gone for good"
        self._run_here(task_id, event, "", why + (f"; from {held.story}" if held else ""), body.dry_run, request)

    def _stand_alone(self, place: Place, body: Revive, request: Request) -> None:
        """Has a task go on here whose guardians are gone for good."""
        host, record, held = self._host, place.standing.record, body.checkpoint
        if held is not None and (Epoch(*held.epoch), held.no) > (record.epoch, record.no):
            raise ControlRefused(
                f"{record.task_id} is on {host.agent} from an old copy of its disk, older than {held.story}: revive it"
                f" on another agent"
            )
        if not body.force:
            raise ControlRefused(adoption.cost_of_standing_alone(record, host.agent))
        ours = [one for one in record.guards.members() if one.agent == host.agent]
        guardian = host.first_guardian(place, record.snapshot) or next(iter(ours), None)
        if guardian is None:
            raise ControlRefused(
                f"{record.task_id} is to be guarded no longer, and {host.agent} is none of its guardians"
            )
        if body.dry_run:
            host.reply(request, result={"task_id": str(record.task_id), "peer": ""})
            return
        reason = f"{record.task_id} goes on on {host.agent}, as {request.by} says that its guardians are gone for good"
        self._decide(place, Adoption(request, "", reason, None, as_it_stands=True))
        host.feed_place(place, GuardsChosen(((guardian,),), MORE_THAN_MOVES, body.seen))

    def _run_here(
        self, task_id: TaskId, event: AdoptionAsked, peer: str, why: str, dry_run: bool, request: Request
    ) -> None:
        host = self._host
        if dry_run:
            host.reply(request, result={"task_id": str(task_id), "peer": peer})
            return
        place = self._place(task_id)
        reason = f"{task_id} was adopted on {host.agent}, as {request.by} asked, because {why}"
        self._decide(place, Adoption(request, peer, reason, self._mover.sequel_of(place.standing.record).ledger))
        host.feed_place(place, replace(event, guardian=host.first_guardian(place, event.snapshot)))

    def _decide(self, place: Place, adoption: Adoption) -> None:
        self._tell_asked("adopt", place.task_id, adoption.request)
        self._host.log("warning", adoption.reason)
        place.adoption = adoption
        self._host.look_after(place, adoption.request)

    def started(self, place: Place, adopted: Adoption, why_not: str) -> None:
        """The start of a task is decided: answers the request to adopt it."""
        place.adoption = None
        host, task_id = self._host, place.task_id
        record = place.standing.record
        if record.phase is Phase.OWNER:
            # The asker of the move that was in doubt has waited for this.
            host.kernel.tell(MIGRATOR, AttemptOver(host, task_id, "", adopted.reason, adopted.ledger))
            host.event("task_adopted", task=task_id.name, peer=adopted.peer, epoch=record.epoch.n)
            if why_not:
                why_not = f"{task_id} belongs to {host.agent} now, but does not run: {why_not}"
        done = {"task_id": str(task_id), "peer": adopted.peer}
        host.reply(adopted.request, why_not, done if not why_not else None)

    def forget(self, body: Forget, request: Request) -> None:
        """Lets a task rest here, on a person's word that it runs elsewhere, or drops what was never handed over.

        Raises:
            ControlRefused: its record was not lost and no other agent owns it, it runs, several can be meant, or the
                agent that has brought it is there, or the request does not say `force`.
        """
        if body.owner:
            self._give_up(body, request)
            return
        host = self._host
        known, lost_ones = self._known(body.target), self._lost(body.target)
        lost_ones += self._disputes.births.undecided(body.target)
        lost = adoption.chosen(host.address, body.target, body.birthplace, known, lost_ones, "forget")
        task_id = lost.task_id
        if isinstance(lost, Record):
            if host.connected(lost.peer):
                why = f"{lost.peer} is connected, and says what becomes of it"
                raise ControlRefused(f"{task_id} is not forgotten: {why}")
            if not body.force:
                raise ControlRefused(adoption.cost_of_forgetting(lost, host.agent))
        if body.dry_run:
            host.reply(request, result={"task_id": str(task_id)})
            return
        place = self._place(task_id)
        self._tell_asked("forget", task_id, request)
        place.forgetting = (request,)
        host.look_after(place, request)
        offer = lost.offer if isinstance(lost, Record) else NO_EPOCH
        host.feed_place(place, ForgettingAsked(lost.seen if isinstance(lost, Lost) else NO_EPOCH, offer=offer))

    def _give_up(self, body: Forget, request: Request) -> None:
        host = self._host
        ours = [
            place
            for place in host.places.named(body.target)
            if place.standing.record.phase is Phase.OWNER and body.birthplace in ("", place.task_id.birthplace)
        ]
        if not ours:
            raise ControlRefused(f"{host.address} owns no task {body.target!r}")
        place = ours[0]
        record, task_id = place.standing.record, place.task_id
        if not is_disputed(record) and (place.other is None or place.other.peer != body.owner):
            raise ControlRefused(f"{task_id} is owned by {host.agent} alone, as far as {host.agent} knows")
        runs = record.wanted is Wanted.RUNNING or (place.slot is not None and not place.slot.life.at_rest)
        if body.dry_run:
            told = {"task_id": str(task_id), "epoch": str(record.epoch), "runs": runs}
            host.reply(request, result=told)
            return
        if runs:
            raise ControlRefused(f"{task_id} runs on {host.agent}: stop it there first")
        place = self._place(task_id)
        self._tell_asked("forget", task_id, request)
        place.forgetting = (request,)
        host.look_after(place, request)
        host.feed_place(place, ForgettingAsked(record.seen, body.owner))

    def written(self, place: Place, why_not: str) -> None:
        """All that was decided about a task is on disk, or cannot be: answers the requests that waited for that."""
        if place.adoption is not None and place.adoption.as_it_stands:
            self.started(place, place.adoption, why_not)
        asked, place.forgetting = place.forgetting, ()
        host, task_id = self._host, place.task_id
        for request in asked:
            if why_not:
                host.reply(request, f"{task_id} is not forgotten: {why_not}")
                continue
            host.log("warning", f"{task_id} was forgotten on {host.agent}, as {request.by} asked: it rests here")
            host.event("task_forgotten", task=task_id.name)
            host.reply(request, result={"task_id": str(task_id)})

    def _place(self, task_id: TaskId) -> Place:
        """Returns the place of a task that is to be decided about.

        Raises:
            ControlRefused: a decision about it is being written down.
        """
        place = self._host.places[task_id]
        if place.adoption is not None or place.forgetting:
            raise ControlRefused(f"{task_id} has just been decided about, and that is not written down yet")
        return place

    def _tell_asked(self, what: str, task_id: TaskId, request: Request) -> None:
        host = self._host
        host.event("asked", what=what, task=task_id.name, service=host.name, by=request.by, number=request.number)
