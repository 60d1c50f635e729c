"""Carries out what people decide about tasks: create, remove, recover.

If an agent cannot know whether a task runs elsewhere, a person decides; `pancakes task recover` says what that would
mean. The answer is sent once the decision is on disk, or has failed. All in the service's actor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal

from msgspec.structs import replace

from pancakes.control import Adopt, Command, Create, Forget, Refusal, Remove, Revive
from pancakes.durable.answers import fact_of, newest_fact
from pancakes.durable.arrivals import Arrivals
from pancakes.durable.bidding_messages import MIGRATOR, AttemptOver
from pancakes.durable.checkpoints import snapshot_of
from pancakes.durable.hosting import Creation, OtherOwner, Place, Recovery
from pancakes.durable.messages import Fact
from pancakes.durable.migration import Mover
from pancakes.durable.questions import Disputes
from pancakes.durable.reconcile import Outcome, Removed
from pancakes.durable.record import Lost, Record, TaskId, dispute_of, why_not_here
from pancakes.durable.register import MORE_THAN_MIGRATIONS, NO_EPOCH, NOBODY, Epoch, Register, Standing, Wanted
from pancakes.durable.rules import Begin, Desired, Force, Leave, Want
from pancakes.durable.snapshot import Snapshot
from pancakes.durable.store import MigrationReports, Records
from pancakes.errors import RETRY_S, ControlRefusedError
from pancakes.migration import MigrationReport
from pancakes.packet import agent_of, join
from pancakes.supervision.lifecycle import CLOSES, Answer, Request, State, StopAsked, request_of
from pancakes.supervision.slots import Slot
from pancakes.task import TaskSpec

if TYPE_CHECKING:
    from pancakes.durable.client_service import ClientServiceCore


def was_forgotten(record: Record) -> bool:
    """Return whether a person has let the task rest here, after its record was lost."""
    return record.standing is Standing.RELEASED and not record.removed and record.epoch.minter == NOBODY


def has_moved(record: Record) -> bool:
    """Return whether the task was handed over to another agent, which has said that it has it."""
    return record.standing is Standing.RELEASED and not record.removed and record.peer != ""


def task_meant(
    service: str,
    name: str,
    birthplace: str,
    records: Sequence[Record],
    lost: Sequence[Lost],
    verb: str = "adopt",
) -> Record | Lost:
    """Return what is known of the task to be adopted or forgotten.

    Args:
        service: address of the service that is asked.
        name: the task's name.
        birthplace: the agent that it was born on; empty: any.
        records: what the service has of tasks of this name.
        lost: those of this name whose records were lost.
        verb: what to do: `adopt`, or `forget`, which is for the latter, and for what another agent has brought
            and not handed over.

    Raises:
        ControlRefusedError: none of them can be meant, or several can.
    """
    meant = [record for record in records if birthplace in ("", record.task_id.birthplace)]
    found: list[Record | Lost] = [one for one in lost if birthplace in ("", one.task_id.birthplace)]
    if verb == "adopt":
        found += [record for record in meant if record.in_doubt]
        found += [record for record in meant if was_forgotten(record) or record.disputed]
        found = found or [record for record in meant if has_moved(record)]
    else:
        found += [record for record in meant if record.standing is Standing.HEIR]
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
    raise ControlRefusedError(f"there is nothing to {verb}: {' and '.join(map(why_not_here, meant))}")


class Recoveries:
    """Carries out `Adopt`, `Forget` and `Revive` for one service. All in that service's actor.

    Args:
        host: the service.
        records: knows of tasks whose records were lost.
        mover: looks after their moves.
        arrivals: builds what is revived.
        disputes: knows what other agents own.
    """

    def __init__(
        self, host: ClientServiceCore, records: Records, mover: Mover, arrivals: Arrivals, disputes: Disputes
    ) -> None:
        self._host = host
        self._records = records
        self._mover = mover
        self._arrivals = arrivals
        self._disputes = disputes

    def _known(self, name: str) -> list[Record]:
        return [place.record for place in self._host.places.named(name)]

    def _lost(self, name: str) -> list[Lost]:
        return [
            lost
            for lost in self._records.all_lost()
            if lost.task_id.name == name and self._records.decider_of(lost) == self._host.name
        ]

    def adopt(self, body: Adopt, request: Request) -> None:
        """Runs a task here, on a person's word.

        Raises:
            ControlRefusedError: it is not in doubt, or the other agent is there.
        """
        host = self._host
        for place in self._disputes.copied.undecided(body.target):
            if not place.record.disputed and body.birthplace in ("", place.task_id.birthplace):
                record, why = place.record, f"{request.by} says that it runs nowhere else"
                self._run_here(place.task_id, record.snapshot, record.seen.n, "", why, body.dry_run, request)
                return
        known, lost = self._known(body.target), self._lost(body.target)
        lost += self._disputes.births.undecided(body.target)
        chosen = task_meant(host.address, body.target, body.birthplace, known, lost)
        if isinstance(chosen, Record) and was_forgotten(chosen):
            chosen = Lost(chosen.task_id, f"{host.agent} was told to forget it, after its record was lost")
        if isinstance(chosen, Lost):
            self._adopt_lost(chosen, body, request)
        elif chosen.disputed:
            why = "the other agent that owns it is to have it no longer"
            other = self._disputes.claimant(chosen.task_id)
            peer, seen = (other.peer, other.epoch) if other is not None else ("", chosen.seen)
            seen_n = max(seen, chosen.seen).n
            self._run_here(chosen.task_id, chosen.snapshot, seen_n, peer, why, body.dry_run, request)
        elif has_moved(chosen):
            self._adopt_moved(chosen, body, request)
        else:
            self._adopt_doubtful(chosen, body, request)

    def _adopt_moved(self, record: Record, body: Adopt, request: Request) -> None:
        """Runs a task that has left with all of its state; a dry run tells where to, also if it could not run here."""
        host, task_id = self._host, record.task_id
        self._refuse_if_owned(task_id, "adopted")
        if body.dry_run:
            bound = host.places.at.get(task_id.name)
            runs = bound is not None and bound.task_id == task_id
            host.reply(request, result={"task_id": str(task_id), "peer": record.peer, "moved": True, "runs": runs})
            return
        self._adopt_lost(Lost(task_id, f"{host.agent} gave it to {record.peer}", heard=record.seen), body, request)

    def _adopt_doubtful(self, record: Record, body: Adopt, request: Request) -> None:
        host, task_id, peer = self._host, record.task_id, record.peer
        if host.kernel.actor(MIGRATOR) is None:
            raise ControlRefusedError(
                f"{task_id} is not adopted: the Network Service of {host.agent} is stopped, so it is unknown whether"
                f" {peer} is there"
            )
        if host.connected(peer):
            raise ControlRefusedError(
                f"{task_id} is not adopted: {peer} is connected, so it is not gone. The migration goes on by itself;"
                f" where {peer} has lost its disk, switch it off first"
            )
        why = f"{peer} is gone for good"
        self._run_here(task_id, record.snapshot, record.seen.n, peer, why, body.dry_run, request)

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
                f" `pancakes task recover {host.agent}/{task_id.name} --not-here` lets it rest"
            )
        why = f"{request.by} says that it runs nowhere else"
        seen = max(lost.seen.n, 0) + lost.jump - MORE_THAN_MIGRATIONS
        self._run_here(task_id, snapshot, seen, "", why, body.dry_run, request)

    def revive(self, body: Revive, request: Request) -> None:
        """Runs a task here that a lost agent had, from a checkpoint or as its configuration says.

        Raises:
            ControlRefusedError: it is here, or may be elsewhere, or cannot run here.
        """
        host, task_id, held = self._host, TaskId.parse(body.task_id), body.checkpoint
        type_name = Snapshot.decode(held.snapshot).type if held is not None else body.type
        command = Command(request.number, request.cause, "", body)
        if fault := host.kernel.access.fault(agent_of(request.by), "host", type_name):
            raise ControlRefusedError(f"{task_id} cannot run on {host.agent}: {fault}", "unable")
        if host.state.imports_first(host, agent_of(request.by), type_name, command):
            return
        place = host.places.get(task_id) or host.places.unkept(task_id)
        record, lost = place.record, self._records.lost(task_id)
        is_paused = record.guarded and place.course.desired is Desired.PAUSE
        is_paused = is_paused and record.owned and not record.disputed
        if is_paused or (record.guarded and record.was_ours):
            self._stand_alone(place, body, request)
            return
        if lost is not None or record.here:
            raise ControlRefusedError(
                f"{task_id} is known on {host.agent}: see `pancakes task recover {host.agent}/{task_id.name}`"
            )
        other = self._refuse_if_owned(task_id, "revived")
        snapshot = held.snapshot if held is not None else self._arrivals.as_configured(body)
        refusal = self._arrivals.cannot_build(agent_of(request.by), place, snapshot)
        if refusal or body.dry_run:
            host.kernel.registry.unreserve(join(host.address, task_id.name))
        if refusal:
            raise ControlRefusedError(f"{task_id} cannot run on {host.agent}: {refusal.text}", refusal.code)
        seen = max(record.seen.n, other.epoch.n if other is not None else 0, body.seen)
        why = f"{request.by} says that its agent is gone for good" + (f"; from {held.story}" if held else "")
        self._run_here(task_id, snapshot, seen, "", why, body.dry_run, request)

    def _refuse_if_owned(self, task_id: TaskId, done: str) -> OtherOwner | None:
        """Return the agent that has made the highest claim on a task, if any.

        Raises:
            ControlRefusedError: it is connected, with the disk that it had then.
        """
        other = self._disputes.claimant(task_id)
        if other is not None and self._host.connected(other.peer, other.journal):
            raise ControlRefusedError(
                f"{task_id} is not {done}: {other.peer} is connected, and owns it (epoch {other.epoch})"
            )
        return other

    def _stand_alone(self, place: Place, body: Revive, request: Request) -> None:
        """Has a task go on here whose guardians are gone for good."""
        host, record, held = self._host, place.record, body.checkpoint
        if held is not None and (held.epoch[0], held.no) > (record.epoch.n, record.register.no):
            raise ControlRefusedError(
                f"{record.task_id} is on {host.agent} from an old copy of its disk, older than {held.story}: revive it"
                f" on another agent"
            )
        why = f"{request.by} says that its guardians are gone for good"
        self._run_here(record.task_id, record.snapshot, body.seen, "", why, body.dry_run, request)

    def _run_here(
        self, task_id: TaskId, state: bytes, seen: int, peer: str, why: str, dry_run: bool, request: Request
    ) -> None:
        """Have a task run here, from a state, under an epoch that is higher than all that anybody has named."""
        host = self._host
        if dry_run:
            host.reply(request, result={"task_id": str(task_id), "peer": peer})
            return
        place = self._place(task_id)
        reason = f"{task_id} was adopted on {host.agent}, as {request.by} asked, because {why}"
        self._host.tell_asked("adopt", task_id.name, request)
        host.log("warning", reason)
        place.recovery = Recovery(request, peer, reason, self._mover.sequel_of(place.record).ledger)
        host.look_after(place, request)
        host.tell_registrar(place, Force(Epoch(seen, NOBODY), state), partial(self._forced, place))

    def _forced(self, place: Place, outcome: Outcome, why: str) -> None:
        """It is decided on disk that a task lives here, or it could not be written."""
        slot, recovery = place.slot, place.recovery
        if recovery is None:
            return
        if outcome in (Outcome.FAILED, Outcome.DECLINED):
            # It is not tried again: the person may have learnt better meanwhile.
            self.started(place, recovery, f"{place.task_id} is not adopted: {why or 'it was decided otherwise'}")
        elif outcome is Outcome.WRITTEN and slot is not None and slot.life.state is State.RUNNING:
            self.started(place, recovery, "")  # it goes on as it was

    def started(self, place: Place, recovery: Recovery, why_not: str) -> None:
        """The start of a task is decided: answer the request to have it run here."""
        place.recovery = None
        host, task_id, record = self._host, place.task_id, place.record
        if record.owned:
            # The asker of the migration that was in doubt has waited for this.
            over = AttemptOver(host, task_id, "", Refusal("conflict", recovery.reason), recovery.ledger)
            host.kernel.tell(MIGRATOR, over)
            host.event("task_adopted", task=task_id.name, peer=recovery.peer, epoch=record.epoch.n)
            if why_not:
                why_not = f"{task_id} belongs to {host.agent} now, but does not run: {why_not}"
        done = {"task_id": str(task_id), "peer": recovery.peer}
        host.reply(recovery.request, Refusal.if_any(why_not), done if not why_not else None)

    def forget(self, body: Forget, request: Request) -> None:
        """Lets a task rest here, on a person's word that it runs elsewhere, or drops what was never handed over.

        Raises:
            ControlRefusedError: its record was not lost and no other agent owns it, it runs, several can be meant, or
                the agent that has brought it is there.
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
        if body.dry_run:
            host.reply(request, result={"task_id": str(task_id)})
            return
        seen = lost.seen if lost.seen != NO_EPOCH else Epoch(0, NOBODY)
        self._leave(self._place(task_id), Epoch(seen.n, NOBODY), request)

    def _give_up(self, body: Forget, request: Request) -> None:
        host = self._host
        ours = [
            place
            for place in host.places.named(body.target)
            if place.record.owned and body.birthplace in ("", place.task_id.birthplace)
        ]
        if not ours:
            raise ControlRefusedError(f"{host.address} owns no task {body.target!r}", "not_found")
        place = ours[0]
        record, task_id = place.record, place.task_id
        if not record.disputed and (place.other is None or place.other.peer != body.owner):
            raise ControlRefusedError(f"{task_id} is owned by {host.agent} alone, as far as {host.agent} knows")
        runs = record.wanted is Wanted.RUNNING or (place.slot is not None and not place.slot.life.at_rest)
        if body.dry_run:
            told = {"task_id": str(task_id), "epoch": str(record.epoch), "runs": runs}
            host.reply(request, result=told)
            return
        if runs:
            raise ControlRefusedError(f"{task_id} runs on {host.agent}: stop it there first")
        other = place.other.epoch if place.other is not None else record.seen
        self._leave(self._place(task_id), other, request)

    def _leave(self, place: Place, epoch: Epoch, request: Request) -> None:
        """Write down that a task is not here; what was here of it is gone."""
        self._host.tell_asked("forget", place.task_id.name, request)
        place.recovery = Recovery(request, "", "", None)
        self._host.look_after(place, request)
        leave = Leave(Register(epoch))
        self._host.tell_registrar(place, leave, partial(self._left, place, request))

    def _left(self, place: Place, request: Request, outcome: Outcome, why: str) -> None:
        if place.recovery is None or place.recovery.request != request:
            return
        host, task_id = self._host, place.task_id
        if outcome is Outcome.WRITTEN:
            place.recovery = None
            host.log("warning", f"{task_id} was forgotten on {host.agent}, as {request.by} asked: it rests here")
            host.event("task_forgotten", task=task_id.name)
            host.reply(request, result={"task_id": str(task_id)})
        elif outcome in (Outcome.FAILED, Outcome.DECLINED):
            place.recovery = None
            host.reply(request, Refusal("failed", f"{task_id} is not forgotten: {why or 'it was decided otherwise'}"))

    def _place(self, task_id: TaskId) -> Place:
        """Return the place of a task to be decided about.

        Raises:
            ControlRefusedError: a decision about it is being written down.
        """
        place = self._host.places[task_id]
        if place.recovery is not None:
            raise ControlRefusedError(
                f"{task_id} has just been decided about, and that is not written down yet", "busy"
            )
        return place


Described = Callable[[str, Mapping[str, Any]], TaskSpec]
"""Takes the name of a task and its table; returns how to start it, or raises `ControlRefusedError`."""

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
        host: ClientServiceCore,
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
        snapshot = snapshot_of(spec, task_id, host.name, None).encode()
        asked = Creation(request, spec, snapshot, body.dry_run)
        self._refuse_unfit(task_id, asked)
        self._unreserve(task_id)  # until the others have answered
        self._disputes.questions.inquire(task_id, spec.type, partial(self._asked, task_id, asked))

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

    def _refuse_known(self, task_id: TaskId) -> None:
        """Raise `ControlRefusedError` if there is such a task here, or is about to be."""
        host = self._host
        if host.closing:
            raise ControlRefusedError(f"{host.address} ends: {CLOSES}", "busy")
        if (slot := host.slots.get(task_id.name)) is not None:
            raise ControlRefusedError(f"{slot.address} is there already, and {slot.life.word}: choose another name")
        if self._disputes.questions.inquires(task_id) or self._place(task_id).creation is not None:
            raise ControlRefusedError(f"{task_id} is being created already", "busy")
        if lost := self._records.lost(task_id):
            raise ControlRefusedError(lost.undecided(host.agent))
        if self._records.service_of(task_id) not in ("", host.name):
            service = self._records.service_of(task_id)
            raise ControlRefusedError(f"{host.agent} has a record of {task_id} in its service {service!r}")
        if (record := self._place(task_id).record).here:
            raise ControlRefusedError(
                f"{task_id} is {record.standing.value} here: see `pancakes task list {host.agent}`"
            )

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

    def _asked(self, task_id: TaskId, asked: Creation, facts: Sequence[Fact], silent: Sequence[str]) -> None:
        """The other agents have said what they know of the task."""
        host, place = self._host, self._place(task_id)
        try:
            self._refuse_known(task_id)  # what has come meanwhile
            seen = self._seen(task_id, place.record, facts)
            self._refuse_unfit(task_id, asked)
        except ControlRefusedError as error:
            host.reply(asked.request, Refusal.of(error))
            return
        # A member that was away may know a later epoch.
        jump = MORE_THAN_MIGRATIONS if asked.spec.guard is not None else 1
        if asked.dry_run:
            self._unreserve(task_id)
            host.reply(asked.request, result=_result(task_id, seen + jump, silent))
            return
        self._host.tell_asked("create", task_id.name, asked.request)
        if silent:
            host.log("warning", f"{task_id} is created, although nothing was heard of it from {', '.join(silent)}")
        place = host.places[task_id]
        place.creation = replace(asked, silent=tuple(silent))
        host.look_after(place, asked.request)
        begin = Begin(Epoch(seen + jump - 1, NOBODY), asked.snapshot)
        host.tell_registrar(place, begin, partial(self._created, place))

    def _created(self, place: Place, outcome: Outcome, why: str) -> None:
        if place.creation is not None and outcome in (Outcome.FAILED, Outcome.DECLINED):
            self.begun(place, place.creation, why or "it was decided otherwise")

    def _seen(self, task_id: TaskId, record: Record, facts: Sequence[Fact]) -> int:
        """Returns the highest number of an epoch that is known of a task that is nowhere.

        Raises:
            ControlRefusedError: it may be somewhere.
        """
        own = fact_of(record) if not record.unborn else None
        newest = newest_fact([own, *facts])
        other = self._disputes.claimant(task_id)
        if other is not None and (newest is None or other.epoch > newest.epoch):
            newest = Fact(task_id, Register(other.epoch))
        if newest is None:
            return 0
        if not newest.removed:
            raise ControlRefusedError(self._elsewhere(newest))
        return max(record.seen.n, newest.epoch.n)

    def _elsewhere(self, fact: Fact) -> str:
        task_id, owner = fact.task_id, fact.owner
        if not owner:
            return f"{task_id} was there before (epoch {fact.epoch}), and nobody knows where it is: choose another name"
        text = f"{task_id} is on {owner} (epoch {fact.epoch})"
        if self._host.connected(owner):
            return f"{text}: choose another name, or end that one with `pancakes task remove {owner}/{task_id.name}`"
        return f"{text}, as far as is known, and {owner} is not connected: choose another name, or connect {owner}"

    def begun(self, place: Place, asked: Creation, why_not: str) -> None:
        """The start of a task that was created is decided: answers the request."""
        place.creation = None
        host, task_id, record = self._host, place.task_id, place.record
        if not record.owned:
            self._unreserve(task_id)
            host.reply(
                asked.request,
                Refusal("failed", f"{task_id} is not created: {self._records.trouble(task_id) or why_not}"),
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
        self._host.tell_asked("remove", place.task_id.name, request)
        place.removal = request
        host.look_after(place, request)
        if slot.life.state is State.STOPPED:
            self._go_on(place)
        else:
            host.feed_place(place, StopAsked(request, f"removed, as {request.by} asked"))

    def _refuse_removal(self, slot: Slot, place: Place) -> None:
        host, task_id, record = self._host, place.task_id, place.record
        if task_id.birthplace == host.agent and slot.name in host.residents:
            raise ControlRefusedError(
                f"{slot.address} is in the configuration of {host.agent}: take [task.{slot.name}] out of its file,"
                f" start {host.agent} again, and remove it then; until then, `pancakes task stop` stops it"
            )
        if not slot.spec.created:
            raise ControlRefusedError(
                f"{task_id} was born from the configuration of {task_id.birthplace}, and whether that still names it is"
                f" known there: move it to {task_id.birthplace}, and remove it there; until then, `pancakes task stop`"
                " stops it"
            )
        if record.disputed:
            raise ControlRefusedError(dispute_of(record))
        if place.unsure.why:
            raise ControlRefusedError(place.unsure.why)
        if place.removal is not None or place.recovery is not None:
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

    def _go_on(self, place: Place) -> None:
        """Write down that a task is nowhere, once it is stopped and that is on disk."""
        host, slot = self._host, place.slot
        if place.removal is None or slot is None or not slot.life.at_rest:
            return
        host.tell_registrar(place, Want(Wanted.REMOVED), partial(self._removed, place, place.removal))

    def _removed(self, place: Place, request: Request, outcome: Outcome, why: str) -> None:
        if place.removal != request:
            return
        host, task_id = self._host, place.task_id
        if outcome is Outcome.COUNTS:
            place.removal = None
            host.feed_place(place, Removed())
            host.log("info", f"{task_id} was removed from {host.agent}, as {request.by} asked")
            host.event("task_removed", task=task_id.name, by=request.by, number=request.number)
            self._account(task_id, request, "removed", "")
            host.reply(request, result={"task_id": str(task_id)})
        elif outcome in (Outcome.FAILED, Outcome.DECLINED, Outcome.LAPSED):
            place.removal = None
            text = f"{task_id} is not removed: {why or 'it was decided otherwise meanwhile'}"
            host.reply(request, Refusal("failed", text))

    # ----------------------------------------------------------------------------------------------------------

    def _place(self, task_id: TaskId) -> Place:
        """Returns the place of a task, without keeping one for a task of which nothing is known."""
        return self._host.places.get(task_id) or self._host.places.unkept(task_id)

    def _account(self, task_id: TaskId, request: Request, outcome: Literal["created", "removed"], winner: str) -> None:
        account = MigrationReport(str(task_id), self._host.agent, request.by, "", outcome, winner, (), 0.0)
        self._ledgers.add(account, "", self._host.kernel.mission.now())


def _result(task_id: TaskId, epoch_n: int, silent: Sequence[str]) -> dict[str, Any]:
    return {"task_id": str(task_id), "epoch": epoch_n, "silent": list(silent)}
