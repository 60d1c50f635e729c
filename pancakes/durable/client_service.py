"""The Client Service: hosts the user's tasks, and opens the channels that they talk on (paper §3.3).

It is the one place where the events of a task come together. `state_machine` decides, and this actor carries the
effects out, strictly in order. Subclass `ClientService` for a service of your own whose tasks are durable.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, ClassVar, Final, assert_never

import msgspec

from pancakes import control
from pancakes.control import Create, Refusal, Remove
from pancakes.durable import handoff_events as handoff_effect
from pancakes.durable import messages, state_machine
from pancakes.durable.arrivals import Arrivals
from pancakes.durable.bidding_messages import BidAwarded, MigratorBegan, MoveOver
from pancakes.durable.census import ClaimsCame, CopyNoticed, FactsCame, NeighbourCame
from pancakes.durable.checkpoints import Checkpointing, Deliveries, carried_of, snapshot_of
from pancakes.durable.commands import Creations, Decisions, Described
from pancakes.durable.courier import AskedBegan, CameFor, SharedOutbox
from pancakes.durable.handoff_events import Times
from pancakes.durable.host_state import HostState, Imported
from pancakes.durable.hosting import SURE, HostingService, PeerTalk, Place, Places
from pancakes.durable.installed import Installed
from pancakes.durable.leases import GuardedTasks
from pancakes.durable.messages import CanGuard, DenyLease, LeaseKept, Pledge, TakeTask
from pancakes.durable.migration import Departures, Mover
from pancakes.durable.ownership import TaskAt
from pancakes.durable.ownership_checks import BirthRule, Disputes, Origins
from pancakes.durable.record import Epoch, Phase, Record, TaskId, Wanted, rest_of
from pancakes.durable.snapshot import Posted, Snapshot
from pancakes.durable.state_machine import AnyEvent, Now, Standing, handle, settled
from pancakes.durable.store import MigrationReports, Records, RecordWritten
from pancakes.errors import MigrationError
from pancakes.kernel.handlers import on, reliable
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.registry import TaskEntry
from pancakes.mesh.mesh import Mesh
from pancakes.packet import NETWORK, Packet, join
from pancakes.service import Service
from pancakes.supervision.lifecycle import RESTS, Answer, News, Request, State, Tell, request_of
from pancakes.supervision.messages import Carried, HasNoPermit, LetterGiven, Looked, PeerDown, Stood
from pancakes.supervision.service_core import ServiceCore
from pancakes.supervision.slots import Slot, tell_of_task
from pancakes.task import TaskSpec
from pancakes.util.text import fault_of_name

JOURNAL_S: Final = 1.5
"""The sender of a request that waits for the journal is told so after this time, in host time."""
GUARDIANS_S: Final = 4.0
"""That of one that waits for guardians is told so after this time, in host time."""
LOOK_AGAIN_S: Final = 0.25
"""What the journal has begun to write meanwhile may fail a moment later."""


class Waiters:
    """Looks after the requests to one service. All in that service's actor.

    Args:
        host: the service.
        records: knows what keeps a record from being written.
    """

    def __init__(self, host: HostingService, records: Records) -> None:
        self._host = host
        self._records = records

    def look_after(self, place: Place, request: Request) -> None:
        """Sees to it that a request about a task is answered, where that waits for the journal or for guardians.

        What was asked for is done all the same once the journal can write, or more than half of them answer.
        """
        self._host.after_host(JOURNAL_S, lambda: self._look(place, request))
        if place.standing.record.guarded:
            self._host.after_host(GUARDIANS_S, lambda: self._look_at_guardians(place, request))

    def _look(self, place: Place, request: Request) -> None:
        host, standing = self._host, place.standing
        if not host.waits(request):
            return
        trouble = "" if settled(standing) else standing.trouble or self._records.trouble(place.task_id)
        if not trouble:
            host.after_host(LOOK_AGAIN_S, lambda: self._look(place, request))
            return
        slot = place.slot
        what = slot.how_it_is if slot is not None else str(place.task_id)
        host.put_off(
            request, f"{what}; what was asked for waits: {trouble}. It is done as soon as the journal can write"
        )

    def _look_at_guardians(self, place: Place, request: Request) -> None:
        host, slot, record = self._host, place.slot, place.standing.record
        starts = slot is not None and slot.life.state in (State.ASKED, State.CALLED_OFF)
        if slot is None or not starts or not record.guarded or place.permit or not host.waits(request):
            return
        others = ", ".join(sorted({one.agent for one in record.guards.members()} - {host.agent}))
        host.put_off(
            request,
            f"{slot.how_it_is}; what was asked for waits for its guardians ({others}). It is done"
            " once more than half of them answer",
        )


KEEP: Final = reliable(1024)
"""Of each type of hand-off message; each is said again where it is needed."""
PROMISED_S: Final = 2 * Times().slot_s
"""A place that was promised is forgotten if nothing has come of it after so long, in host time."""


class ClientServiceCore(ServiceCore):
    """Runs a Client Service.

    Each of its tasks has a durable record: it outlives a crash of its agent, and can move to another one. What may
    happen to it is decided by `pancakes.durable.state_machine`; this actor is the one place where the events of a
    task come together, and where the effects are carried out, strictly in order.

    Args:
        records: where the records are kept.
        catalogue: where the classes of tasks that arrive are found.
        outbox: what its tasks have sent to others and is not acknowledged.
        state: what this agent could be to a task from elsewhere.
        mesh: says what neighbours are connected.
        births: what is to be asked before a task is born.
        ledgers: the account of tasks that are created and removed.
        described: reads the table of a task that no file names.

    Attributes:
        places: all tasks that it has ever had to do with.
        residents: the names of those that its configuration has.
    """

    keeps_changes: ClassVar[bool] = True
    # A record must have been taken up before anything else is heard of its task.
    started_at_once: ClassVar[int] = sys.maxsize

    def __init__(
        self,
        *args: Any,
        records: Records,
        catalogue: Installed,
        outbox: SharedOutbox,
        state: HostState,
        mesh: Mesh,
        births: BirthRule,
        ledgers: MigrationReports,
        described: Described,
        **others: Any,
    ) -> None:
        super().__init__(*args, **others)
        self._records = records
        self.outbox = outbox
        self.state = state
        self._talk = PeerTalk(self, mesh)
        self.connected = self._talk.connected
        self.places = Places(self.agent, self.slots)
        self.residents: frozenset[str] = frozenset()
        self._events: deque[tuple[Place, AnyEvent]] = deque()
        self._turning = False
        self._writing = 0  # how many records wait for the disk
        self._ends = False  # once all records are written
        self._checkpointing = Checkpointing(self)
        self._deliveries = Deliveries(self)
        self.look_after = Waiters(self, records).look_after
        self._mover = Mover(self)
        self._disputes = Disputes(self, records, mesh, births)
        self._arrivals = Arrivals(self, catalogue, records, state, self._disputes, self._talk)
        self._origins = Origins(self, records)
        self._departures = Departures(self)
        parts = self._checkpointing, self._deliveries, self._disputes, self._origins
        self._guarded = GuardedTasks(self, records, self._talk, *parts)
        self.first_guardian = self._guarded.first_guardian
        self._decisions = Decisions(self, records, self._mover, self._arrivals, self._disputes)
        self._creations = Creations(self, records, self._arrivals, self._disputes, ledgers, described)

    # Its own life ----------------------------------------------------------------------------------------------

    def specs(self) -> Sequence[TaskSpec]:
        self.state.begin(self.name)
        specs = list(super().specs())
        self.residents = frozenset(spec.name for spec in specs)
        for name in self.residents:
            self._records.claim(TaskId(self.agent, name), self.name)
        for record in self._records.all().values():
            if record.service == self.name:
                place = self.places.open(record)
                self._mover.found(record)
                specs += self._arrivals.found(place)
        return specs

    def after_start(self) -> None:
        super().after_start()
        # A tombstone has no slot, and answers all the same.
        for place in list(self.places.values()):
            if place.slot is None:
                self.feed_place(place, state_machine.TakeUp())
        self._guarded.begin(self.places.values())
        self._mover.begin()
        self._disputes.begin()

    def wants(self, slot: Slot) -> bool:
        record = self.places.at[slot.name].standing.record
        if record.may_begin:
            return slot.spec.start
        # The journal wins over `start` in the configuration: a stop that a person asked for outlives a reboot.
        return record.phase is not Phase.OWNER or record.wanted is Wanted.RUNNING

    def take_up(self, slot: Slot, kept: Mapping[str, Carried] | None) -> None:
        # What a task carries is in its record.
        slot.fresh = kept is None

    def start_configured(self, slot: Slot) -> None:
        place = self.places.at[slot.name]
        self.feed_place(place, state_machine.StartConfigured(slot.fresh))
        if place.standing.record.guarded:
            self.settle(slot)  # its guardians may be away

    def settle_all(self) -> None:
        # The last checkpoint of each task may wait for the one before it to be written.
        self._ends = True
        self._end_if_written()

    def _end_if_written(self) -> None:
        if self._ends and not self._turning and not self._writing:
            self._ends = False
            self._guarded.close()
            self.end_at_last()

    # The events of its tasks -----------------------------------------------------------------------------------

    def feed(self, slot: Slot, event: Any) -> None:
        name = slot.name
        if self.slots.get(name) is slot:  # else it is a late timer of a task that has left
            self.feed_place(self.places.at[name], event)

    def feed_place(self, place: Place, event: AnyEvent | None) -> None:
        """Feeds an event to a task, and carries out what follows. One that comes meanwhile waits until then."""
        if event is not None:
            self._events.append((place, event))
        if self._turning:
            return
        self._turning = True
        try:
            while self._events:
                self._step(*self._events.popleft())
        finally:
            self._turning = False
        self._end_if_written()

    def _step(self, place: Place, event: AnyEvent) -> None:
        slot, before = place.slot, place.standing
        at = Now(self.agent, self.kernel.host.now(), self.keeper.draw, self.closing, place.permit)
        life, place.standing, effects = handle(slot.life if slot is not None else None, place.standing, event, at)
        if slot is not None and life is not None:
            slot.life = life
            slot.rest = rest_of(place.standing.record, place.unsure.word) if life.state in RESTS else ""
            self.kernel.tasks.enter(TaskEntry.of(self.name, slot))
        record, asks = place.standing.record, slot is not None and slot.spec.guard is not None
        if record is not before.record and (asks or record.guarded or place.tenancy is not None):
            self._guarded.look(place)
        if (record.phase, record.offer) != (before.record.phase, before.record.offer):
            while place.reminders:  # its hand-off is a step further
                place.reminders.popitem()[1].cancel()
        for effect in effects:
            if isinstance(effect, state_machine.HostingEffect):
                self._carry_out(place, effect, slot)
            elif slot is None:
                continue
            elif isinstance(effect, state_machine.SlotEffect):
                self._carry_out_at(slot, place, effect)
            else:
                self.keeper.carry_out(slot, effect)
        record = place.standing.record
        if record.here is not before.record.here or place.standing.leaving is not before.leaving:
            self.places.bind(place.task_id.name)
        if record.phase is Phase.OWNER and (before.record.phase, before.record.epoch) != (record.phase, record.epoch):
            self._deliveries.became_owner(place)
            self._disputes.became_owner(place)

    def open_slot(self, spec: TaskSpec) -> Slot:
        slot = super().open_slot(spec)
        self.places.bind(spec.name)
        place = self.places.at[spec.name]
        self._checkpointing.begin()
        if rest := rest_of(place.standing.record, place.unsure.word):
            slot.rest = rest
            self.show(slot)
        return slot

    def _carry_out(self, place: Place, effect: state_machine.HostingEffect, slot: Slot | None) -> None:
        match effect:
            case handoff_effect.Persist():
                self._writing += 1
                may = self._guarded.may_write(place, effect.record) if place.tenancy is not None else None
                self._records.persist(effect.record, self, may)
            case handoff_effect.Send():
                self._talk.hand_off(effect.peer, effect.message)
            case handoff_effect.LookForOwner():
                self._disputes.look_for_owner(place)
            case handoff_effect.After():
                due = partial(self.feed_place, place, effect.event)
                place.reminders[type(effect.event)] = self.after_host(effect.drawn_s(self.random), due)
            case handoff_effect.Warn():
                self.log("warning", effect.text)
            case handoff_effect.Ack():
                self._guarded.acknowledge(place, effect.packet)
            case handoff_effect.AttemptFailed():
                self._mover.attempt_failed(place, effect)
            case handoff_effect.HandedOver():
                self._mover.handed_over(place, effect)
            case state_machine.OpenPlace():
                self.feed_place(place, self._arrivals.open(place, effect.start))
            case state_machine.Unreserve():
                self.kernel.registry.unreserve(join(self.address, place.task_id.name))
            case state_machine.Decided():
                if place.adoption is not None:
                    self._decisions.started(place, place.adoption, effect.reason)
                if place.creation is not None:
                    self._creations.begun(place, place.creation, effect.reason)
                if place.follows is not None:
                    self._mover.followed(place, place.follows)
            case state_machine.Lasts():
                if place.adoption is not None or place.forgetting:
                    self._decisions.written(place, effect.why_not)
                if place.removal is not None:
                    self._creations.lasts(place, place.removal, effect.why_not)
            case state_machine.Drop():
                self._departures.drop(place, slot, effect.ends)
            case handoff_effect.Resume():
                self._departures.resume(place, slot)
            case handoff_effect.Seize():
                self._guarded.given(place, effect)
            case _:
                assert_never(effect)

    def _carry_out_at(self, slot: Slot, place: Place, effect: state_machine.SlotEffect) -> None:
        match effect:
            case state_machine.AskRoom():
                self.feed_place(place, self._arrivals.room(slot, place, effect))
            case state_machine.Prepare():
                self.feed_place(place, self._arrivals.prepare(slot, place, effect.start))
            case state_machine.Rested():
                self.rested(slot)
            case handoff_effect.Freeze():
                self.feed_place(place, self._departures.freeze(slot, place, effect))
            case state_machine.TakeDown():
                self.feed_place(place, self._departures.take_down(slot, place, effect))
            case state_machine.LetGoOn():
                self._departures.let_go_on(slot)
            case state_machine.Vacate():
                for other in self._departures.vacate(slot):
                    if isinstance(other.standing.waits, handoff_effect.StartTask):
                        self.feed_place(other, state_machine.PlaceFree())
            case _:
                assert_never(effect)

    def _written(self, written: RecordWritten) -> None:
        self._writing -= 1
        place = self.places[written.task_id]
        if written.why_not:
            place.written = None
            self.feed_place(place, state_machine.NotPersisted(written.why_not))
        else:
            self.feed_place(place, state_machine.Persisted())
        if self._checkpointing.late:
            self._checkpointing.look_at_late()

    # Starting and ending ---------------------------------------------------------------------------------------

    def snapshot(self, slot: Slot, carried: Carried | None, posted: Posted | None = None) -> bytes:
        return snapshot_of(slot.spec, self.places.at[slot.name].task_id, self.name, carried, posted).encode()

    def snapshot_at_rest(self, slot: Slot) -> bytes:
        if slot.carried is None:
            return b""
        try:
            return self.snapshot(slot, slot.carried)
        except MigrationError as error:
            slot.carried = None
            self.log("error", f"what {slot.address} carried is lost, and what is on disk counts: {error}")
            return b""

    def spawn(self, slot: Slot) -> None:
        super().spawn(slot)
        slot.carried = None  # from here on the record is what counts

    def task_running(self, slot: Slot) -> None:
        self._deliveries.again(self.places.at[slot.name])
        self._mover.watch(slot)

    def tell_news(self, slot: Slot, effect: Tell) -> None:
        if effect.news is not News.REFUSED or self.places.at[slot.name].unsure is SURE:
            tell_of_task(self, slot, effect)  # what is unsure of many tasks is told once

    def answer(self, slot: Slot, effect: Answer) -> None:
        answer, place = super().answer, self.places.at[slot.name]
        if place.removal is not None and self._creations.has_stopped(place, effect):
            return  # it is answered once it is removed
        if slot.life.at_rest and not effect.reason:
            self._guarded.stopped(place, lambda fault: answer(slot, Answer(effect.asker, fault)))
        else:
            answer(slot, effect)

    def write_rest(self, slot: Slot) -> None:
        self.feed(slot, state_machine.CameToRest(self.snapshot_at_rest(slot)))

    def arguments_of(self, slot: Slot) -> Mapping[str, Any]:
        told = {"tells_each_turn": True} if slot.spec.durability == "each" else {}
        return {**super().arguments_of(slot), **told}

    def changed(self, slot: Slot, carried: Carried) -> None:
        # It outlives a failure of the task the moment after.
        if slot.task is not None:
            self._checkpointing.save(slot, carried)

    def carried_of(self, slot: Slot) -> Carried:
        record = self.places.at[slot.name].standing.record
        if slot.carried is None and record.snapshot:
            with suppress(MigrationError):  # where it is started, that is said
                return carried_of(Snapshot.decode(record.snapshot))
        return super().carried_of(slot)

    def drop_state(self, slot: Slot) -> None:
        # What it has heard it has heard: its sender may not know yet, and sends that again.
        slot.carried = Carried(slot.spec.settings, {}, heard=self.carried_of(slot).heard)

    # What others tell ------------------------------------------------------------------------------------------

    def take_message(self, message: Any) -> Any:
        match message:
            case Looked() | Stood() | HasNoPermit():
                slot = self.slots.get(message.task.name)
                if slot is not None and slot.task is not None and slot.task is message.task:
                    if isinstance(message, Looked):
                        self._checkpointing.looked(slot, message)
                    elif isinstance(message, Stood):
                        self.feed(slot, state_machine.StoodStill(message.offer, message.carried, message.reason))
                    else:
                        self._guarded.has_no_permit(self.places.at[slot.name])
            case RecordWritten():
                self._written(message)
            case LetterGiven() | CameFor() | AskedBegan():
                self._deliveries.heard(message)
            case ClaimsCame() | NeighbourCame() | FactsCame() | CopyNoticed():
                self._disputes.heard(message)
            case Imported():
                self.begin_command(message.waiting, request_of(message.waiting))
            case PeerDown():
                self._arrivals.drop_pieces(message.peer)
            case BidAwarded() | MoveOver():
                place = self.places[message.task_id]
                self.feed_place(place, self._mover.heard(place, message))
            case MigratorBegan():
                self._mover.migrator_began()
            case _:
                return super().take_message(message)
        return None

    @on(NETWORK, messages.Reserve, queue=KEEP, addressed=True)
    def on_reserve(self, packet: Packet) -> None:
        """An agent asks for a place for a task."""
        self._origins.judge(packet, self._take_in)

    @on(NETWORK, TaskAt, queue=64, addressed=True)
    def on_task_at(self, packet: Packet) -> None:
        """An agent that was asked says which one has a task."""
        self._origins.told(packet)

    @on(NETWORK, messages.Reserved, queue=KEEP, addressed=True)
    @on(NETWORK, messages.Piece, queue=KEEP, addressed=True)
    @on(NETWORK, messages.Nak, queue=KEEP, addressed=True)
    @on(NETWORK, messages.Prepared, queue=KEEP, addressed=True)
    @on(NETWORK, messages.Commit, queue=KEEP, addressed=True)
    @on(NETWORK, messages.Activated, queue=KEEP, addressed=True)
    @on(NETWORK, messages.Abort, queue=KEEP, addressed=True)
    @on(NETWORK, messages.Unknown, queue=KEEP, addressed=True)
    def on_hand_off(self, packet: Packet) -> None:
        """Takes a hand-off message in."""
        self._take_in(packet)

    def _take_in(self, packet: Packet, refusal: Refusal | None = None) -> None:
        task_id = packet.body.task_id
        # Of a task that no agent has asked a place for nothing is kept: a peer may make up as many as it likes.
        known = self.places.get(task_id)
        place = known or Place(task_id, Standing(Record(task_id)))
        received = self._arrivals.receive(packet, place, refusal)
        if known is None and place.promised is not None:
            self.places.keep(place)
            self.after_host(PROMISED_S, partial(self._look_at_promised, place, place.promised))
        if received is not None:
            self.feed_place(place, received)

    def _look_at_promised(self, place: Place, promised: tuple[str, Epoch] | None) -> None:
        """Forgets a place of which nothing has come."""
        if self.places.get(place.task_id) is not place or not self._arrivals.is_unused(place):
            return
        if place.promised != promised or self._arrivals.comes(place):
            self.after_host(PROMISED_S, partial(self._look_at_promised, place, place.promised))
        else:
            self.places.drop(place)

    @on(NETWORK, LeaseKept, queue=KEEP, addressed=True)
    @on(NETWORK, DenyLease, queue=KEEP, addressed=True)
    @on(NETWORK, Pledge, queue=KEEP, addressed=True)
    @on(NETWORK, CanGuard, queue=KEEP, addressed=True)
    @on(NETWORK, TakeTask, queue=KEEP, addressed=True)
    def on_guardian(self, packet: Packet) -> None:
        """A guardian of a task says something."""
        self._guarded.heard(packet)

    # What is asked of it ---------------------------------------------------------------------------------------

    def carry_out_command(self, body: Any, slot: Slot | None, request: Request) -> None:
        if isinstance(body, control.Adopt | control.Forget | control.Revive):
            self._decisions.carry_out(body, request)
        elif isinstance(body, Create):
            self._creations.create(body, request)
        elif slot is None:
            super().carry_out_command(body, slot, request)
        elif isinstance(body, control.Migrate):
            self._mover.negotiate(slot, body, request)
        else:
            self._mover.refuse_elsewhere(slot, body)
            if isinstance(body, Remove):
                self._creations.remove(slot, body, request)
            else:
                super().carry_out_command(body, slot, request)

    def command_waits(self, slot: Slot, request: Request) -> None:
        self.look_after(self.places.at[slot.name], request)

    def refuse_start(self, slot: Slot) -> str:
        return self._arrivals.undecided(slot, self.places.at[slot.name]) or super().refuse_start(slot)


class ClientService(Service):
    """Loads the user's tasks, and spawns channels for what they say among each other.

    Each of its tasks has a durable record: it outlives a crash of its agent, and can move to another one. A service of
    one's own whose tasks are to be durable subclasses it.
    """

    class Settings(msgspec.Struct):
        """What it brings besides the tasks of the configuration.

        Attributes:
            channels: channels that are opened with the service.
        """

        channels: list[str] = []

        def __post_init__(self) -> None:
            if faults := [fault for fault in map(fault_of_name, self.channels) if fault]:
                raise ValueError(f"channels: {faults[0]}")

    _actor: ClientServiceCore

    def __init__(self, kernel: Kernel, address: str, mailbox: Mailbox | None = None, **others: Any) -> None:
        ClientServiceCore(kernel, address, mailbox, facade=self, **others)

    def on_start(self) -> None:
        if isinstance(self.settings, ClientService.Settings):  # a subclass may have settings of its own
            for channel in self.settings.channels:
                self.open_channel(channel)

    @classmethod
    def refuse_stop(cls, kernel: Kernel, name: str, arguments: Mapping[str, Any], for_s: float | None) -> str:
        state: HostState = arguments["state"]
        moving = state.under_way(name)
        return f"{join(kernel.agent, name)} must not stop while {moving[0]} is being handed over" if moving else ""
