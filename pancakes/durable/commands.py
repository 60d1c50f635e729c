"""Carries out what people decide about tasks: create, remove, adopt, revive and forget.

If an agent cannot know whether a task runs elsewhere, a person decides. Each decision first says what it would mean,
and needs `force`. The answer is sent once the decision is on disk, or has failed. All in the service's actor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final, Literal

from msgspec.structs import replace

from pancakes.control import Adopt, Command, Create, Forget, Refusal, Remove, Revive
from pancakes.durable.arrivals import Arrivals
from pancakes.durable.bidding_messages import MIGRATOR, AttemptOver
from pancakes.durable.checkpoints import snapshot_of
from pancakes.durable.handoff import dispute_of, is_disputed
from pancakes.durable.handoff_events import AdoptionAsked, ForgettingAsked, GuardsChosen, RemovalAsked
from pancakes.durable.hosting import Adoption, Creation, HostingService, Place
from pancakes.durable.migration import Mover
from pancakes.durable.ownership import TaskFact, fact_of, newest_fact
from pancakes.durable.ownership_checks import Disputes, InquiryFindings
from pancakes.durable.record import MORE_THAN_MOVES, NO_EPOCH, Epoch, Lost, Phase, Record, TaskId, Wanted
from pancakes.durable.snapshot import Snapshot
from pancakes.durable.state_machine import Standing, settled
from pancakes.durable.store import MigrationReports, Records
from pancakes.errors import RETRY_S, ControlRefusedError
from pancakes.migration import MigrationReport
from pancakes.packet import Fence, agent_of, join
from pancakes.supervision.lifecycle import CLOSES, Answer, Request, State, StopAsked, request_of
from pancakes.supervision.slots import Slot
from pancakes.task import TaskSpec


def was_forgotten(record: Record) -> bool:
    """Returns whether a person has let the task rest here, after its record was lost."""
    return record.phase is Phase.ABSENT and record.seen != NO_EPOCH and not record.peer


def task_meant(
    service: str,
    name: str,
    birthplace: str,
    records: Sequence[Record],
    lost: Sequence[Lost],
    verb: str = "adopt",
) -> Record | Lost:
    """Returns what is known of the task that is to be adopted or forgotten.

    Args:
        service: address of the service that is asked.
        name: the task's name.
        birthplace: the agent that it was born on; empty: any.
        records: what the service has of tasks of this name.
        lost: those of this name whose records were lost.
        verb: what is to be done: `adopt`, or `forget`, which is for the latter, and for what another agent has brought
            and not handed over.

    Raises:
        ControlRefusedError: none of them can be meant, or several can.
    """
    meant = [record for record in records if birthplace in ("", record.task_id.birthplace)]
    found: list[Record | Lost] = [one for one in lost if birthplace in ("", one.task_id.birthplace)]
    if verb == "adopt":
        found += [record for record in meant if record.in_doubt]
        found += [record for record in meant if was_forgotten(record) or is_disputed(record)]
    else:
        found += [record for record in meant if record.phase is Phase.PREPARED]
    known = {one.task_id for one in found}
    meant = [record for record in meant if record.task_id in known or not record.unborn]
    if len(found) == 1:
        return found[0]
    if found:
        ids = " and ".join(str(one.task_id) for one in found)
        raise ControlRefusedError(f"{service} has {ids} in doubt: say which by its birthplace", "ambiguous")
    if not meant:
        raise ControlRefusedError(
            f"{service} knows of no task {name!r}" + (f" of {birthplace}" if birthplace else ""), "not_found"
        )
    stands = " and ".join(f"{record.task_id} is {_standing(record)}" for record in meant)
    raise ControlRefusedError(f"there is nothing to {verb}: {stands}")


def meaning(record: Record, me: str) -> str:
    """Returns what adopting a task would mean, for a person who has not yet said `force`."""
    task_id, peer = record.task_id, record.peer
    if is_disputed(record):
        return (
            f"{task_id} is owned by {me} (epoch {record.epoch}) and by {peer}, and rests here. By force, it runs on"
            f" {me} as it was, under an epoch that is higher than both, and stands still on {peer}."
            f" `pancakes task resolve {me}/{task_id.name}` does that, and clears it from {peer}. Nothing was done"
        )
    if record.phase is Phase.COMMITTED:
        doubt = f"{task_id} was given to {peer} (offer {record.offer}), which does not say that it has it"
    else:
        doubt = f"{task_id} rests on {me} (offer {record.offer}), and {peer} does not say whether it was given away"
    return (
        f"{doubt}. Adopted by force, it runs on {me} from the snapshot of that hand-off, under a new epoch."
        f" Where {peer} runs it, or ever comes back with its disk, there are two of it."
        f" So only where {peer} is gone for good: see that the task runs nowhere, switch {peer} off, adopt by force,"
        f" and only after that set {peer} up anew, with an empty state_dir."
        f" Otherwise wait: the hand-off goes on by itself once {peer} answers. Nothing was done"
    )


def cost_of_forgetting(record: Record, me: str) -> str:
    """Returns what dropping a task that was never handed over means, for a person who has not yet said `force`."""
    return (
        f"{record.task_id} rests on {me} (offer {record.offer}), and {record.peer} does not say whether it was given"
        f" away. Forgotten by force, it is nowhere if {record.peer} has given it away and is gone for good. Nothing was"
        f" done"
    )


def meaning_of_copy(record: Record, me: str) -> str:
    """Returns what it would mean that a task goes on from an old copy, for a person who has not yet said `force`."""
    return (
        f"{record.task_id} stands still, because the disk of {me} is an old copy: it may be elsewhere by now. By force,"
        f" it goes on on {me} from that copy (epoch {record.epoch}). Where another agent owns it, both run until they"
        f" are linked; then this one stands still, and `pancakes task resolve` decides. Nothing was done"
    )


def cost_of_revival(task_id: TaskId, me: str, checkpoint: str) -> str:
    """Returns what reviving a task would mean, for a person who has not yet said `force`.

    Args:
        task_id: the task.
        me: the agent that it is to run on.
        checkpoint: what it would go on from, as a clause; empty: it begins as its configuration says.
    """
    if checkpoint:
        loss = (
            f"{task_id} would go on on {me} from {checkpoint}: what it has done since is lost, and with it the effect"
            f" of what it has acknowledged since"
        )
    else:
        loss = (
            f"{task_id} would begin anew on {me}, as its configuration says: its state is lost, and with it the effect"
            f" of all that it has acknowledged"
        )
    return (
        f"{loss}. Packets that wait for it come here. Where the agent that had it still runs, cut off from {me}, there"
        f" are two of it until they are linked; then the other one stands still. So only where that agent is gone for"
        f" good, or off. Nothing was done"
    )


def cost_of_standing_alone(record: Record, me: str) -> str:
    """Returns what it would mean that a task goes on without its guardians, for a person who has not said `force`."""
    others = " and ".join(one.agent for one in record.guards.members() if one.agent != me) or "no other agent"
    return (
        f"{record.task_id} stands still on {me}: its guardians are {me} and {others}, and more than half do not answer."
        f" By force, it goes on as it stands, nothing is lost, and {me} alone guards it until others are chosen."
        f" Where those that are silent still run, cut off from {me}, they may have another agent run it, and there are"
        f" two of it until they are linked; then the other one stands still. So only where they are gone for good, or"
        f" off. Nothing was done"
    )


def _standing(record: Record) -> str:
    match record.phase:
        case Phase.OWNER if is_disputed(record):
            return f"here, and owned by {record.peer} too"
        case Phase.OWNER:
            return "here already"
        case Phase.RELEASED if record.removed:
            return "removed"
        case Phase.RELEASED:
            return f"with {record.peer}, which has said so"
        case Phase.FROZEN:
            return "here, and about to be handed over"
        case Phase.COMMITTED | Phase.PREPARED:
            return f"in doubt between this agent and {record.peer}, so adopt it or wait"
        case _:
            return "not here" + (f", {record.peer} had it last" if record.peer else "")


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
            ControlRefusedError: it cannot be done; the sentence says why.
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
            ControlRefusedError: it is not in doubt, the other agent is there, or the request does not say `force`.
        """
        host = self._host
        copied = [it for it in self._disputes.copied.undecided(body.target) if body.birthplace in ("", it.task_id[0])]
        if copied:
            self._adopt_copied(copied[0], body, request)
            return
        known, lost = self._known(body.target), self._lost(body.target)
        lost += self._disputes.births.undecided(body.target)
        chosen = task_meant(host.address, body.target, body.birthplace, known, lost)
        if isinstance(chosen, Record) and was_forgotten(chosen):
            chosen = Lost(chosen.task_id, f"{host.agent} was told to forget it, after its record was lost")
        if isinstance(chosen, Lost):
            self._adopt_lost(chosen, body, request)
        elif is_disputed(chosen):
            if not body.force:
                raise ControlRefusedError(meaning(chosen, host.agent), "needs_force")
            why = f"{chosen.peer}, which owns it too, is to have it no longer"
            self._run_here(chosen.task_id, AdoptionAsked(), chosen.peer, why, body.dry_run, request)
        else:
            self._adopt_doubtful(chosen, body, request)

    def _adopt_copied(self, place: Place, body: Adopt, request: Request) -> None:
        host, task_id = self._host, place.task_id
        if not body.force:
            raise ControlRefusedError(meaning_of_copy(place.standing.record, host.agent), "needs_force")
        if not body.dry_run:
            self._tell_asked("adopt", task_id, request)
            host.log("warning", f"{task_id} goes on on {host.agent}, from an old copy, as {request.by} asked")
            self._disputes.copied.decide(place)
        host.reply(request, result={"task_id": str(task_id), "peer": ""})

    def _adopt_doubtful(self, record: Record, body: Adopt, request: Request) -> None:
        host, task_id, peer = self._host, record.task_id, record.peer
        if host.kernel.actor(MIGRATOR) is None:
            raise ControlRefusedError(
                f"{task_id} is not adopted: the Network Service of {host.agent} is stopped, so it is unknown whether"
                f" {peer} is there"
            )
        if host.connected(peer):
            raise ControlRefusedError(
                f"{task_id} is not adopted: {peer} is connected, so it is not gone. The hand-off goes on by itself;"
                f" where {peer} has lost its disk, switch it off first"
            )
        if not body.force:
            raise ControlRefusedError(meaning(record, host.agent), "needs_force")
        self._run_here(task_id, AdoptionAsked(), peer, f"{peer} is gone for good", body.dry_run, request)

    def _adopt_lost(self, lost: Lost, body: Adopt, request: Request) -> None:
        host, task_id = self._host, lost.task_id
        slot = host.slots.get(task_id.name)
        if slot is not None and host.places.at[slot.name].task_id != task_id:
            raise ControlRefusedError(f"{task_id} is not adopted: {host.address} has a task named {slot.name} already")
        # What it would begin with that begins as its configuration says.
        snapshot = lost.snapshot or (host.snapshot(slot, slot.carried) if slot is not None else b"")
        if not snapshot:
            raise ControlRefusedError(
                f"{task_id} cannot be adopted: nothing is left here to run it from, for {lost.story()}."
                f" `pancakes task forget {host.agent}/{task_id.name}` lets it rest"
            )
        if not body.force:
            raise ControlRefusedError(lost.meaning(host.agent), "needs_force")
        event = AdoptionAsked(snapshot, lost.seen.n, lost.jump)
        self._run_here(task_id, event, "", f"{request.by} says that it runs nowhere else", body.dry_run, request)

    def revive(self, body: Revive, request: Request) -> None:
        """Runs a task here that a lost agent had, from a checkpoint or as its configuration says.

        Raises:
            ControlRefusedError: it is here, or may be elsewhere, it cannot run here, or the request does not say
                `force`.
        """
        host, task_id, held = self._host, TaskId.parse(body.task_id), body.checkpoint
        type_name = Snapshot.decode(held.snapshot).type if held is not None else body.type
        command = Command(request.number, request.cause, "", body)
        if fault := host.kernel.access.fault(agent_of(request.by), "host", type_name):
            raise ControlRefusedError(f"{task_id} cannot run on {host.agent}: {fault}", "unable")
        if host.state.imports_first(host, agent_of(request.by), type_name, command):
            return
        place = host.places.get(task_id) or Place(task_id, Standing(Record(task_id)))
        record, lost = place.standing.record, self._records.lost(task_id)
        stands_still = record.guarded and not host.kernel.permits.may_act(Fence(str(task_id), record.epoch))
        if record.phase is Phase.OWNER and stands_still and not is_disputed(record):
            self._stand_alone(place, body, request)
            return
        if lost is not None or record.here:
            raise ControlRefusedError(
                f"{task_id} is known on {host.agent}: see `pancakes task adopt` and `task resolve`"
            )
        other = self._disputes.claimant(task_id)
        if other is not None and host.connected(other.peer):
            raise ControlRefusedError(
                f"{task_id} is not revived: {other.peer} is connected, and owns it (epoch {other.epoch})"
            )
        snapshot = held.snapshot if held is not None else self._arrivals.as_configured(body)
        refusal = self._arrivals.cannot_build(agent_of(request.by), place, snapshot)
        if refusal or body.dry_run or not body.force:
            host.kernel.registry.unreserve(join(host.address, task_id.name))
        if refusal:
            raise ControlRefusedError(f"{task_id} cannot run on {host.agent}: {refusal.text}", refusal.code)
        if not body.force:
            raise ControlRefusedError(
                cost_of_revival(task_id, host.agent, held.story if held is not None else ""), "needs_force"
            )
        seen = max(record.seen.n, other.epoch.n if other is not None else 0, body.seen)
        event = AdoptionAsked(snapshot, seen, MORE_THAN_MOVES)
        why = f"{request.by} says that its agent is gone for good"
        self._run_here(task_id, event, "", why + (f"; from {held.story}" if held else ""), body.dry_run, request)

    def _stand_alone(self, place: Place, body: Revive, request: Request) -> None:
        """Has a task go on here whose guardians are gone for good."""
        host, record, held = self._host, place.standing.record, body.checkpoint
        if held is not None and (Epoch(*held.epoch), held.no) > (record.epoch, record.no):
            raise ControlRefusedError(
                f"{record.task_id} is on {host.agent} from an old copy of its disk, older than {held.story}: revive it"
                f" on another agent"
            )
        if not body.force:
            raise ControlRefusedError(cost_of_standing_alone(record, host.agent), "needs_force")
        ours = [one for one in record.guards.members() if one.agent == host.agent]
        guardian = host.first_guardian(place, record.snapshot) or next(iter(ours), None)
        if guardian is None:
            raise ControlRefusedError(
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
            over = AttemptOver(host, task_id, "", Refusal("conflict", adopted.reason), adopted.ledger)
            host.kernel.tell(MIGRATOR, over)
            host.event("task_adopted", task=task_id.name, peer=adopted.peer, epoch=record.epoch.n)
            if why_not:
                why_not = f"{task_id} belongs to {host.agent} now, but does not run: {why_not}"
        done = {"task_id": str(task_id), "peer": adopted.peer}
        host.reply(adopted.request, Refusal.if_any(why_not), done if not why_not else None)

    def forget(self, body: Forget, request: Request) -> None:
        """Lets a task rest here, on a person's word that it runs elsewhere, or drops what was never handed over.

        Raises:
            ControlRefusedError: its record was not lost and no other agent owns it, it runs, several can be meant, or
                the agent that has brought it is there, or the request does not say `force`.
        """
        if body.owner:
            self._give_up(body, request)
            return
        host = self._host
        known, lost_ones = self._known(body.target), self._lost(body.target)
        lost_ones += self._disputes.births.undecided(body.target)
        lost = task_meant(host.address, body.target, body.birthplace, known, lost_ones, "forget")
        task_id = lost.task_id
        if isinstance(lost, Record):
            if host.connected(lost.peer):
                why = f"{lost.peer} is connected, and says what becomes of it"
                raise ControlRefusedError(f"{task_id} is not forgotten: {why}")
            if not body.force:
                raise ControlRefusedError(cost_of_forgetting(lost, host.agent), "needs_force")
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
            raise ControlRefusedError(f"{host.address} owns no task {body.target!r}", "not_found")
        place = ours[0]
        record, task_id = place.standing.record, place.task_id
        if not is_disputed(record) and (place.other is None or place.other.peer != body.owner):
            raise ControlRefusedError(f"{task_id} is owned by {host.agent} alone, as far as {host.agent} knows")
        runs = record.wanted is Wanted.RUNNING or (place.slot is not None and not place.slot.life.at_rest)
        if body.dry_run:
            told = {"task_id": str(task_id), "epoch": str(record.epoch), "runs": runs}
            host.reply(request, result=told)
            return
        if runs:
            raise ControlRefusedError(f"{task_id} runs on {host.agent}: stop it there first")
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
                host.reply(request, Refusal("failed", f"{task_id} is not forgotten: {why_not}"))
                continue
            host.log("warning", f"{task_id} was forgotten on {host.agent}, as {request.by} asked: it rests here")
            host.event("task_forgotten", task=task_id.name)
            host.reply(request, result={"task_id": str(task_id)})

    def _place(self, task_id: TaskId) -> Place:
        """Returns the place of a task that is to be decided about.

        Raises:
            ControlRefusedError: a decision about it is being written down.
        """
        place = self._host.places[task_id]
        if place.adoption is not None or place.forgetting:
            raise ControlRefusedError(
                f"{task_id} has just been decided about, and that is not written down yet", "busy"
            )
        return place

    def _tell_asked(self, what: str, task_id: TaskId, request: Request) -> None:
        host = self._host
        host.event("asked", what=what, task=task_id.name, service=host.name, by=request.by, number=request.number)


Described = Callable[[str, Mapping[str, Any]], TaskSpec]
"""Takes the name of a task and its table; returns how to start it, or raises `ControlRefusedError`."""

LET_GO_S: Final = 5.0
"""An asker is told that a removal waits for guardians that have not let go after so long, in host seconds."""
NOT_ITS_KEYS: Final = ("type", "service", "start", "settings", "rate_hz", "name")
"""Keys of a table `[task.NAME]` that a request to create a task says elsewhere, or cannot say."""


class Creations:
    """Carries out `Create` and `Remove` for one service. All in that service's actor.

    Args:
        host: the service.
        records: knows of tasks whose records were lost.
        arrivals: sees whether a task can be built here.
        disputes: knows what other agents own, and asks them.
        ledgers: the account of what was done.
        described: reads the table of a task.
    """

    def __init__(
        self,
        host: HostingService,
        records: Records,
        arrivals: Arrivals,
        disputes: Disputes,
        ledgers: MigrationReports,
        described: Described,
    ) -> None:
        self._host = host
        self._records = records
        self._arrivals = arrivals
        self._disputes = disputes
        self._ledgers = ledgers
        self._described = described

    # Creating --------------------------------------------------------------------------------------------------

    def create(self, body: Create, request: Request) -> None:
        """Makes a task; the answer comes once it runs.

        Raises:
            ControlRefusedError: it is here, or may be elsewhere, or cannot run here.
        """
        host, task_id = self._host, TaskId(self._host.agent, body.target)
        command = Command(request.number, request.cause, "", body)
        if fault := host.kernel.access.fault(agent_of(request.by), "host", body.type):
            raise ControlRefusedError(f"{task_id.name} cannot run on {host.agent}: {fault}", "unable")
        if host.state.imports_first(host, agent_of(request.by), body.type, command):
            return
        self._refuse_known(task_id)
        spec = self._spec(body)
        asked = Creation(request, spec, self._first_snapshot(spec, task_id), body.dry_run)
        self._refuse_unfit(task_id, asked)
        self._unreserve(task_id)  # until the others have answered
        self._disputes.inquiries.begin(task_id, spec.type, partial(self._asked, task_id, asked))

    def _spec(self, body: Create) -> TaskSpec:
        if key := next((key for key in body.keys if key in NOT_ITS_KEYS), ""):
            raise ControlRefusedError(
                f"[task.{body.target}] {key}: is none of the other keys; see `pancakes task create`", "invalid"
            )
        table: dict[str, Any] = {"service": self._host.name, "settings": dict(body.settings), **body.keys}
        if body.type:
            table["type"] = body.type
        if body.rate_hz is not None:
            table["rate_hz"] = body.rate_hz
        return self._described(body.target, table)

    def _first_snapshot(self, spec: TaskSpec, task_id: TaskId) -> bytes:
        host = self._host
        return snapshot_of(spec, task_id, host.name, None).encode()

    def _refuse_known(self, task_id: TaskId) -> None:
        """Raises `ControlRefusedError` where there is such a task here, or is about to be."""
        host = self._host
        if host.closing:
            raise ControlRefusedError(f"{host.address} ends: {CLOSES}", "busy")
        if (slot := host.slots.get(task_id.name)) is not None:
            raise ControlRefusedError(f"{slot.address} is there already, and {slot.life.word}: choose another name")
        if self._disputes.inquiries.about(task_id) or self._place(task_id).creation is not None:
            raise ControlRefusedError(f"{task_id} is being created already", "busy")
        if lost := self._records.lost(task_id):
            raise ControlRefusedError(lost.undecided(host.agent))
        if self._records.service_of(task_id) not in ("", host.name):
            service = self._records.service_of(task_id)
            raise ControlRefusedError(f"{host.agent} has a record of {task_id} in its service {service!r}")
        if (record := self._place(task_id).standing.record).here:
            raise ControlRefusedError(f"{task_id} is {record.phase.value} here: see `pancakes task list {host.agent}`")

    def _refuse_unfit(self, task_id: TaskId, asked: Creation) -> None:
        """Raise `ControlRefusedError` if a task cannot run here now. What it needs is kept for it until it begins."""
        host, place = self._host, self._place(task_id)
        refusal = self._arrivals.cannot_build(agent_of(asked.request.by), place, asked.snapshot)
        if not refusal and (lacking := host.kernel.registry.lacking(asked.spec.cls.requires)):
            lacks = f"{host.agent} lacks the device types {', '.join(lacking)}, which {task_id.name} requires"
            refusal = Refusal("unable", lacks)
        if refusal:
            self._unreserve(task_id)
            raise ControlRefusedError(f"{task_id.name} cannot run on {host.agent}: {refusal.text}", refusal.code)

    def _unreserve(self, task_id: TaskId) -> None:
        self._host.kernel.registry.unreserve(join(self._host.address, task_id.name))

    def _asked(self, task_id: TaskId, asked: Creation, found: InquiryFindings) -> None:
        """The other agents have said what they know of the task."""
        host, place = self._host, self._place(task_id)
        try:
            self._refuse_known(task_id)  # what has come meanwhile
            seen = self._seen(task_id, place.standing.record, found)
            self._refuse_unfit(task_id, asked)
        except ControlRefusedError as error:
            host.reply(asked.request, Refusal.of(error))
            return
        jump = MORE_THAN_MOVES if asked.spec.guard is not None else 1  # a guardian that was away may know a later epoch
        if asked.dry_run:
            self._unreserve(task_id)
            host.reply(asked.request, result=_result(task_id, seen + jump, found.silent))
            return
        self._tell_asked("create", task_id, asked.request)
        if found.silent:
            silent = ", ".join(found.silent)
            host.log("warning", f"{task_id} is created, although nothing was heard of it from {silent}")
        place = host.places[task_id]
        place.creation = replace(asked, silent=tuple(found.silent))
        host.look_after(place, asked.request)
        guardian = host.first_guardian(place, asked.snapshot)
        host.feed_place(place, AdoptionAsked(asked.snapshot, seen, jump, guardian))

    def _seen(self, task_id: TaskId, record: Record, found: InquiryFindings) -> int:
        """Returns the highest number of an epoch that is known of a task that is nowhere.

        Raises:
            ControlRefusedError: it may be somewhere.
        """
        own = fact_of(self._host.agent, record)
        newest = newest_fact([own, *found.facts])
        other = self._disputes.claimant(task_id)
        if other is not None and (newest is None or other.epoch > newest.epoch):
            newest = TaskFact(task_id, other.peer, other.epoch)
        if newest is None:
            return 0
        if not newest.removed:
            raise ControlRefusedError(self._elsewhere(newest))
        return max(record.seen.n, newest.epoch.n)

    def _elsewhere(self, fact: TaskFact) -> str:
        task_id, owner = fact.task_id, fact.owner
        if not owner:
            return f"{task_id} was there before (epoch {fact.epoch}), and where it is is not known: choose another name"
        text = f"{task_id} is on {owner} (epoch {fact.epoch})"
        if self._host.connected(owner):
            return f"{text}: choose another name, or end that one with `pancakes task remove {owner}/{task_id.name}`"
        return f"{text}, as far as is known, and {owner} is not connected: choose another name, or connect {owner}"

    def begun(self, place: Place, asked: Creation, why_not: str) -> None:
        """The start of a task that was created is decided: answers the request."""
        place.creation = None
        host, task_id, record = self._host, place.task_id, place.standing.record
        if record.phase is not Phase.OWNER:
            self._unreserve(task_id)
            host.reply(
                asked.request, Refusal("failed", f"{task_id} is not created: {place.standing.trouble or why_not}")
            )
            return
        host.log("info", f"{task_id} was created on {host.agent}, as {asked.request.by} asked")
        told = {"task": task_id.name, "type": asked.spec.type, "epoch": record.epoch.n}
        host.event("task_created", **told, by=asked.request.by, number=asked.request.number)
        self._account(task_id, asked.request, "created", host.agent)
        if why_not:
            remove = f"`pancakes task remove {host.agent}/{task_id.name}` ends it"
            host.reply(
                asked.request, Refusal("unable", f"{task_id} was created, and does not run: {why_not}. {remove}")
            )
        else:
            host.reply(asked.request, result=_result(task_id, record.epoch.n, asked.silent))

    # Removing --------------------------------------------------------------------------------------------------

    def remove(self, slot: Slot, body: Remove, request: Request) -> None:
        """Ends a task for good; the answer comes once that is on disk.

        Raises:
            ControlRefusedError: a configuration file names it, or it is not known whether it is here alone.
        """
        host, place = self._host, self._host.places.at[slot.name]
        self._refuse_removal(slot, place)
        if body.dry_run:
            host.reply(request, result={"task_id": str(place.task_id)})
            return
        self._tell_asked("remove", place.task_id, request)
        place.removal = request
        host.look_after(place, request)
        if slot.life.state is State.STOPPED:
            self._go_on(place)
        else:
            host.feed_place(place, StopAsked(request, f"removed, as {request.by} asked"))

    def _refuse_removal(self, slot: Slot, place: Place) -> None:
        host, task_id, record = self._host, place.task_id, place.standing.record
        if task_id.birthplace == host.agent and slot.name in host.residents:
            raise ControlRefusedError(
                f"{slot.address} is in the configuration of {host.agent}: take [task.{slot.name}] out of its file,"
                f" start {host.agent} anew, and remove it then; until then, `pancakes task stop` stops it"
            )
        if not slot.spec.created:
            raise ControlRefusedError(
                f"{task_id} was born from the configuration of {task_id.birthplace}, and whether that still names it is"
                f" known there: move it to {task_id.birthplace}, and remove it there; until then, `pancakes task stop`"
                " stops it"
            )
        if is_disputed(record):
            raise ControlRefusedError(dispute_of(host.agent, record))
        if place.unsure.why:
            raise ControlRefusedError(place.unsure.why)
        if place.removal is not None or place.adoption is not None or place.forgetting:
            raise ControlRefusedError(
                f"{task_id} has just been decided about, and that is not written down yet", "busy"
            )

    def has_stopped(self, place: Place, answer: Answer) -> bool:
        """A task was stopped as was asked, or could not be.

        Returns:
            Whether it was stopped so that it can be removed, and the answer is to wait for that.
        """
        if place.removal != answer.asker:
            return False
        if answer.reason:
            place.removal = None  # it is stuck, say
            return False
        if place.slot is not None:
            waiting, place.slot.commands = place.slot.commands, ()
            for command in waiting:
                self._host.reply(request_of(command), Refusal("busy", f"{place.task_id} is being removed", RETRY_S))
        self._go_on(place)
        return True

    def lasts(self, place: Place, request: Request, why_not: str) -> None:
        """All that was decided about a task that is to be removed is on disk, or cannot be."""
        host, task_id = self._host, place.task_id
        if place.standing.record.removed:
            place.removal = None
            host.log("info", f"{task_id} was removed from {host.agent}, as {request.by} asked")
            host.event("task_removed", task=task_id.name, by=request.by, number=request.number)
            self._account(task_id, request, "removed", "")
            host.reply(request, result={"task_id": str(task_id)})
        elif why_not:
            place.removal = None
            host.reply(request, Refusal("failed", f"{task_id} is not removed: {why_not}"))
        else:
            self._go_on(place)

    def _go_on(self, place: Place) -> None:
        """Writes down that a task is nowhere, once it stands still and that is on disk."""
        slot, record = place.slot, place.standing.record
        if place.removal is None or slot is None or not (slot.life.at_rest and settled(place.standing)):
            return
        if self._guardians(record):
            # The guardians of a guarded task let go of it first: else one that was away might have it run once more.
            self._host.after_host(LET_GO_S, partial(self._tell_waiting, place, place.removal))
        else:
            self._host.feed_place(place, RemovalAsked())

    def _guardians(self, record: Record) -> list[str]:
        """Returns the other agents that guard a task."""
        return sorted({one.agent for one in record.guards.members()} - {self._host.agent})

    def _tell_waiting(self, place: Place, request: Request) -> None:
        if place.removal == request and self._host.waits(request):
            guardians = " and ".join(self._guardians(place.standing.record))
            text = f"{place.task_id} stands still, and is removed once more than half of its guardians let go of it"
            self._host.put_off(request, f"{text} ({guardians})")

    # ----------------------------------------------------------------------------------------------------------

    def _place(self, task_id: TaskId) -> Place:
        """Returns the place of a task, without keeping one for a task of which nothing is known."""
        return self._host.places.get(task_id) or Place(task_id, Standing(Record(task_id)))

    def _account(self, task_id: TaskId, request: Request, outcome: Literal["created", "removed"], winner: str) -> None:
        account = MigrationReport(str(task_id), self._host.agent, request.by, "", outcome, winner, (), 0.0)
        self._ledgers.add(account, "", self._host.kernel.mission.now())

    def _tell_asked(self, what: str, task_id: TaskId, request: Request) -> None:
        host = self._host
        host.event("asked", what=what, task=task_id.name, service=host.name, by=request.by, number=request.number)


def _result(task_id: TaskId, epoch_n: int, silent: Sequence[str]) -> dict[str, Any]:
    return {"task_id": str(task_id), "epoch": epoch_n, "silent": list(silent)}
