"""The Client Service: the tasks of the user, and the channels that they talk on (paper §3.3)."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, Final, assert_never

import msgspec

from pancakes.control import Adopt, Configure, Describe, Forget, Migrate, Reschedule, Stop
from pancakes.errors import ControlRefused, PancakesError
from pancakes.hosting.arrivals import Arrivals
from pancakes.hosting.catalogue import Catalogue
from pancakes.hosting.checkpointing import Checkpointing
from pancakes.hosting.courier_messages import COURIER, CameFor
from pancakes.hosting.decisions import Decisions
from pancakes.hosting.deliveries import Deliveries
from pancakes.hosting.departures import Departures
from pancakes.hosting.hosting_effect import (
    AskRoom,
    Decided,
    Drop,
    HostingEffect,
    Lasts,
    LetGoOn,
    OpenPlace,
    Prepare,
    Rested,
    TakeDown,
    Unreserve,
    Vacate,
)
from pancakes.hosting.hosting_event import (
    CameToRest,
    NotPersisted,
    PartConcluded,
    Persisted,
    Room,
    StartConfigured,
    StoodStill,
    TakeUp,
)
from pancakes.hosting.machine import step, unborn
from pancakes.hosting.moves import Moves
from pancakes.hosting.place import Place
from pancakes.hosting.places import Places
from pancakes.hosting.records import Records
from pancakes.hosting.shared_outbox import SharedOutbox
from pancakes.hosting.snapshots import carried_of, snapshot_of, spec_of
from pancakes.hosting.turn import AnyEvent, Moment
from pancakes.hosting.waiters import Waiters
from pancakes.kernel.component import Component
from pancakes.kernel.tell import tell
from pancakes.life.life import RESTS
from pancakes.migration.effect import (
    Ack,
    After,
    AttemptFailed,
    Freeze,
    HandedOver,
    Persist,
    Resume,
    Send,
    Warn,
)
from pancakes.migration.messages import HandOffMessage
from pancakes.migration.record import Phase, Record, TaskId, Wanted
from pancakes.migration.rest import rest_of
from pancakes.migration.snapshot import Posted, Snapshot
from pancakes.packet import join
from pancakes.request import Request
from pancakes.service import Service
from pancakes.services.bidding_messages import Accounted, BidAwarded, Came, MigratorBegan, MoveOver, SendTo
from pancakes.services.migrator import TaskMigrator
from pancakes.slot import Slot
from pancakes.task import TaskSpec
from pancakes.task_messages import Carried, LetterGiven, Looked, Stood

MIGRATOR: Final = "network/TaskMigrator"


class ClientService(Service):
    """Loads the user's tasks, and spawns channels for what they say among each other.

    Each of its tasks has a durable record: it outlives a crash of its agent, and can move to another one. What may
    happen to it is decided by `pancakes.hosting.machine`; this actor is the one place where the events of a task come
    together, and where the effects are carried out, strictly in order. A service of one's own whose tasks are to be
    durable subclasses it.

    Args:
        records: where the records are kept.
        catalogue: where the classes of tasks that arrive are found.
        outbox: what its tasks have sent to others and is not acknowledged.

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

    durable: ClassVar[bool] = True
    keeps_changes: ClassVar[bool] = True
    # A record must have been taken up before anything else is heard of its task.
    started_at_once: ClassVar[int] = sys.maxsize

    def __init__(self, *args: Any, records: Records, catalogue: Catalogue, outbox: SharedOutbox, **others: Any) -> None:
        super().__init__(*args, **others)
        self._records = records
        self._catalogue = catalogue
        self.outbox = outbox
        self.places = Places(self.agent, self.slots)
        self.residents: frozenset[str] = frozenset()
        self._events: deque[tuple[Place, AnyEvent]] = deque()
        self._turning = False
        self._writing = 0  # how many records wait for the disk
        self._ends = False  # once all records are written
        self._checkpointing = Checkpointing(self)
        self._deliveries = Deliveries(self)
        self._waiters = Waiters(self, records)
        self._moves = Moves(self)
        self._arrivals = Arrivals(self, catalogue)
        self._departures = Departures(self)
        self._decisions = Decisions(self, records, self._moves)

    @property
    def component(self) -> Component:
        """Itself, for what is told about it."""
        return self

    # Its own life ----------------------------------------------------------------------------------------------

    def on_start(self) -> None:
        # A subclass may have settings of its own.
        if isinstance(self.settings, ClientService.Settings):
            for channel in self.settings.channels:
                self.open_channel(channel)

    def specs(self) -> Sequence[TaskSpec]:
        specs = list(super().specs())
        self.residents = frozenset(spec.name for spec in specs)
        for name in self.residents:
            self._records.claim(TaskId(self.agent, name), self.name)
        for record in self._records.all().values():
            if record.service == self.name:
                self._take_record(record, specs)
        return specs

    def _take_record(self, record: Record, specs: list[TaskSpec]) -> None:
        """Takes up a record that was on disk; adds its task, where the configuration does not have it."""
        task_id = record.task_id
        self.places.add(record)
        self._moves.found(record)
        if not record.snapshot:
            return
        try:
            snapshot = Snapshot.decode(record.snapshot)
            if task_id.name not in self.residents:
                specs.append(spec_of(snapshot, self._catalogue))
        except (PancakesError, msgspec.ValidationError) as error:
            self.log("error", f"{task_id} rests in the journal and cannot be started: {error}")
            return
        if record.phase is Phase.PREPARED:
            # A task that is in doubt may be started any moment: no other task here may take its actuators before.
            reason = self.kernel.registry.reserve(self._address_of(task_id), snapshot.requires)
            if reason:
                self.log("warning", f"no actuators are kept for {task_id}: {reason}")

    def after_start(self) -> None:
        super().after_start()
        # A tombstone has no slot, and answers all the same.
        for place in self.places:
            if self.places.slot_of(place) is None:
                self.feed_place(place, TakeUp())
        self._checkpointing.begin()
        self._moves.begin()

    def wants(self, slot: Slot) -> bool:
        record = self.places.at(slot).standing.record
        if unborn(record):
            return slot.spec.start
        # The journal wins over `start` in the configuration: a stop that a person asked for outlives a reboot.
        return record.phase is not Phase.OWNER or record.wanted is Wanted.RUNNING

    def take_up(self, slot: Slot, kept: Mapping[str, Carried] | None) -> None:
        # What a task carries is in its record.
        slot.fresh = kept is None

    def start_configured(self, slot: Slot) -> None:
        self.feed_place(self.places.at(slot), StartConfigured(slot.fresh))

    def settle_all(self) -> None:
        # The last checkpoint of each task may wait for the one before it to be written.
        self._ends = True
        self._end_if_written()

    def _end_if_written(self) -> None:
        if self._ends and not self._turning and not self._writing:
            self._ends = False
            self.end_at_last()

    # The events of its tasks -----------------------------------------------------------------------------------

    def feed(self, slot: Slot, event: Any) -> None:
        if self.slots.get(slot.name) is slot:  # else it is a late timer of a task that has left
            self.feed_place(self.places.at(slot), event)

    def feed_place(self, place: Place, event: AnyEvent) -> None:
        """Feeds an event to a task, and carries out what follows. One that comes meanwhile waits until then."""
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
        slot = self.places.slot_of(place)
        at = Moment(self.agent, self.kernel.host.now(), self.keeper.draw, self.closing)
        life, place.standing, effects = step(slot.life if slot is not None else None, place.standing, event, at)
        if slot is not None and life is not None:
            slot.life = life
        for effect in effects:
            if isinstance(effect, HostingEffect):
                self._carry_out(place, effect, slot)
            elif slot is not None:
                self.keeper.carry_out(slot, effect)

    def _carry_out(self, place: Place, effect: HostingEffect, slot: Slot | None) -> None:
        match effect:
            case Persist():
                self._persist(place, effect.record)
            case Send():
                self._send(effect.peer, effect.message)
            case After():
                self.after_host(effect.drawn_s(self.random), partial(self.feed_place, place, effect.event))
            case Warn():
                self.log("warning", effect.text)
            case Ack():
                self._deliveries.on_disk(place, effect.packet)
            case AttemptFailed():
                self._moves.attempt_failed(place, effect)
            case HandedOver():
                self._moves.handed_over(place, effect)
            case OpenPlace():
                self._arrivals.open(place, effect.start)
            case Unreserve():
                self.kernel.registry.unreserve(self._address_of(place.task_id))
            case Decided():
                self._decisions.started(place, effect.reason)
                self._moves.followed(place)
            case Lasts():
                self._decisions.written(place, effect.why_not)
            case Drop():
                self._departures.drop(place, slot, effect.ends)
            case Resume():
                self._departures.resume(place, slot)
            case AskRoom() | Prepare() | Rested() | Freeze() | TakeDown() | LetGoOn() | Vacate():
                if slot is not None:
                    self._carry_out_at(slot, place, effect)
            case _:
                assert_never(effect)

    def _carry_out_at(
        self,
        slot: Slot,
        place: Place,
        effect: AskRoom | Prepare | Rested | Freeze | TakeDown | LetGoOn | Vacate,
    ) -> None:
        """Carries out an effect for which the task has a place."""
        match effect:
            case AskRoom():
                self.feed_place(place, self._room(slot, place, effect))
            case Prepare():
                self._arrivals.prepare(slot, place, effect.start)
            case Rested():
                self.rested(slot)
            case Freeze():
                self._departures.freeze(slot, place, effect)
            case TakeDown():
                self._departures.take_down(slot, place, effect)
            case LetGoOn():
                self._departures.let_go_on(slot)
            case Vacate():
                self._departures.vacate(slot)
            case _:
                assert_never(effect)

    def _persist(self, place: Place, record: Record) -> None:
        self._writing += 1
        self._records.persist(
            record,
            self.name,
            lambda: self.call(lambda: self._written(place, Persisted())),
            lambda reason: self.call(lambda: self._written(place, NotPersisted(reason))),
        )

    def _written(self, place: Place, event: Persisted | NotPersisted) -> None:
        self._writing -= 1
        if isinstance(event, NotPersisted):
            place.written = None
        self.feed_place(place, event)
        self._checkpointing.look_at_late()

    # Starting and ending ---------------------------------------------------------------------------------------

    def _address_of(self, task_id: TaskId) -> str:
        return join(self.address, task_id.name)

    def snapshot(self, slot: Slot, carried: Carried | None, posted: Posted | None = None) -> bytes:
        """Returns a task as data, encoded."""
        sent = self.kernel.seq_of(slot.address).value - 1
        task_id = self.places.id_of(slot)
        return snapshot_of(slot, task_id, self.name, carried, self.now(), sent, posted).encode()

    def _room(self, slot: Slot, place: Place, asked: AskRoom) -> Room:
        """Sees whether a task can run here now, and what it would begin with."""
        registry, record = self.kernel.registry, place.standing.record
        if undecided := self._undecided(record):
            registry.unreserve(slot.address)
            return Room(asked, undecided, for_good=True)
        reason = self.admit(slot)
        if not reason and asked.keep:
            reason = registry.reserve(slot.address, slot.spec.cls.requires)
        if reason:
            return Room(asked, reason)
        if slot.fresh:
            slot.fresh = False
            self.drop_state(slot)
        carries = slot.carried is not None or unborn(record)
        return Room(asked, snapshot=self.snapshot(slot, slot.carried) if carries else b"")

    def spawn(self, slot: Slot) -> None:
        super().spawn(slot)
        # From here on the record is what counts, and this grows old.
        slot.carried = None

    def task_running(self, slot: Slot) -> None:
        self._deliveries.again(self.places.at(slot))
        self._moves.watch(slot)

    def write_rest(self, slot: Slot) -> None:
        carried = slot.carried
        snapshot = self.snapshot(slot, carried) if carried is not None else b""
        self.feed(slot, CameToRest(snapshot))

    def arguments_of(self, slot: Slot) -> Mapping[str, Any]:
        arguments = super().arguments_of(slot)
        if slot.spec.durability != "each":
            return arguments
        return {**arguments, "tells_each_turn": True}

    def changed(self, slot: Slot, carried: Carried) -> None:
        # It outlives a failure of the task the moment after.
        if slot.task is not None:
            self._checkpointing.save(slot, slot.task, carried)

    def carried_of(self, slot: Slot) -> Carried:
        record = self.places.at(slot).standing.record
        if slot.carried is not None or not record.snapshot:
            return super().carried_of(slot)
        return carried_of(Snapshot.decode(record.snapshot))

    def drop_state(self, slot: Slot) -> None:
        # What it has heard it has heard: its sender may not know yet, and sends that again.
        slot.carried = Carried(slot.spec.settings, {}, heard=self.carried_of(slot).heard)

    def tell_courier(self, message: object) -> None:
        """Tells this agent's courier something; nothing, while it is being started anew."""
        courier = self.kernel.registry.get(join(self.agent, COURIER))
        if courier is not None:
            tell(courier, message)

    # What others tell ------------------------------------------------------------------------------------------

    def on_receive(self, message: Any) -> Any:
        match message:
            case Looked() | Stood():
                slot = self.slots.get(message.task.name)
                if slot is not None and slot.task is not None and slot.task is message.task:
                    if isinstance(message, Looked):
                        self._checkpointing.looked(slot, slot.task, message)
                    else:
                        self.feed(slot, StoodStill(message.offer, message.carried, message.reason))
            case LetterGiven():
                self._deliveries.given(message)
            case CameFor():
                self._deliveries.arrived(message)
            case Came():
                self._arrivals.receive(message.peer, message.message, message.refusal)
            case BidAwarded():
                self._moves.awarded(message)
            case Accounted():
                self.feed_place(self.places.of(message.task_id), PartConcluded())
            case MoveOver():
                self._moves.over(message)
            case MigratorBegan():
                self._moves.migrator_began()
            case _:
                return super().on_receive(message)
        return None

    def _send(self, peer: str, message: HandOffMessage) -> None:
        self.tell_migrator(SendTo(peer, message))

    def migrator(self) -> TaskMigrator | None:
        """Returns the Task Migrator; None: it does not run."""
        component = self.kernel.registry.get(join(self.agent, MIGRATOR))
        return component if isinstance(component, TaskMigrator) else None

    def has_migrator(self) -> bool:
        return self.migrator() is not None

    def connected(self, peer: str) -> bool:
        migrator = self.migrator()
        return migrator is not None and migrator.connected(peer)

    def tell_migrator(self, message: object) -> None:
        migrator = self.migrator()
        if migrator is not None:
            tell(migrator, message)

    # What is asked of it ---------------------------------------------------------------------------------------

    def carry_out_command(self, body: Any, slot: Slot | None, request: Request) -> None:
        if isinstance(body, Adopt):
            self._decisions.adopt(body, request)
            return
        if isinstance(body, Forget):
            self._decisions.forget(body, request)
            return
        if slot is not None:
            self._refuse_elsewhere(body, slot)
        if isinstance(body, Migrate) and slot is not None:
            self._moves.ask(slot, body, request)
        else:
            super().carry_out_command(body, slot, request)

    def _refuse_elsewhere(self, body: Any, slot: Slot) -> None:
        """Refuses what cannot be asked here of a task that is on its way, or has left."""
        standing = self.places.at(slot).standing
        record, volatile = standing.record, standing.volatile
        describes = isinstance(body, Describe)
        going = volatile.freezing or record.phase in (Phase.FROZEN, Phase.COMMITTED, Phase.PREPARED)
        if going and not describes:
            peer = volatile.asked or record.peer
            raise ControlRefused(f"{slot.address} is being handed over between {self.agent} and {peer}")
        if standing.leaving and not describes:
            raise ControlRefused(f"{slot.address} was handed over, and has not ended yet")
        changes = isinstance(body, (Stop, Reschedule, Configure)) or (describes and (body.state or body.began))
        if record.phase is Phase.RELEASED and changes:
            raise ControlRefused(f"{slot.name} moved to {record.peer}")

    def command_waits(self, slot: Slot, request: Request) -> None:
        self.look_after(self.places.at(slot), request)

    def look_after(self, place: Place, request: Request) -> None:
        self._waiters.look_after(place, request)

    def refuse_start(self, slot: Slot) -> str:
        return self._undecided(self.places.at(slot).standing.record) or super().refuse_start(slot)

    def _undecided(self, record: Record) -> str:
        """Says why a task whose record was lost is not started; empty: it was not lost, or that has been decided."""
        lost = self._records.lost(record.task_id)
        return lost.undecided(self.agent) if lost is not None and record.phase is Phase.ABSENT else ""

    def has(self, name: str) -> bool:
        # What was given away and stands in doubt has no slot any more, nor has what came here and was lost.
        return super().has(name) or self._decisions.concern(name)

    def describe_task(self, slot: Slot) -> dict[str, Any]:
        told = super().describe_task(slot)
        if slot.life.state in RESTS:
            told["rest"] = rest_of(self.places.at(slot).standing.record)
        return told

    def refuse_stop(self) -> str:
        for place in self.places:
            if place.standing.record.phase in (Phase.FROZEN, Phase.COMMITTED, Phase.PREPARED):
                return f"{self.address} must not stop while {place.task_id} is being handed over"
        return ""

    # For the Task Migrator and the courier -------------------------------------------------------------------

    def knows(self, task_id: TaskId) -> bool:
        """Returns whether this service has a record of the task. Any thread."""
        place = self.places.find(task_id)
        return place is not None and not unborn(place.standing.record)
