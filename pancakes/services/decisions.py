"""What a person decides about tasks of which their agent cannot know by itself where they are: adopt, or forget."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pancakes.control import Adopt, Forget
from pancakes.errors import ControlRefused
from pancakes.migration.event import Adopt as RunHere
from pancakes.migration.event import Forget as LetRest
from pancakes.migration.record import NO_EPOCH, Phase, Record, TaskId
from pancakes.request import Request
from pancakes.services import adoption
from pancakes.services.bidding_messages import AttemptOver
from pancakes.services.lost import Lost

if TYPE_CHECKING:
    from pancakes.services.durable import DurableService


class Decisions:
    """Carries out `Adopt` and `Forget` for one service. All in that service's actor.

    Args:
        service: whose tasks they are about.
    """

    def __init__(self, service: DurableService) -> None:
        self._service = service

    def concern(self, name: str) -> bool:
        """Returns whether there is something to decide about a task of this name. Any thread."""
        return bool(adoption.in_doubt(self._service.records_of(name)) or self._service.lost_of(name))

    def adopt(self, body: Adopt, request: Request) -> None:
        """Runs a task here, on a person's word.

        Raises:
            ControlRefused: it is not in doubt, the other agent is there, or nobody has said `force`.
        """
        service = self._service
        chosen = adoption.chosen(
            service.address, body.target, body.birthplace, service.records_of(body.target), service.lost_of(body.target)
        )
        if isinstance(chosen, Record) and adoption.was_forgotten(chosen):
            chosen = Lost(chosen.task_id, f"{service.agent} was told to forget it, after its record was lost")
        if isinstance(chosen, Lost):
            self._adopt_lost(chosen, body, request)
        else:
            self._adopt_doubtful(chosen, body, request)

    def _adopt_doubtful(self, record: Record, body: Adopt, request: Request) -> None:
        service, task_id, peer = self._service, record.task_id, record.peer
        migrator = service.migrator()
        if migrator is None:
            raise ControlRefused(
                f"{task_id} is not adopted: the Network Service of {service.agent} is stopped, so nobody knows whether"
                f" {peer} is there"
            )
        if migrator.connected(peer):
            raise ControlRefused(
                f"{task_id} is not adopted: {peer} is connected, so it is not gone. The hand-off goes on by itself;"
                f" where {peer} has lost its disk, switch it off first"
            )
        if not body.force:
            raise ControlRefused(adoption.meaning(record, service.agent))
        why = f"{peer} is gone for good"
        self._run_here(task_id, RunHere(), peer, why, body.dry_run, request)

    def _adopt_lost(self, lost: Lost, body: Adopt, request: Request) -> None:
        service, task_id = self._service, lost.task_id
        slot = service.slots.get(task_id.name)
        if slot is not None and service.id_of(slot) != task_id:
            raise ControlRefused(f"{task_id} is not adopted: {service.address} has a task named {slot.name} already")
        snapshot = lost.snapshot or (service.first_snapshot(slot) if slot is not None else b"")
        if not snapshot:
            raise ControlRefused(
                f"{task_id} cannot be adopted: nothing is left here to run it from, for {lost.story()}."
                f" `pancakes task forget {service.agent}/{task_id.name}` lets it rest"
            )
        if not body.force:
            raise ControlRefused(lost.meaning(service.agent))
        self._run_here(
            task_id,
            RunHere(snapshot, lost.seen.n, lost.jump),
            "",
            f"{request.by} says that it runs nowhere else",
            body.dry_run,
            request,
        )

    def _run_here(self, task_id: TaskId, event: RunHere, peer: str, why: str, dry_run: bool, request: Request) -> None:
        service = self._service
        done = {"task_id": str(task_id), "peer": peer}
        if dry_run:
            service.reply(request, result=done)
            return
        ledger = service.sequel_of(service.hand_off(task_id).record).ledger
        reason = f"{task_id} was adopted on {service.agent}, as {request.by} asked, because {why}"
        self._tell_asked("adopt", task_id, request)
        service.log("warning", reason)

        def begun(why_not: str) -> None:
            record = service.hand_off(task_id).record
            owned = record.phase is Phase.OWNER
            if owned:
                # The asker of the move that was in doubt has waited for this.
                service.tell_migrator(AttemptOver(service, task_id, "", reason, ledger))
                service.event("task_adopted", task=task_id.name, peer=peer, epoch=record.epoch.n)
            if owned and why_not:
                why_not = f"{task_id} belongs to {service.agent} now, but does not run: {why_not}"
            service.reply(request, why_not, done if not why_not else None)

        service.start_by(task_id, event, begun, request)

    def forget(self, body: Forget, request: Request) -> None:
        """Lets a task rest here whose record was lost, on a person's word that it runs elsewhere.

        Raises:
            ControlRefused: its record was not lost, or several can be meant.
        """
        service = self._service
        lost = adoption.chosen(
            service.address,
            body.target,
            body.birthplace,
            service.records_of(body.target),
            service.lost_of(body.target),
            "forget",
        )
        task_id = lost.task_id
        done = {"task_id": str(task_id)}
        if body.dry_run:
            service.reply(request, result=done)
            return
        self._tell_asked("forget", task_id, request)

        def written(why_not: str) -> None:
            if not why_not:
                service.log(
                    "warning", f"{task_id} was forgotten on {service.agent}, as {request.by} asked: it rests here"
                )
                service.event("task_forgotten", task=task_id.name)
            reason = f"{task_id} is not forgotten: {why_not}" if why_not else ""
            service.reply(request, reason, done if not reason else None)

        seen = lost.seen if isinstance(lost, Lost) else NO_EPOCH
        service.write_by(task_id, LetRest(seen), written, request)

    def _tell_asked(self, what: str, task_id: TaskId, request: Request) -> None:
        service = self._service
        service.event("asked", what=what, task=task_id.name, service=service.name, by=request.by, number=request.number)
