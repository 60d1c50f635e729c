"""The Client Service: the tasks of the user, and the channels that they talk on (paper §3.3)."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, ClassVar, Final, assert_never

import msgspec

from pancakes import control
from pancakes.creation import Create, Remove
from pancakes.errors import MigrationError
from pancakes.mesh.guarding.choosing import CanGuard
from pancakes.mesh.guarding.guard_messages import DenyLease, LeaseKept, Pledge
from pancakes.mesh.guarding.taking_over import TakeTask
from pancakes.mesh.migration import effect as handoff_effect
from pancakes.mesh.migration import messages
from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.migration.record import Phase, Record, TaskId, Wanted
from pancakes.mesh.migration.rest import rest_of
from pancakes.mesh.migration.snapshot import Posted, Snapshot
from pancakes.mesh.migration.times import Times
from pancakes.mesh.migration.whereabouts import TaskAt
from pancakes.mesh.net.mesh import Mesh
from pancakes.packet import NETWORK, Packet, join
from pancakes.runtime.foundation.names import fault_of_name
from pancakes.runtime.hosting import hosting_effect, hosting_event
from pancakes.runtime.hosting.arrivals import Arrivals
from pancakes.runtime.hosting.bidding_messages import BidAwarded, MigratorBegan, MoveOver
from pancakes.runtime.hosting.births import BirthRule
from pancakes.runtime.hosting.census_messages import ClaimsCame, CopyNoticed, FactsCame, NeighbourCame
from pancakes.runtime.hosting.checkpointing import Checkpointing
from pancakes.runtime.hosting.courier_messages import AskedBegan, CameFor
from pancakes.runtime.hosting.creations import Creations, Described
from pancakes.runtime.hosting.decisions import Decisions
from pancakes.runtime.hosting.deliveries import Deliveries
from pancakes.runtime.hosting.departures import Departures
from pancakes.runtime.hosting.disputes import Disputes
from pancakes.runtime.hosting.guarded_tasks import GuardedTasks
from pancakes.runtime.hosting.host_state import HostState
from pancakes.runtime.hosting.importer import Imported
from pancakes.runtime.hosting.ledgers import Ledgers
from pancakes.runtime.hosting.machine import AnyEvent, handle
from pancakes.runtime.hosting.mover import Mover
from pancakes.runtime.hosting.now import Now
from pancakes.runtime.hosting.origins import Origins
from pancakes.runtime.hosting.peer_talk import PeerTalk
from pancakes.runtime.hosting.place import SURE, Place
from pancakes.runtime.hosting.places import Places
from pancakes.runtime.hosting.records import Records, RecordWritten
from pancakes.runtime.hosting.shared_outbox import SharedOutbox
from pancakes.runtime.hosting.snapshots import carried_of, snapshot_of
from pancakes.runtime.hosting.standing import Standing
from pancakes.runtime.hosting.waiters import Waiters
from pancakes.runtime.installed import Installed
from pancakes.runtime.kernel.handlers import on
from pancakes.runtime.kernel.keep import queue, reliable
from pancakes.runtime.kernel.kernel import Kernel
from pancakes.runtime.kernel.task_table import TaskEntry
from pancakes.runtime.life.life import RESTS
from pancakes.runtime.life.life_effect import Answer, News, Tell
from pancakes.runtime.life.request import Request, request_of
from pancakes.runtime.supervision.service_messages import PeerDown
from pancakes.runtime.supervision.slot import Slot
from pancakes.runtime.supervision.task_messages import Carried, HasNoPermit, LetterGiven, Looked, Stood
from pancakes.runtime.supervision.task_news import tell_of_task
from pancakes.service import Service
from pancakes.task import TaskSpec

KEEP: Final = reliable(1024)
"""Of each type of hand-off message; each is said again where it is needed."""
PROMISED_S: Final = 2 * Times().slot_s
"""A place that was promised is forgotten if nothing has come of it after so long, in host time."""


class ClientService(Service):
    """Loads the user's tasks, and spawns channels for what they say among each other.

    Each of its tasks has a durable record: it outlives a crash of its agent, and can move to another one. What may
    happen to it is decided by `pancakes.runtime.hosting.machine`; this actor is the one place where the events of a
    task come together, and where the effects are carried out, strictly in order. A service of one's own whose tasks are
    to be durable subclasses it.

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

    class Settings(msgspec.Struct):
        """What it brings besides the tasks of the configuration.

        Attributes:
            channels: channels that are opened with the service.
        """

        channels: list[str] = []

        def __post_init__(self) -> None:
            if faults := [fault for fault in map(fault_of_name, self.channels) if fault]:
                raise ValueError(f"channels: {faults[0]}")

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
        ledgers: Ledgers,
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

    def on_start(self) -> None:
        if isinstance(self.settings, ClientService.Settings):  # a subclass may have settings of its own
            for channel in self.settings.channels:
                self.open_channel(channel)

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
                self.feed_place(place, hosting_event.TakeUp())
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
        self.feed_place(place, hosting_event.StartConfigured(slot.fresh))
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
            if isinstance(effect, hosting_effect.HostingEffect):
                self._carry_out(place, effect, slot)
            elif slot is None:
                continue
            elif isinstance(effect, hosting_effect.SlotEffect):
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

    def _carry_out(self, place: Place, effect: hosting_effect.HostingEffect, slot: Slot | None) -> None:
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
            case hosting_effect.OpenPlace():
                self.feed_place(place, self._arrivals.open(place, effect.start))
            case hosting_effect.Unreserve():
                self.kernel.registry.unreserve(join(self.address, place.task_id.name))
            case hosting_effect.Decided():
                if place.adoption is not None:
                    self._decisions.started(place, place.adoption, effect.reason)
                if place.creation is not None:
                    self._creations.begun(place, place.creation, effect.reason)
                if place.follows is not None:
                    self._mover.followed(place, place.follows)
            case hosting_effect.Lasts():
                if place.adoption is not None or place.forgetting:
                    self._decisions.written(place, effect.why_not)
                if place.removal is not None:
                    self._creations.lasts(place, place.removal, effect.why_not)
            case hosting_effect.Drop():
                self._departures.drop(place, slot, effect.ends)
            case handoff_effect.Resume():
                self._departures.resume(place, slot)
            case handoff_effect.Seize():
                self._guarded.given(place, effect)
            case _:
                assert_never(effect)

    def _carry_out_at(self, slot: Slot, place: Place, effect: hosting_effect.SlotEffect) -> None:
        match effect:
            case hosting_effect.AskRoom():
                self.feed_place(place, self._arrivals.room(slot, place, effect))
            case hosting_effect.Prepare():
                self.feed_place(place, self._arrivals.prepare(slot, place, effect.start))
            case hosting_effect.Rested():
                self.rested(slot)
            case handoff_effect.Freeze():
                self.feed_place(place, self._departures.freeze(slot, place, effect))
            case hosting_effect.TakeDown():
                self.feed_place(place, self._departures.take_down(slot, place, effect))
            case hosting_effect.LetGoOn():
                self._departures.let_go_on(slot)
            case hosting_effect.Vacate():
                for other in self._departures.vacate(slot):
                    if isinstance(other.standing.waits, handoff_effect.StartTask):
                        self.feed_place(other, hosting_event.PlaceFree())
            case _:
                assert_never(effect)

    def _written(self, written: RecordWritten) -> None:
        self._writing -= 1
        place = self.places[written.task_id]
        if written.why_not:
            place.written = None
            self.feed_place(place, hosting_event.NotPersisted(written.why_not))
        else:
            self.feed_place(place, hosting_event.Persisted())
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
        self.feed(slot, hosting_event.CameToRest(self.snapshot_at_rest(slot)))

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
                        self.feed(slot, hosting_event.StoodStill(message.offer, message.carried, message.reason))
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

    @on(NETWORK, messages.Reserve, keep=KEEP, addressed=True)
    def on_reserve(self, packet: Packet) -> None:
        """An agent asks for a place for a task."""
        self._origins.judge(packet, self._take_in)

    @on(NETWORK, TaskAt, keep=queue(64), addressed=True)
    def on_task_at(self, packet: Packet) -> None:
        """An agent that was asked says which one has a task."""
        self._origins.told(packet)

    @on(NETWORK, messages.Reserved, keep=KEEP, addressed=True)
    @on(NETWORK, messages.Piece, keep=KEEP, addressed=True)
    @on(NETWORK, messages.Nak, keep=KEEP, addressed=True)
    @on(NETWORK, messages.Prepared, keep=KEEP, addressed=True)
    @on(NETWORK, messages.Commit, keep=KEEP, addressed=True)
    @on(NETWORK, messages.Activated, keep=KEEP, addressed=True)
    @on(NETWORK, messages.Abort, keep=KEEP, addressed=True)
    @on(NETWORK, messages.Unknown, keep=KEEP, addressed=True)
    def on_hand_off(self, packet: Packet) -> None:
        """Takes a hand-off message in."""
        self._take_in(packet)

    def _take_in(self, packet: Packet, refusal: str = "") -> None:
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

    @on(NETWORK, LeaseKept, keep=KEEP, addressed=True)
    @on(NETWORK, DenyLease, keep=KEEP, addressed=True)
    @on(NETWORK, Pledge, keep=KEEP, addressed=True)
    @on(NETWORK, CanGuard, keep=KEEP, addressed=True)
    @on(NETWORK, TakeTask, keep=KEEP, addressed=True)
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

    @classmethod
    def refuse_stop(cls, kernel: Kernel, name: str, arguments: Mapping[str, Any], for_s: float | None) -> str:
        state: HostState = arguments["state"]
        moving = state.under_way(name)
        return f"{join(kernel.agent, name)} must not stop while {moving[0]} is being handed over" if moving else ""
