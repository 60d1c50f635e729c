"""Services whose tasks have a durable record each, and go on where they were when their agent comes back."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from functools import partial
from typing import Any, ClassVar

import msgspec
from msgspec.structs import replace

from pancakes.arrays import alike
from pancakes.closing import CLOSES
from pancakes.control import Configure, Describe, Reschedule, Stop
from pancakes.errors import ControlRefused, PancakesError
from pancakes.kernel.tell import tell
from pancakes.life.life import RESTS, State
from pancakes.life.life_event import Admitted, LeaveRefused, PutOff, StartAsked, StopAsked, Written
from pancakes.migration.effect import (
    Ack,
    After,
    Effect,
    Persist,
    StartTask,
    Warn,
)
from pancakes.migration.event import Born, Checkpoint, Ended, Event
from pancakes.migration.event import Start as StartAgain
from pancakes.migration.handoff import HandOff
from pancakes.migration.record import NO_EPOCH, Phase, Record, TaskId, Wanted
from pancakes.migration.rest import rest_of
from pancakes.migration.snapshot import Posted, Snapshot
from pancakes.packet import Fence, join
from pancakes.request import Request
from pancakes.service import Service
from pancakes.services.catalogue import Catalogue
from pancakes.services.checkpoints import Checkpoints, plain_of
from pancakes.services.lost import Lost
from pancakes.services.postbox import CameFor, Postbox
from pancakes.services.records import Records
from pancakes.services.snapshots import begins_alike, carried_of, settings_now, snapshot_of, spec_of
from pancakes.services.waiters import Waiters
from pancakes.slot import Slot
from pancakes.task import Task, TaskSpec
from pancakes.task_messages import Carried, LetterGiven, Look, Looked
from pancakes.weight import in_brief

CHECKPOINT_S = 1.0
"""How often, in host time, a task whose state has changed is written down (`durability = "lazy"`)."""
CHECKPOINTS_AT_ONCE = 20
"""So many tasks are looked at in one go; a look at a thousand would make all of them 20 ms late, each second."""


class Leave(Enum):
    """How a task gets leave to start, where not by a new entry in its record."""

    RECOVERED = "recovered"
    """By its record as it was found on disk."""
    GRANTED = "granted"
    """It has leave: its record says that it runs."""
    AGAIN = "again"
    """By an entry that says that it runs again; the actor that ran before is gone."""
    WANTED = "wanted"
    """By an entry, also where another task has its actuators just now: it follows once these are free."""


class RecordedService(Service):
    """A service whose tasks have durable records: they outlive a crash of their agent.

    Args:
        records: where the records are kept.
        catalogue: where the classes of tasks that arrive are found.
    """

    durable: ClassVar[bool] = True
    keeps_changes: ClassVar[bool] = True
    # A record must have been taken up before anything else is heard of its task.
    started_at_once: ClassVar[int] = sys.maxsize

    def __init__(self, *args: Any, records: Records, catalogue: Catalogue, **others: Any) -> None:
        super().__init__(*args, **others)
        self._records = records
        self._catalogue = catalogue
        self.hand_offs: dict[TaskId, HandOff] = {}
        self._ids: dict[str, list[TaskId]] = {}  # of all hand-offs, by the task's name
        self._starting: dict[TaskId, list[Callable[[str], None]]] = {}
        self._checkpoints = Checkpoints()
        self._arriving: dict[TaskId, str] = {}
        self._leaving: set[str] = set()
        self._late: dict[str, None] = {}  # tasks whose checkpoint had to wait
        self._residents: set[str] = set()
        self._leave: dict[TaskId, Leave] = {}  # what the next start of a task begins with, where not with its record
        self._when_ended: dict[str, Callable[[], None]] = {}  # what follows once the actor of a task has ended
        self._begins: dict[TaskId, Callable[[], None]] = {}  # what follows once the start of a task is decided
        self._stopped: dict[TaskId, list[Callable[[str], None]]] = {}  # who waits for a stop to be on disk
        self._writing = 0  # how many records wait for the disk
        self._ends = False  # once all records are written
        self._postbox = Postbox(self)
        self._waiters = Waiters(self, records)

    # Records and slots -----------------------------------------------------------------------------------------

    def specs(self) -> Sequence[TaskSpec]:
        specs = super().specs()
        self._residents = {spec.name for spec in specs}
        for name in self._residents:
            self._records.claim(TaskId(self.agent, name), self.name)
        for record in self._records.all().values():
            if self._is_ours(record):
                self._add_hand_off(record)
        for hand_off in list(self.hand_offs.values()):
            name = hand_off.record.task_id.name
            if name not in self._residents and hand_off.record.snapshot:
                try:
                    specs = (*specs, spec_of(Snapshot.decode(hand_off.record.snapshot), self._catalogue))
                except (PancakesError, msgspec.ValidationError) as error:
                    self.log("error", f"{hand_off.record.task_id} rests in the journal and cannot be started: {error}")
        return specs

    def after_start(self) -> None:
        super().after_start()
        # A tombstone has no slot, and answers all the same.
        for hand_off in self.hand_offs.values():
            if self._slot_of(hand_off.record.task_id) is None:
                hand_off.recover()
        self.after_host(CHECKPOINT_S, self._checkpoint_all)

    def _is_ours(self, record: Record) -> bool:
        if record.service:
            return record.service == self.name
        # Written before records said whose they are.
        if record.snapshot:
            try:
                return Snapshot.decode(record.snapshot).service == self.name
            except PancakesError as error:
                self.log("error", f"the snapshot of {record.task_id} in the journal is not used: {error}")
                return False
        return self.name == "client" or record.task_id.name in self._residents

    def id_of(self, slot: Slot) -> TaskId:
        """Returns a task's identity for life: of one that came from elsewhere, its birthplace's."""
        for task_id in self._ids.get(slot.name, ()):
            if self.hand_offs[task_id].record.phase not in (Phase.ABSENT, Phase.RELEASED):
                return task_id
        return TaskId(self.agent, slot.name)

    def hand_off(self, task_id: TaskId) -> HandOff:
        """Returns the hand-off of a task, making it where this agent has never heard of the task."""
        hand_off = self.hand_offs.get(task_id)
        if hand_off is None:
            hand_off = self._add_hand_off(Record(task_id))
        return hand_off

    def _add_hand_off(self, record: Record) -> HandOff:
        hand_off = self.hand_offs[record.task_id] = HandOff(self.agent, record, self)
        self._ids.setdefault(record.task_id.name, []).append(record.task_id)
        return hand_off

    def _place_of(self, task_id: TaskId) -> str:
        return join(self.address, task_id.name)

    def _slot_of(self, task_id: TaskId) -> Slot | None:
        slot = self.slots.get(task_id.name)
        return slot if slot is not None and self.id_of(slot) == task_id else None

    def _snapshot(self, slot: Slot, carried: Carried | None, posted: Posted | None = None) -> bytes:
        sent = self.kernel.seq_of(slot.address).value - 1
        return snapshot_of(slot, self.id_of(slot), self.name, carried, self.now(), sent, posted).encode()

    # Starting and ending ---------------------------------------------------------------------------------------

    def wants(self, slot: Slot) -> bool:
        hand_off = self.hand_offs.get(self.id_of(slot))
        if hand_off is None:
            return slot.spec.start
        # The journal wins over `start` in the configuration: a stop that somebody asked for outlives a reboot.
        record = hand_off.record
        return record.phase is not Phase.OWNER or record.wanted is Wanted.RUNNING

    def take_up(self, slot: Slot, kept: Mapping[str, Carried] | None) -> None:
        # What a task carries is in its record.
        slot.fresh = kept is None

    def start_configured(self, slot: Slot) -> None:
        task_id = self.id_of(slot)
        hand_off = self.hand_offs.get(task_id)
        phase = hand_off.record.phase if hand_off is not None else Phase.OWNER
        if hand_off is not None and not (slot.fresh and phase is Phase.OWNER):
            if phase not in (Phase.OWNER, Phase.FROZEN):
                hand_off.recover()
                self.settle(slot)
                return
            self._leave[task_id] = Leave.RECOVERED
        self.feed(slot, StartAsked())

    def ask_leave(self, slot: Slot, again: bool) -> None:
        task_id = self.id_of(slot)
        leave = self._leave.pop(task_id, Leave.AGAIN if again and slot.life.asker is None else None)
        hand_off = self.hand_off(task_id)
        record = hand_off.record
        if leave is Leave.GRANTED:
            return
        if self.closing:
            self.feed(slot, LeaveRefused(CLOSES))
        elif leave is Leave.RECOVERED:
            hand_off.recover()
        elif leave is Leave.AGAIN:
            hand_off.feed(StartAgain(again=True))
        elif undecided := self._undecided(record):
            self.kernel.registry.unreserve(slot.address)
            self.feed(slot, LeaveRefused(undecided, for_good=True))
        elif reason := self._lacks(slot, record, leave):
            self.feed(slot, LeaveRefused(reason))
        else:
            self._enter_start(slot, hand_off, again)

    def _lacks(self, slot: Slot, record: Record, leave: Leave | None) -> str:
        """Says what keeps a task from running; empty: nothing, and its actuators are kept for it from now on."""
        reason = self.admit(slot)
        born = record.phase is Phase.ABSENT and slot.life.asker is None
        if reason or born or leave is Leave.WANTED:
            return reason
        # Of two tasks that are to start at once, the second is refused here, before its record says that it is wanted.
        return self.kernel.registry.reserve(slot.address, slot.spec.cls.requires)

    def _enter_start(self, slot: Slot, hand_off: HandOff, again: bool) -> None:
        record = hand_off.record
        if slot.fresh:
            slot.fresh = False
            self.drop_state(slot)
        if record.phase is Phase.ABSENT and record.seen == NO_EPOCH:
            hand_off.feed(Born(self._snapshot(slot, slot.carried)))
            return
        if slot.carried is not None and record.phase is Phase.OWNER:
            hand_off.feed(Ended(Wanted.STOPPED, self._snapshot(slot, slot.carried)))
            again = False
        hand_off.feed(StartAgain(again))

    def spawn(self, slot: Slot) -> None:
        super().spawn(slot)
        # From here on the record is what counts, and this grows old.
        slot.carried = None

    def settle(self, slot: Slot, reason: str = "") -> None:
        super().settle(slot, reason)
        if slot.life.state is State.ASKED:
            return  # nothing but the agent goes on without it
        task_id = self.id_of(slot)
        for then in self._starting.pop(task_id, []):
            then(reason)
        begun = self._begins.pop(task_id, None)
        if begun is None:
            return
        if slot.life.state is State.REFUSED:
            # It does not run, but it is still wanted: a start that is asked for may follow.
            self.hand_off(task_id).feed(Ended(Wanted.RUNNING))
        begun()

    def refuse_start(self, slot: Slot) -> str:
        return self._undecided(self.hand_off(self.id_of(slot)).record) or super().refuse_start(slot)

    def _undecided(self, record: Record) -> str:
        """Says why a task whose record was lost is not started; empty: it was not lost, or that has been decided."""
        lost = self._records.lost(record.task_id)
        return lost.undecided(self.agent) if lost is not None and record.phase is Phase.ABSENT else ""

    def lost_of(self, name: str) -> list[Lost]:
        """Returns the tasks of a name whose records were lost, and that are this service's. Any thread."""
        return [
            lost
            for lost in self._records.all_lost()
            if lost.task_id.name == name and self._records.decider_of(lost) == self.name
        ]

    def first_snapshot(self, slot: Slot) -> bytes:
        """Returns how a task begins that begins as its configuration says, encoded."""
        return self._snapshot(slot, slot.carried)

    def start_by(self, task_id: TaskId, event: Event, then: Callable[[str], None], request: Request) -> None:
        """Feeds an event that starts a task; `then` is told an empty string once it runs, or why it does not."""
        self._starting.setdefault(task_id, []).append(then)
        self._waiters.look_after(task_id, request)
        self.hand_off(task_id).feed(event)

    def write_by(self, task_id: TaskId, event: Event, then: Callable[[str], None], request: Request) -> None:
        """Feeds an event that only changes a record; `then` is told an empty string once it is on disk, or why not."""
        self._stopped.setdefault(task_id, []).append(then)
        self._waiters.look_after(task_id, request)
        self.hand_off(task_id).feed(event)

    def carried_of(self, slot: Slot) -> Carried:
        record = self.hand_off(self.id_of(slot)).record
        if slot.carried is not None or not record.snapshot:
            return super().carried_of(slot)
        return carried_of(Snapshot.decode(record.snapshot))

    def drop_state(self, slot: Slot) -> None:
        # What it has heard it has heard: its sender may not know yet, and sends that again.
        slot.carried = Carried(slot.spec.settings, {}, heard=self.carried_of(slot).heard)

    def describe_task(self, slot: Slot) -> dict[str, Any]:
        told = super().describe_task(slot)
        hand_off = self.hand_offs.get(self.id_of(slot))
        if hand_off is not None and slot.life.state in RESTS:
            told["rest"] = rest_of(hand_off.record)
        return told

    def write_rest(self, slot: Slot) -> None:
        if slot.name in self._leaving:
            self._leaving.discard(slot.name)
            self._forget(slot)
        else:
            self._enter_rest(slot)
        self.rested(slot)
        then = self._when_ended.pop(slot.name, None)
        if then is not None:
            then()

    def _enter_rest(self, slot: Slot) -> None:
        hand_off = self.hand_offs.get(self.id_of(slot))
        if hand_off is None or hand_off.record.phase is not Phase.OWNER:
            self.feed(slot, Written())
            return
        snapshot = self._snapshot(slot, slot.carried) if slot.carried is not None else b""
        if self.closing and slot.life.wanted:
            # The task itself was not asked to end: it goes on when its service comes back. Each record costs a wait for
            # the disk, and of a thousand tasks most have nothing new in it.
            if snapshot and not (hand_off.idle and begins_alike(snapshot, hand_off.record.snapshot)):
                hand_off.feed(Checkpoint(hand_off.record.epoch, hand_off.record.incarnation, snapshot))
            self.feed(slot, Written())
            return
        wanted = Wanted.STOPPED
        if slot.life.state is State.FAILED:
            # What is tried again later is still wanted, also after a reboot.
            wanted = Wanted.FAILED if slot.life.restarts.due_s is None else Wanted.RUNNING
        hand_off.feed(Ended(wanted, snapshot))
        self._when_settled(hand_off, lambda why_not: self.feed(slot, Written(why_not)))

    def _when_settled(self, hand_off: HandOff, then: Callable[[str], None]) -> None:
        """Calls `then` once all that was decided of a task is on disk, or with the reason why it is not."""
        if hand_off.settled:
            then("")
        else:
            self._stopped.setdefault(hand_off.record.task_id, []).append(then)

    def task_running(self, slot: Slot) -> None:
        self._postbox.again(slot)

    def _forget(self, slot: Slot) -> None:
        """A task was given away: what is left of it here is the tombstone in the journal."""
        self.let_go(slot)
        self.feed(slot, StopAsked(reason="it is elsewhere"))
        slot.carried = None
        slot.mailbox.clear_data()
        courier = self._postbox.courier()
        if courier is not None and slot.fence is not None:
            courier.ended(slot.fence.task_id)
        if slot.name not in self._residents:
            del self.slots[slot.name]

    def settle_all(self) -> None:
        # The last checkpoint of each task may wait for the one before it to be written.
        self._ends = True
        self._look_written()

    def _look_written(self) -> None:
        if self._ends and not self._writing:
            self._ends = False
            self.end_at_last()

    def _not_written(self, hand_off: HandOff, reason: str) -> None:
        task_id = hand_off.record.task_id
        self._checkpoints.forget(task_id)
        hand_off.failed(reason)
        slot = self._slot_of(task_id)
        if slot is not None and slot.life.state is State.ASKED:
            self.feed(slot, PutOff(reason))
        if hand_off.settled:
            # It is not tried again.
            for then in self._stopped.pop(task_id, []):
                then(reason)

    def command_waits(self, slot: Slot, request: Request) -> None:
        self._waiters.look_after(self.id_of(slot), request)

    def _written(self, hand_off: HandOff, done: Callable[[], None]) -> None:
        self._writing -= 1
        done()
        self._tell_stopped(hand_off)
        self._look_written()
        late, self._late = list(self._late), {}
        for name in late:
            slot = self.slots.get(name)
            if slot is not None and (slot.spec.durability == "each" or self._postbox.owes(self.id_of(slot))):
                self._checkpoint_some([name])

    def _tell_stopped(self, hand_off: HandOff) -> None:
        if hand_off.settled:
            for then in self._stopped.pop(hand_off.record.task_id, []):
                then("")

    # Checkpoints -----------------------------------------------------------------------------------------------

    def _checkpoint_all(self) -> None:
        names = list(self.slots)
        batches = [names[start : start + CHECKPOINTS_AT_ONCE] for start in range(0, len(names), CHECKPOINTS_AT_ONCE)]
        for number, batch in enumerate(batches):
            if number == 0:
                self._checkpoint_some(batch)
            else:
                self.after_host(number * CHECKPOINT_S / len(batches), partial(self._checkpoint_some, batch))
        self.after_host(CHECKPOINT_S, self._checkpoint_all)

    def carry_out_command(self, body: Any, slot: Slot | None, request: Request) -> None:
        if slot is not None and isinstance(body, (Stop, Reschedule, Configure, Describe)):
            if not isinstance(body, Describe) or body.state or body.began:
                self._refuse_if_moved(slot)
        super().carry_out_command(body, slot, request)

    def _refuse_if_moved(self, slot: Slot) -> None:
        record = self.hand_off(self.id_of(slot)).record
        if record.phase is Phase.RELEASED:
            raise ControlRefused(f"{slot.name} moved to {record.peer}")

    def _checkpoint_some(self, names: Sequence[str]) -> None:
        for name in names:
            slot = self.slots.get(name)
            if slot is None or slot.task is None or slot.life.state is not State.RUNNING:
                continue
            # Its duplicate filter cannot have changed either: whoever gives it a letter owes the sender an answer then.
            task_id = self.id_of(slot)
            if self._postbox.owes(task_id) or not self._checkpoints.surely_hold(task_id, slot.task):
                self.checkpoint(slot, slot.task)

    def arguments_of(self, slot: Slot) -> Mapping[str, Any]:
        arguments = super().arguments_of(slot)
        if slot.spec.durability != "each":
            return arguments
        return {**arguments, "tells_each_turn": True}

    def changed(self, slot: Slot, carried: Carried) -> None:
        # It outlives a failure of the task the moment after.
        if slot.task is not None:
            self._save(slot, slot.task, carried)

    def checkpoint(self, slot: Slot, task: Task) -> None:
        """Has a running task written down, if anything has changed."""
        tell(task, Look())

    def on_receive(self, message: Any) -> Any:
        match message:
            case Looked():
                slot = self.slots.get(message.task.name)
                if slot is not None and slot.task is message.task:
                    self._looked(slot, slot.task, message)
            case LetterGiven():
                self._postbox.given(message)
            case CameFor():
                self._postbox.arrived(message.letter, message.packet)
            case _:
                return super().on_receive(message)
        return None

    def _looked(self, slot: Slot, task: Task, looked: Looked) -> None:
        if looked.carried is None:
            self.log("error", f"the state of {slot.address} cannot be written down: {looked.reason}")
        else:
            self._save(slot, task, looked.carried)

    def _save(self, slot: Slot, task: Task, carried: Carried) -> None:
        if slot.task is not task or slot.life.state is not State.RUNNING:
            return
        task_id = self.id_of(slot)
        hand_off = self.hand_off(task_id)
        if not hand_off.idle:
            # The disk is slow, or a hand-off under way: the next time will do, and nothing piles up meanwhile.
            self._late[slot.name] = None
            return
        try:
            plain = plain_of(carried)
            if self._checkpoints.hold(task_id, plain) and not self._postbox.owes(task_id):
                return
            snapshot = self._snapshot(slot, carried)
        except (PancakesError, TypeError, OverflowError, MemoryError) as error:
            self.log("error", f"the state of {slot.address} cannot be written down: {error}")
            return
        self._checkpoints.take(task_id, task, carried, plain)
        consumed = self._postbox.consumed(task_id, carried.heard)
        hand_off.feed(Checkpoint(hand_off.record.epoch, hand_off.record.incarnation, snapshot, consumed))

    # What the core asks for ------------------------------------------------------------------------------------

    def carry_out(self, task_id: TaskId, effect: Effect, done: Callable[[], None]) -> None:
        """Begins to carry out one effect; `done` lets the next one follow."""
        slot = self.slots.get(task_id.name)
        match effect:
            case Persist():
                hand_off = self.hand_offs[task_id]
                self._writing += 1
                self._records.persist(
                    effect.record,
                    self.name,
                    lambda: self.call(lambda: self._written(hand_off, done)),
                    lambda reason: self.call(
                        lambda: self._written(hand_off, lambda: self._not_written(hand_off, reason))
                    ),
                )
                return
            case StartTask():
                self._start_task(task_id, effect, lambda: self._begun(task_id, done))
                return
            case After():
                event = effect.event
                self.after_host(effect.drawn_s(self.random), lambda: self.hand_off(task_id).feed(event))
            case Warn():
                self.log("warning", effect.text)
            case Ack():
                self._postbox.on_disk(task_id, effect.packet)
            case _:
                self.carry_out_move(task_id, slot, effect)
        done()

    def _begun(self, task_id: TaskId, done: Callable[[], None]) -> None:
        # It holds its actuators now; where it could not be started they are not kept for it for ever.
        self.kernel.registry.unreserve(self._place_of(task_id))
        done()
        self._tell_stopped(self.hand_offs[task_id])

    def carry_out_move(self, task_id: TaskId, slot: Slot | None, effect: Effect) -> None:
        """For subclasses: carries out an effect that has to do with another agent."""

    def task_arrived(self, task_id: TaskId) -> None:
        """For subclasses: a task has come from another agent, and is about to start."""

    def _start_task(self, task_id: TaskId, effect: StartTask, done: Callable[[], None]) -> None:
        snapshot = Snapshot.decode(effect.snapshot)
        slot = self.slots.get(task_id.name)
        if slot is None:
            try:
                slot = self.open_slot(spec_of(snapshot, self._catalogue))
            except PancakesError as error:
                self.log("error", f"{task_id} is ours, but cannot be started: {error}")
                done()
                return
        elif slot.task is not None:
            # It came back before the actor that was given away has ended.
            self._when_ended[slot.name] = lambda: self._start_task(task_id, effect, done)
            self.feed(slot, StopAsked(reason="it comes back"))
            return
        self._checkpoints.forget(task_id)
        slot.carried = replace(carried_of(snapshot), settings=self._settings_now(slot, snapshot))
        slot.fence = Fence(str(task_id), (effect.epoch.n, effect.epoch.minter))
        for seq in snapshot.sent.values():
            self.kernel.continue_seq(slot.address, seq + 1)
        courier = self._postbox.courier()
        if courier is not None:
            courier.arrive(task_id, snapshot.posted, effect.fresh)
        arrived = task_id in self._arriving
        if arrived:
            peer = self._arriving.pop(task_id)
            self.task_arrived(task_id)
            state = in_brief(snapshot.state)
            self.event("task_arrived", task=slot.name, source_agent=peer, epoch=effect.epoch.n, state=state)

        self._begins[task_id] = done
        if slot.life.state not in (State.ASKED, State.CALLED_OFF):
            self._leave[task_id] = Leave.GRANTED
            self.feed(slot, StartAsked())
        reason = CLOSES if self.closing else self.admit(slot)
        reason = reason or self.kernel.registry.hold(slot.address, slot.spec.cls.requires)
        self.feed(slot, LeaveRefused(reason) if reason else Admitted(effect.incarnation + 1))

    def _settings_now(self, slot: Slot, snapshot: Snapshot) -> Mapping[str, Any]:
        """Returns the settings that a task goes on with: its own, and what its configuration has changed since."""
        if slot.name not in self._residents or alike(snapshot.configured, slot.spec.settings):
            return snapshot.settings
        settings, names = settings_now(snapshot, slot.spec.settings)
        if names:
            self.log("info", f"{slot.address} takes what has changed in its configuration: {', '.join(names)}")
        return settings
