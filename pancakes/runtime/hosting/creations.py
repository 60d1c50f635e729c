"""Tasks that no configuration file names: how they begin here, and how they end for good."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final, Literal

from msgspec.structs import replace

from pancakes.control import Command
from pancakes.creation import Create, Remove
from pancakes.errors import ControlRefused
from pancakes.mesh.migration.epoch import MORE_THAN_MOVES
from pancakes.mesh.migration.event import AdoptionAsked, RemovalAsked
from pancakes.mesh.migration.knowledge import TaskFact, fact_of, newest_fact
from pancakes.mesh.migration.ledger import Ledger
from pancakes.mesh.migration.owner import dispute_of, is_disputed
from pancakes.mesh.migration.record import Phase, Record, TaskId
from pancakes.packet import agent_of, join
from pancakes.runtime.hosting.arrivals import Arrivals
from pancakes.runtime.hosting.disputes import Disputes
from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.hosting.inquiries import InquiryFindings
from pancakes.runtime.hosting.ledgers import Ledgers
from pancakes.runtime.hosting.machine import settled
from pancakes.runtime.hosting.place import Creation, Place
from pancakes.runtime.hosting.records import Records
from pancakes.runtime.hosting.snapshots import snapshot_of
from pancakes.runtime.hosting.standing import Standing
from pancakes.runtime.life.life import CLOSES, State
from pancakes.runtime.life.life_effect import Answer
from pancakes.runtime.life.life_event import StopAsked
from pancakes.runtime.life.request import Request, request_of
from pancakes.runtime.supervision.slot import Slot
from pancakes.task import TaskSpec

Described = Callable[[str, Mapping[str, Any]], TaskSpec]
"""Takes the name of a task and its table; returns how to start it, or raises `ControlRefused`."""

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
        ledgers: Ledgers,
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
            ControlRefused: it is here, or may be elsewhere, or cannot run here.
        """
        host, task_id = self._host, TaskId(self._host.agent, body.target)
        command = Command(request.number, request.cause, "", body)
        if fault := host.kernel.access.fault(agent_of(request.by), "host", body.type):
            raise ControlRefused(f"{task_id.name} cannot run on {host.agent}: {fault}")
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
            raise ControlRefused(f"[task.{body.target}] {key}: is none of the other keys; see `pancakes task create`")
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
        """Raises `ControlRefused` where there is such a task here, or is about to be."""
        host = self._host
        if host.closing:
            raise ControlRefused(f"{host.address} ends: {CLOSES}")
        if (slot := host.slots.get(task_id.name)) is not None:
            raise ControlRefused(f"{slot.address} is there already, and {slot.life.word}: choose another name")
        if self._disputes.inquiries.about(task_id) or self._place(task_id).creation is not None:
            raise ControlRefused(f"{task_id} is being created already")
        if lost := self._records.lost(task_id):
            raise ControlRefused(lost.undecided(host.agent))
        if self._records.service_of(task_id) not in ("", host.name):
            service = self._records.service_of(task_id)
            raise ControlRefused(f"{host.agent} has a record of {task_id} in its service {service!r}")
        if (record := self._place(task_id).standing.record).here:
            raise ControlRefused(f"{task_id} is {record.phase.value} here: see `pancakes task list {host.agent}`")

    def _refuse_unfit(self, task_id: TaskId, asked: Creation) -> None:
        """Raises `ControlRefused` where a task cannot run here now. What it needs is kept for it until it begins."""
        host, place = self._host, self._place(task_id)
        refusal = self._arrivals.cannot_build(agent_of(asked.request.by), place, asked.snapshot)
        if not refusal and (lacking := host.kernel.registry.lacking(asked.spec.cls.requires)):
            refusal = f"{host.agent} lacks the device types {', '.join(lacking)}, which {task_id.name} requires"
        if refusal:
            self._unreserve(task_id)
            raise ControlRefused(f"{task_id.name} cannot run on {host.agent}: {refusal}")

    def _unreserve(self, task_id: TaskId) -> None:
        self._host.kernel.registry.unreserve(join(self._host.address, task_id.name))

    def _asked(self, task_id: TaskId, asked: Creation, found: InquiryFindings) -> None:
        """The other agents have said what they know of the task."""
        host, place = self._host, self._place(task_id)
        try:
            self._refuse_known(task_id)  # what has come meanwhile
            seen = self._seen(task_id, place.standing.record, found)
            self._refuse_unfit(task_id, asked)
        except ControlRefused as error:
            host.reply(asked.request, str(error))
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
            ControlRefused: it may be somewhere.
        """
        own = fact_of(self._host.agent, record)
        newest = newest_fact([own, *found.facts])
        other = self._disputes.claimant(task_id)
        if other is not None and (newest is None or other.epoch > newest.epoch):
            newest = TaskFact(task_id, other.peer, other.epoch)
        if newest is None:
            return 0
        if not newest.removed:
            raise ControlRefused(self._elsewhere(newest))
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
            host.reply(asked.request, f"{task_id} is not created: {place.standing.trouble or why_not}")
            return
        host.log("info", f"{task_id} was created on {host.agent}, as {asked.request.by} asked")
        told = {"task": task_id.name, "type": asked.spec.type, "epoch": record.epoch.n}
        host.event("task_created", **told, by=asked.request.by, number=asked.request.number)
        self._account(task_id, asked.request, "created", host.agent)
        if why_not:
            remove = f"`pancakes task remove {host.agent}/{task_id.name}` ends it"
            host.reply(asked.request, f"{task_id} was created, and does not run: {why_not}. {remove}")
        else:
            host.reply(asked.request, result=_result(task_id, record.epoch.n, asked.silent))

    # Removing --------------------------------------------------------------------------------------------------

    def remove(self, slot: Slot, body: Remove, request: Request) -> None:
        """Ends a task for good; the answer comes once that is on disk.

        Raises:
            ControlRefused: a configuration file names it, or it is not known whether it is here alone.
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
            raise ControlRefused(
                f"{slot.address} is in the configuration of {host.agent}: take [task.{slot.name}] out of its file,"
                f" start {host.agent} anew, and remove it then; until then, `pancakes task stop` stops it"
            )
        if not slot.spec.created:
            raise ControlRefused(
                f"{task_id} was born from the configuration of {task_id.birthplace}, and whether that still names it is"
                f" known there: move it to {task_id.birthplace}, and remove it there; until then, `pancakes task stop`"
                " stops it"
            )
        if is_disputed(record):
            raise ControlRefused(dispute_of(host.agent, record))
        if place.unsure.why:
            raise ControlRefused(place.unsure.why)
        if place.removal is not None or place.adoption is not None or place.forgetting:
            raise ControlRefused(f"{task_id} has just been decided about, and that is not written down yet")

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
                self._host.reply(request_of(command), f"{place.task_id} is being removed")
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
            host.reply(request, f"{task_id} is not removed: {why_not}")
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
        account = Ledger(str(task_id), self._host.agent, request.by, "", outcome, winner, (), 0.0)
        self._ledgers.add(account, "", self._host.kernel.mission.now())

    def _tell_asked(self, what: str, task_id: TaskId, request: Request) -> None:
        host = self._host
        host.event("asked", what=what, task=task_id.name, service=host.name, by=request.by, number=request.number)


def _result(task_id: TaskId, epoch_n: int, silent: Sequence[str]) -> dict[str, Any]:
    return {"task_id": str(task_id), "epoch": epoch_n, "silent": list(silent)}
