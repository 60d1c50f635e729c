"""The Client Service: hosts the user's tasks, and opens the channels that they talk on (paper §3.3).

It is the one place where the events of a task come together. `reconcile` decides, and this actor carries the effects
out, strictly in order. The registrar of the agent keeps the registers of the tasks: it is fed what to write,
and says how each task stands. Subclass `ClientService` for a service of your own whose tasks are durable.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, ClassVar, Final, assert_never

import msgspec

from pancakes import control
from pancakes.control import Create, Remove
from pancakes.durable import reconcile, rules
from pancakes.durable.arrivals import Arrivals
from pancakes.durable.bidding_messages import BidAwarded, MigratorBegan, MoveOver
from pancakes.durable.checkpoints import Checkpointing, Deliveries, carried_of, snapshot_of
from pancakes.durable.commands import Creations, Described, Recoveries
from pancakes.durable.courier import Outbox
from pancakes.durable.delivery import AskedBegan, CameFor
from pancakes.durable.host_state import HostState, Imported
from pancakes.durable.hosting import SURE, Pending, Place, Places
from pancakes.durable.installed import Installed
from pancakes.durable.messages import REGISTRAR
from pancakes.durable.migration import Departures, Mover
from pancakes.durable.peer_talk import PeerTalk
from pancakes.durable.questions import BirthRule, Disputes
from pancakes.durable.reconcile import AnyEvent, Course, Now, Outcome, Write, handle
from pancakes.durable.record import TaskId, rest_of
from pancakes.durable.register import Standing, Wanted
from pancakes.durable.register_messages import (
    CannotStart,
    CopyNoticed,
    Feed,
    GoodbyeSaid,
    Guarded,
    HostBegan,
    HostEnded,
    Judge,
    Judged,
    KnownCame,
    NeighbourCame,
    OfferRefused,
    PermitOver,
    RegistrarBegan,
    Stands,
)
from pancakes.durable.rules import Memory, desired
from pancakes.durable.snapshot import Posted, Snapshot
from pancakes.durable.store import MigrationReports, Records
from pancakes.errors import ControlRefusedError, MigrationError
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import Mailbox
from pancakes.kernel.registry import TaskEntry
from pancakes.mesh.mesh import Mesh
from pancakes.packet import join
from pancakes.service import Service
from pancakes.supervision.lifecycle import RESTS, Answer, News, Request, State, Tell, request_of
from pancakes.supervision.messages import Carried, HasNoPermit, LetterGiven, Looked, Stood
from pancakes.supervision.service_core import ServiceCore
from pancakes.supervision.slots import Slot, tell_of_task
from pancakes.task import TaskSpec
from pancakes.util.text import fault_of_name

JOURNAL_S: Final = 1.5
"""The sender of a request that waits for the journal is told so after this time, in host time."""
GOODBYE_S: Final = 1.0
"""A service that ends waits this long until the members of its guarded tasks are told, in host time."""
GUARDIANS_S: Final = 4.0
"""That of one that waits for guardians is told so after this time, in host time."""
LOOK_AGAIN_S: Final = 0.25
"""What the journal has begun to write meanwhile may fail a moment later."""


class ClientServiceCore(ServiceCore):
    """Runs a Client Service.

    Each of its tasks has a durable record: it outlives a crash of its agent, and can move to another one.

    Args:
        records: what the agent has on disk of tasks.
        catalogue: where the classes of tasks that arrive are found.
        outbox: what its tasks have sent to others and is not acknowledged.
        state: what this agent could be to a task from elsewhere.
        mesh: says what neighbours are connected.
        births: what to ask before a task is born.
        ledgers: the account of tasks that are created and removed.
        described: reads the table of a task that no file names.

    Attributes:
        me: this agent as an owner of tasks.
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
        outbox: Outbox,
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
        talk = PeerTalk(self, mesh)
        self.me, self.boot, self.connected = talk.me, talk.boot, talk.connected
        self.places = Places(self.me, self.slots)
        self.residents: frozenset[str] = frozenset()
        self._events: deque[tuple[Place, AnyEvent]] = deque()
        self._turning = False
        self._ends = False  # once all records are written
        self._says_goodbye = False
        self._tokens = 0
        self._pending: dict[int, Pending] = {}  # what the registrar was told of, by token
        self._checkpointing = Checkpointing(self)
        self._deliveries = Deliveries(self)
        self.on_disk = self._deliveries.on_disk
        self._mover = Mover(self)
        self._disputes = Disputes(self, records, mesh, births)
        self._arrivals = Arrivals(self, catalogue, records, state, self._disputes)
        self._departures = Departures(self)
        self._recoveries = Recoveries(self, records, self._mover, self._arrivals, self._disputes)
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
                place.course = Course(record, desired(self.me, record.register, Memory()))
                self._mover.found(record)
                specs += self._arrivals.found(place)
        return specs

    def after_start(self) -> None:
        super().after_start()
        # A tombstone has no slot, and answers all the same.
        for place in list(self.places.values()):
            if place.slot is None:
                self.feed_place(place, reconcile.ServiceBegan())
        self.kernel.tell(REGISTRAR, HostBegan(self))
        for place in list(self.places.values()):
            self.guard(place)
        self._mover.begin()
        self._disputes.begin()

    def wants(self, slot: Slot) -> bool:
        record = self.places.at[slot.name].record
        if record.may_begin:
            return slot.spec.start
        # The journal wins over `start` in the configuration: a stop that a person asked for outlives a reboot.
        return not record.owned or record.wanted is Wanted.RUNNING

    def take_up(self, slot: Slot, kept: Mapping[str, Carried] | None) -> None:
        # What a task carries is in its record.
        slot.fresh = kept is None

    def start_configured(self, slot: Slot) -> None:
        self.feed_place(self.places.at[slot.name], reconcile.ServiceBegan(slot.fresh))

    def settle_all(self) -> None:
        # The last checkpoint of each task may wait for the one before it to be written.
        self._ends = True
        self._end_if_written()

    def _end_if_written(self) -> None:
        if self._ends and not self._turning and all(it.written for it in self._pending.values()):
            self._ends = False
            goodbye = self.kernel.stopping
            told = self.kernel.tell(REGISTRAR, HostEnded(self.name, goodbye))
            if told and goodbye and any(it.record.owned and it.record.guarded for it in self.places.values()):
                self._says_goodbye = True  # before the links to the members are closed
                self.after_host(GOODBYE_S, self._end_after_goodbye)
            else:
                self.end_at_last()

    def _end_after_goodbye(self) -> None:
        if self._says_goodbye:
            self._says_goodbye = False
            self.end_at_last()

    # The events of its tasks -----------------------------------------------------------------------------------

    def feed(self, slot: Slot, event: Any) -> None:
        name = slot.name
        if self.slots.get(name) is slot:  # else it is a late timer of a task that has left
            self.feed_place(self.places.at[name], event)

    def feed_place(self, place: Place, event: AnyEvent | None) -> None:
        """Feed an event to a task, and carry out what follows. One that comes meanwhile waits until then."""
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
        slot, before = place.slot, place.course
        at = Now(self.agent, self.kernel.host.now(), self.keeper.draw, self.closing, place.removal is not None)
        life, place.course, effects = handle(slot.life if slot is not None else None, place.course, event, at)
        if slot is not None and life is not None:
            slot.life = life
            # A task that was stopped waits for nobody any more.
            waits = life.state is State.REFUSED or place.unsure.for_good
            word = place.unsure.word if waits else ""
            slot.rest = rest_of(place.record, word) if life.state in RESTS else ""
            self.kernel.tasks.enter(TaskEntry.of(self.name, slot))
        record = place.record
        if record.owned and (not before.record.owned or before.record.epoch != record.epoch):
            self._deliveries.became_owner(place)
            self._disputes.became_owner(place)
            self.guard(place)
        if record.disputed and not before.record.disputed:
            self._disputes.was_paused(place)
        for effect in effects:
            if isinstance(effect, reconcile.HostEffect):
                self._carry_out(place, effect, slot)
            elif slot is None:
                continue
            elif isinstance(effect, reconcile.SlotEffect):
                self._carry_out_at(slot, place, effect)
            else:
                self.keeper.carry_out(slot, effect)
        if place.record.here is not before.record.here or place.course.leaving is not before.leaving:
            self.places.bind(place.task_id.name)

    def describe_in_detail(self, slot: Slot) -> dict[str, Any]:
        return {**super().describe_in_detail(slot), "task_id": str(self.places.at[slot.name].task_id)}

    def open_slot(self, spec: TaskSpec) -> Slot:
        slot = super().open_slot(spec)
        self.places.bind(spec.name)
        place = self.places.at[spec.name]
        self._checkpointing.begin()
        if rest := rest_of(place.record, place.unsure.word):
            slot.rest = rest
            self.show(slot)
        self.guard(place)
        return slot

    def guard(self, place: Place) -> None:
        """Tell the registrar how to guard a task."""
        slot = place.slot
        if slot is not None and place.record.owned and (slot.spec.guard is not None or place.record.guarded):
            rule = slot.spec.guard if place.removal is None else None
            self.kernel.tell(REGISTRAR, Guarded(place.task_id, slot.spec.type, rule, self._as_of_s(place)))
            self._checkpointing.guarded(place)

    def _as_of_s(self, place: Place) -> float:
        runs = place.slot is not None and place.slot.task is not None
        return place.looked_s if runs and place.looked_s else self.kernel.host.now()

    def tell_registrar(
        self,
        place: Place,
        event: Any,
        then: Callable[[Outcome, str], None] | None = None,
        *,
        write: Write | None = None,
        sequel: bytes = b"",
        is_checkpoint: bool = False,
    ) -> None:
        if write is Write.SAVE:
            place.course = msgspec.structs.replace(place.course, pending=(*place.course.pending, write))
        self._tokens += 1
        self._pending[self._tokens] = Pending(place, write, then)
        feed = Feed(place.task_id, event, self._tokens, self.name, place.record.epoch, sequel, is_checkpoint)
        if not self.kernel.tell(REGISTRAR, feed):
            self._lapsed([self._tokens])

    def _stands(self, stands: Stands) -> None:
        place = self.places[stands.task_id]
        if stands.record.standing is Standing.HEIR:
            self.state.free(stands.task_id)  # it has come
        place.came_from = stands.taken_from or place.came_from
        mine: list[tuple[Write, Outcome, str]] = []
        others: list[tuple[Callable[[Outcome, str], None], Outcome, str]] = []
        for token, outcome, why in stands.outcomes:
            pending = self._pending.get(token)
            if pending is None:
                continue
            pending.written = outcome is not Outcome.DELAYED
            if outcome not in (Outcome.WRITTEN, Outcome.DELAYED):
                del self._pending[token]
            if pending.then is not None:
                others.append((pending.then, outcome, why))
            if pending.write is not None:
                mine.append((pending.write, outcome, why))
        self.feed_place(place, reconcile.Came(stands.record, stands.desired, tuple(mine)))
        for then, outcome, why in others:
            then(outcome, why)
        self._end_if_written()
        if self._checkpointing.late:
            self._checkpointing.look_at_late()

    def _lapsed(self, tokens: list[int]) -> None:
        """The registrar has started again: nothing is known of these writes."""
        for token in tokens:
            pending = self._pending.pop(token, None)
            if pending is None:
                continue
            if pending.then is not None:
                pending.then(Outcome.FAILED, "the registrar was started again")
            if pending.write is not None:
                why = "the registrar was started again"
                course = pending.place.course
                came = reconcile.Came(course.record, course.desired, ((pending.write, Outcome.FAILED, why),))
                self.feed_place(pending.place, came)

    def _carry_out(self, place: Place, effect: reconcile.HostEffect, slot: Slot | None) -> None:
        match effect:
            case reconcile.Tell():
                if effect.write is Write.REST and place.then:
                    self._mover.write_stop(place, effect.event)
                else:
                    self.tell_registrar(place, effect.event, write=effect.write, sequel=effect.sequel)
                if effect.write is Write.REST and place.record.guarded:
                    self._departures.look_at_rest(place)
            case reconcile.After():
                self.after_host(effect.delay_s, partial(self.feed_place, place, effect.event))
            case reconcile.Warn():
                self.log("warning", effect.text)
            case reconcile.AttemptFailed():
                self._mover.attempt_failed(place, effect)
            case reconcile.HandedOver():
                self._mover.handed_over(place, effect)
            case reconcile.OpenPlace():
                opened = self._arrivals.open(place)
                if isinstance(opened, reconcile.NoPlace):
                    self.kernel.tell(REGISTRAR, CannotStart(place.task_id))
                self.feed_place(place, opened)
            case reconcile.Unreserve():
                self.kernel.registry.unreserve(join(self.address, place.task_id.name))
            case reconcile.Decided():
                if place.recovery is not None:
                    self._recoveries.started(place, place.recovery, effect.reason)
                if place.creation is not None:
                    self._creations.begun(place, place.creation, effect.reason)
                if place.follows is not None:
                    self._mover.followed(place, place.follows)
            case reconcile.Drop():
                self._departures.drop(place, slot, effect.ends)
            case reconcile.Resume():
                self._departures.resume(place, slot)
            case _:
                assert_never(effect)

    def _carry_out_at(self, slot: Slot, place: Place, effect: reconcile.SlotEffect) -> None:
        match effect:
            case reconcile.AskRoom():
                self.feed_place(place, self._arrivals.room(slot, place, effect))
            case reconcile.Prepare():
                self.feed_place(place, self._arrivals.prepare(slot, place, effect.fresh))
            case reconcile.Rested():
                self.rested(slot)
            case reconcile.Freeze():
                self.feed_place(place, self._departures.freeze(slot, place, effect))
            case reconcile.TakeDown():
                self.feed_place(place, self._departures.take_down(slot, place, effect))
            case reconcile.LetGoOn():
                place.held = False
                self._departures.let_go_on(slot, place)
            case reconcile.Hold():
                self._hold(slot, place)
            case reconcile.Vacate():
                others = self._departures.vacate(slot)
                self.places.bind(slot.name)
                for other in others:
                    if other is not place:
                        self.feed_place(other, reconcile.PlaceFree())
            case _:
                assert_never(effect)

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
        place = self.places.at[slot.name]
        if place.removal is not None and self._creations.has_stopped(place, effect):
            return  # it is answered once it is removed
        super().answer(slot, effect)

    def write_rest(self, slot: Slot) -> None:
        self.feed(slot, reconcile.CameToRest(self.snapshot_at_rest(slot)))

    def arguments_of(self, slot: Slot) -> Mapping[str, Any]:
        told = {"tells_each_turn": True} if slot.spec.durability == "each" else {}
        return {**super().arguments_of(slot), **told}

    def changed(self, slot: Slot, carried: Carried) -> None:
        # It outlives a failure of the task the moment after.
        if slot.task is not None:
            self._checkpointing.save(slot, carried)

    def carried_of(self, slot: Slot) -> Carried:
        record = self.places.at[slot.name].record
        if slot.carried is None and record.snapshot:
            with suppress(MigrationError):  # if it is started, that is said
                return carried_of(Snapshot.decode(record.snapshot))
        return super().carried_of(slot)

    def drop_state(self, slot: Slot) -> None:
        # What it has heard it has heard: its sender may not know yet, and sends that again.
        slot.carried = Carried(slot.spec.settings, {}, heard=self.carried_of(slot).heard)

    # What others tell ------------------------------------------------------------------------------------------

    def take_message(self, message: Any) -> Any:
        match message:
            case Stands():
                self._stands(message)
            case RegistrarBegan():
                self._lapsed(list(self._pending))
            case GoodbyeSaid():
                self._end_after_goodbye()
            case Judge():
                refusal = self._arrivals.judge(message)
                self.kernel.tell(REGISTRAR, Judged(message.number, refusal))
            case OfferRefused():
                if (place := self.places.get(message.task_id)) is not None:
                    self.feed_place(place, reconcile.Refused(message.refusal))
            case Looked() | Stood() | HasNoPermit():
                slot = self.slots.get(message.task.name)
                if slot is not None and slot.task is not None and slot.task is message.task:
                    if isinstance(message, Looked):
                        self._checkpointing.looked(slot, message)
                        super().take_message(message)
                    elif isinstance(message, Stood):
                        self.feed(slot, reconcile.StoodStill(message.number, message.carried, message.reason))
                    else:
                        self._has_no_permit(slot, self.places.at[slot.name])
            case LetterGiven():
                self._deliveries.given(message)
            case CameFor():
                self._deliveries.arrived(message)
            case AskedBegan():
                self._deliveries.asked_began(message)
            case NeighbourCame() | KnownCame() | CopyNoticed():
                self._disputes.heard(message)
            case Imported():
                self.begin_command(message.waiting, request_of(message.waiting))
            case BidAwarded() | MoveOver():
                self._mover.heard(self.places[message.task_id], message)
            case MigratorBegan():
                self._mover.migrator_began()
            case _:
                return super().take_message(message)
        return None

    def _has_no_permit(self, slot: Slot, place: Place) -> None:
        """A task has found its permit over, and is paused."""
        if self.kernel.permits.may_act(slot.fence):
            self._departures.let_go_on(slot, place)  # its guardians have answered since
        else:
            self._hold(slot, place)
            self.kernel.tell(REGISTRAR, PermitOver(place.task_id))

    def _hold(self, slot: Slot, place: Place) -> None:
        if not place.held:
            place.held = True
            self.hold_actuators(slot, "its guardians do not answer")

    # What is asked of it ---------------------------------------------------------------------------------------

    def carry_out_command(self, body: Any, slot: Slot | None, request: Request) -> None:
        if isinstance(body, control.Adopt):
            self._recoveries.adopt(body, request)
        elif isinstance(body, control.Forget):
            self._recoveries.forget(body, request)
        elif isinstance(body, control.Revive):
            self._recoveries.revive(body, request)
        elif isinstance(body, Create):
            self._creations.create(body, request)
        elif slot is None:
            super().carry_out_command(body, slot, request)
        elif isinstance(body, control.Migrate):
            self._mover.negotiate(slot, body, request)
        else:
            self._mover.refuse_elsewhere(slot, body)
            place = self.places.at[slot.name]
            if isinstance(body, Remove):
                self._creations.remove(slot, body, request)
            elif isinstance(body, control.Stop) and body.then:
                self._mover.check_follower(slot, body.then)
                before, place.then = place.then, body.then if not body.dry_run else place.then
                try:
                    super().carry_out_command(msgspec.structs.replace(body, then=""), slot, request)
                except ControlRefusedError:
                    place.then = before
                    raise
                self._mover.look_at_stopped(slot, place)
            else:
                if isinstance(body, control.Stop | control.Start | control.Restart) and not body.dry_run:
                    place.then = ""  # another decision
                super().carry_out_command(body, slot, request)

    def command_waits(self, slot: Slot, request: Request) -> None:
        self.look_after(self.places.at[slot.name], request)

    def look_after(self, place: Place, request: Request) -> None:
        """See to it that a request about a task is answered, if that waits for the journal or for guardians.

        What was asked for is done all the same once the journal can write, or more than half of them answer.
        """
        self.after_host(JOURNAL_S, partial(self._look, place, request, self.kernel.host.now()))

    def _look(self, place: Place, request: Request, since_s: float) -> None:
        if not self.waits(request):
            return
        if why := self._why_waits(place, request, self.kernel.host.now() - since_s):
            self.put_off(request, why)
        else:
            self.after_host(LOOK_AGAIN_S, partial(self._look, place, request, since_s))

    def _why_waits(self, place: Place, request: Request, waited_s: float) -> str:
        """Return what a request waits for, as a sentence; empty: that is not known, or it may still be done in time."""
        slot, record = place.slot, place.record
        what = slot.how_it_is if slot is not None else str(place.task_id)
        is_written = place.course.settled and all(it.written for it in self._pending.values() if it.place is place)
        if not is_written and (trouble := self._records.trouble(place.task_id)):
            return f"{what}; what was asked for waits: {trouble}. It is done as soon as the journal can write"
        if not record.guarded or waited_s < GUARDIANS_S:
            return ""
        others = ", ".join(sorted({one.agent for one in record.members} - {self.agent}))
        if place.removal == request:
            freed = f"{place.task_id} is stopped, and is removed once more than half of its guardians let go of it"
            return f"{freed} ({others})"
        starts = slot is not None and slot.life.state in (State.ASKED, State.CALLED_OFF)
        if not starts or place.course.desired is rules.Desired.RUN:
            return ""
        waits = f"{what}; what was asked for waits for its guardians ({others})"
        return f"{waits}. It is done once more than half of them answer"

    def refuse_reload(self, slot: Slot) -> None:
        place = self.places.at[slot.name]
        self._mover.refuse_elsewhere(slot, control.Restart(slot.name))
        if place.move is not None or place.creation is not None:
            raise ControlRefusedError(f"{slot.address} is about to be moved or created: try again", "busy")
        if place.held:
            raise ControlRefusedError(
                f"{slot.address} is paused, because its guardians do not answer: try again", "busy"
            )

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
