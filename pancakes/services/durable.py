"""Services whose tasks outlive a crash and move between agents.

Each task has a durable record, and a hand-off whose core (`pancakes.migration`) decides what may happen to it. This
actor is the one place where the events of a task come together, and where the core's effects are carried out, strictly
in order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import msgspec

from pancakes.control import Describe, Migrate
from pancakes.errors import ControlRefused, PancakesError
from pancakes.kernel.mailbox import LATEST
from pancakes.migration.candidate import would_take
from pancakes.migration.effect import (
    After,
    AttemptFailed,
    Decline,
    Discard,
    Effect,
    Freeze,
    HandedOver,
    Persist,
    Resume,
    Send,
    StartTask,
    Warn,
)
from pancakes.migration.event import Award, Born, Checkpoint, Ended, FreezeFailed, Frozen, Received
from pancakes.migration.event import Start as StartAgain
from pancakes.migration.handoff import HandOff
from pancakes.migration.messages import HandOffMessage, Solicit, Transfer
from pancakes.migration.record import NO_EPOCH, Phase, Record, TaskId, Wanted
from pancakes.migration.rule import ASK_AGAIN_S, MigrationRule
from pancakes.migration.snapshot import Snapshot, TimerPhase
from pancakes.packet import SYSTEM, Fence, Packet, agent_of, join
from pancakes.service import STUCK_S, Request, Service, Slot, TaskState
from pancakes.services.records import Records
from pancakes.settings import make_settings
from pancakes.supervision import RestartSpec
from pancakes.task import Carried, Task, TaskSpec

if TYPE_CHECKING:
    from pancakes.services.migrator import TaskMigrator

CHECKPOINT_S = 1.0
"""How often, in host time, a task whose state has changed is written down (`durability = "lazy"`)."""
CHECKPOINTS_AT_ONCE = 20
"""So many tasks are looked at in one go; a look at a thousand would make all of them 20 ms late, each second."""
SETTLE_S = 10.0
"""How long, in host time, a rule leaves a task alone that has just arrived: no ping-pong."""
MIGRATOR = "TaskMigrator"


class Catalogue(Protocol):
    """Where task classes are found by name."""

    def find(self, type_name: str) -> tuple[type[Task], str]:
        """Returns the class of an entry point, and the version of the distribution that it comes from.

        Raises:
            PancakesError: there is none, or it cannot be loaded.
        """
        ...


@dataclass
class Move:
    """A move that is under way.

    Attributes:
        request: what the neighbours are asked.
        then: a task to start here once the other has gone.
        answer: whom to answer; None where a rule asked.
        dry_run: whether nothing is to be moved.
    """

    request: Solicit
    then: str
    answer: Request | None
    dry_run: bool


class DurableService(Service):
    """A service whose tasks have durable records and can move.

    Args:
        records: where the records are kept.
        catalogue: where the classes of tasks that arrive are found.
    """

    durable: ClassVar[bool] = True

    def __init__(self, *args: Any, records: Records, catalogue: Catalogue, **others: Any) -> None:
        super().__init__(*args, **others)
        self._records = records
        self._catalogue = catalogue
        self.hand_offs: dict[TaskId, HandOff] = {}
        self._ids: dict[str, list[TaskId]] = {}  # of all hand-offs, by the task's name
        self._starting: dict[TaskId, list[Callable[[str], None]]] = {}
        self._moves: dict[TaskId, Move] = {}
        self._ask_again_s: dict[TaskId, float] = {}
        self._watched: list[str] = []
        self._saved: dict[TaskId, bytes] = {}
        self._asks = 0
        self._arriving: dict[TaskId, str] = {}
        self._leaving: set[str] = set()
        self._late: dict[str, None] = {}  # tasks whose checkpoint had to wait
        self._owed: dict[TaskId, None] = {}  # tasks that are ours and wanted, and whose start was refused
        self._residents: set[str] = set()
        self._when_written: Callable[[], None] | None = None

    # Records and slots -----------------------------------------------------------------------------------------

    def specs(self) -> Sequence[TaskSpec]:
        specs = super().specs()
        self._residents = {spec.name for spec in specs}
        for record in self._records.all().values():
            if self._is_ours(record):
                self._add_hand_off(record)
        for hand_off in list(self.hand_offs.values()):
            name = hand_off.record.task_id.name
            if name not in self._residents and hand_off.record.snapshot:
                try:
                    specs = (*specs, self._spec_of(Snapshot.decode(hand_off.record.snapshot)))
                except PancakesError as error:
                    self.log("error", f"{hand_off.record.task_id} rests in the journal and cannot be started: {error}")
        return specs

    def after_start(self) -> None:
        super().after_start()
        # A tombstone has no slot, and answers all the same.
        for hand_off in self.hand_offs.values():
            if self._slot_of(hand_off.record.task_id) is None:
                hand_off.recover()
        self._tell_migrator(lambda migrator: migrator.service_began(self))
        self.after_host(CHECKPOINT_S, self._checkpoint_all)

    def _is_ours(self, record: Record) -> bool:
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

    def _slot_of(self, task_id: TaskId) -> Slot | None:
        slot = self.slots.get(task_id.name)
        return slot if slot is not None and self.id_of(slot) == task_id else None

    def _spec_of(self, snapshot: Snapshot) -> TaskSpec:
        cls, version = self._catalogue.find(snapshot.type)
        rule = msgspec.convert(snapshot.migrate, MigrationRule) if snapshot.migrate is not None else None
        return TaskSpec(
            name=snapshot.task_id.name,
            cls=cls,
            type=snapshot.type,
            version=version,
            settings=snapshot.configured,
            start=False,
            restart=msgspec.convert(snapshot.restart, RestartSpec) if snapshot.restart else RestartSpec(),
            durability=snapshot.durability,
            rule=rule,
        )

    def _snapshot(self, slot: Slot, carried: Carried | None) -> bytes:
        spec = slot.spec
        carried = carried or Carried(spec.settings, {})
        now_s = self.now()
        return Snapshot(
            task_id=self.id_of(slot),
            type=spec.type,
            version=spec.version,
            service=self.name,
            requires=spec.cls.requires,
            settings=dict(carried.settings),
            configured=dict(spec.settings),
            state=dict(carried.state),
            timers=tuple(
                TimerPhase(name, period_s, period_s - now_s % period_s) for name, period_s in carried.periods_s.items()
            ),
            sent={slot.address: self.kernel.seq_of(slot.address).value - 1},
            restart=asdict(spec.restart),
            durability=spec.durability,
            migrate=asdict(spec.rule) if spec.rule is not None else None,
        ).encode()

    # Starting and ending ---------------------------------------------------------------------------------------

    def wants(self, slot: Slot) -> bool:
        hand_off = self.hand_offs.get(self.id_of(slot))
        if hand_off is None:
            return slot.spec.start
        # The journal wins over `start` in the configuration: a stop that somebody asked for outlives a reboot.
        record = hand_off.record
        return record.phase is not Phase.OWNER or record.wanted is Wanted.RUNNING

    def start_configured(self, slot: Slot) -> None:
        hand_off = self.hand_offs.get(self.id_of(slot))
        if hand_off is None:
            self.begin(slot, lambda reason: self._report(slot, reason))
            return
        runs = hand_off.record.phase in (Phase.OWNER, Phase.FROZEN)
        if runs:
            slot.state = TaskState.STARTING
        hand_off.recover()
        if not runs:
            self.settle(slot)

    def _report(self, slot: Slot, reason: str) -> None:
        if slot.state is TaskState.RESTARTING:
            return  # it failed, and is tried again
        if reason:
            self.log("error", f"{slot.address} was not started: {reason}")
        self.settle(slot)

    def begin(self, slot: Slot, then: Callable[[str], None]) -> None:
        """Starts a task as its record allows; `then` is told an empty string, or the reason why not."""
        reason = self.admit(slot) or self._held_by_another(slot)
        if reason:
            then(reason)
            return
        hand_off = self.hand_off(self.id_of(slot))
        lost = self._records.lost(hand_off.record.task_id)
        if lost and hand_off.record.phase is Phase.ABSENT:
            then(f"it may run elsewhere, and what this agent knew of it is lost: {lost}")
            return
        self._starting.setdefault(hand_off.record.task_id, []).append(then)
        record = hand_off.record
        slot.state = TaskState.STARTING
        if record.phase is Phase.ABSENT and record.seen == NO_EPOCH:
            hand_off.feed(Born(self._snapshot(slot, slot.carried)))
        else:
            if slot.carried is not None and record.phase is Phase.OWNER:
                hand_off.feed(Ended(Wanted.STOPPED, self._snapshot(slot, slot.carried)))
            hand_off.feed(StartAgain())

    def _held_by_another(self, slot: Slot) -> str:
        registry = self.kernel.registry
        for device in registry.devices():
            holder = registry.holder(device.name)
            if device.actuator and device.type in slot.spec.cls.requires and holder not in ("", slot.address):
                return f"{device.name} is held by {holder}"
        return ""

    def relaunch(self, slot: Slot) -> None:
        slot.state = TaskState.STARTING
        self.hand_off(self.id_of(slot)).feed(StartAgain(again=True))

    def carried_of(self, slot: Slot) -> Carried:
        record = self.hand_off(self.id_of(slot)).record
        if slot.carried is not None or not record.snapshot:
            return super().carried_of(slot)
        snapshot = Snapshot.decode(record.snapshot)
        return Carried(snapshot.settings, snapshot.state, {timer.name: timer.period_s for timer in snapshot.timers})

    def drop_state(self, slot: Slot) -> None:
        slot.carried = Carried(slot.spec.settings, {})

    def start_anew(self, slot: Slot, then: Callable[[str], None]) -> None:
        self.begin(slot, then)

    def task_ended(self, slot: Slot) -> None:
        if slot.name in self._leaving:
            self._leaving.discard(slot.name)
            self._forget(slot)
            return
        hand_off = self.hand_offs.get(self.id_of(slot))
        if hand_off is None or hand_off.record.phase is not Phase.OWNER:
            return
        snapshot = self._snapshot(slot, slot.carried) if slot.carried is not None else b""
        if self.closing:
            # Nobody asked for an end of the task itself: it goes on when its service comes back.
            if snapshot:
                hand_off.feed(Checkpoint(hand_off.record.epoch, hand_off.record.incarnation, snapshot))
            return
        wanted = Wanted.FAILED if slot.state is TaskState.FAILED else Wanted.STOPPED
        hand_off.feed(Ended(wanted, snapshot))

    def _forget(self, slot: Slot) -> None:
        """A task was given away: what is left of it here is the tombstone in the journal."""
        self._let_go(slot)
        slot.state = TaskState.STOPPED
        slot.carried = None
        slot.mailbox.clear_data()
        if slot.name not in self._residents:
            del self.slots[slot.name]

    def settle_all(self, then: Callable[[], None]) -> None:
        # The last checkpoint of each task may wait for the one before it to be written.
        self._when_written = then
        self._look_written()

    def _look_written(self) -> None:
        then = self._when_written
        if then is not None and not any(hand_off.writing for hand_off in self.hand_offs.values()):
            self._when_written = None
            then()

    def _not_written(self, hand_off: HandOff, reason: str) -> None:
        self._saved.pop(hand_off.record.task_id, None)
        hand_off.failed(reason)

    def _written(self, done: Callable[[], None]) -> None:
        done()
        self._look_written()
        late, self._late = list(self._late), {}
        for name in late:
            slot = self.slots.get(name)
            if slot is not None and slot.spec.durability == "each":
                self._checkpoint_some([name])

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
        self._start_owed()

    def _start_owed(self) -> None:
        """Starts what was refused before, such as a task that came while another still held its actuators."""
        for task_id in list(self._owed):
            slot = self._slot_of(task_id)
            if slot is None or slot.state is not TaskState.STOPPED:
                del self._owed[task_id]
            elif not slot.busy and not (self.admit(slot) or self._held_by_another(slot)):
                self.begin(slot, lambda reason, slot=slot: self._report(slot, reason))  # type: ignore[misc]

    def stop_asked(self, slot: Slot, request: Request) -> None:
        task_id = self.id_of(slot)
        record = self.hand_off(task_id).record
        if record.phase is Phase.RELEASED:
            raise ControlRefused(f"{slot.name} moved to {record.peer}")
        if task_id not in self._owed or slot.state is not TaskState.STOPPED:
            super().stop_asked(slot, request)
            return
        del self._owed[task_id]
        self.tell_asked("stop", slot, request)
        self.hand_off(task_id).feed(Ended(Wanted.STOPPED))
        self.reply(request)

    def _checkpoint_some(self, names: Sequence[str]) -> None:
        for name in names:
            slot = self.slots.get(name)
            if slot is not None and slot.task is not None and slot.state is TaskState.RUNNING:
                self.checkpoint(slot, slot.task)

    def arguments_of(self, slot: Slot) -> Mapping[str, Any]:
        arguments = super().arguments_of(slot)
        if slot.spec.durability != "each":
            return arguments
        return {**arguments, "handled": lambda task: self._handled(slot, task)}

    def _handled(self, slot: Slot, task: Task) -> None:
        """A task with `durability = "each"` has handled something (in its own turn)."""
        if task.actor_stopped.is_set() or task.actor_inbox.paused:
            return
        try:
            carried = task.carry()
        except Exception as error:  # what a task keeps in its state may be anything
            self.log("error", f"the state of {slot.address} cannot be written down: {error}")
            return
        self.call(lambda: self._save(slot, task, carried))

    def checkpoint(self, slot: Slot, task: Task) -> None:
        """Has a running task written down, if anything has changed."""

        def look() -> None:
            if task.actor_inbox.paused:
                return
            try:
                carried = task.carry()
            except Exception as error:  # what a task keeps in its state may be anything
                self.log("error", f"the state of {slot.address} cannot be written down: {error}")
                return
            self.call(lambda: self._save(slot, task, carried))

        task.call(look)

    def _save(self, slot: Slot, task: Task, carried: Carried) -> None:
        if slot.task is not task or slot.state is not TaskState.RUNNING:
            return
        task_id = self.id_of(slot)
        hand_off = self.hand_off(task_id)
        if not hand_off.idle:
            # The disk is slow, or a hand-off under way: the next time will do, and nothing piles up meanwhile.
            self._late[slot.name] = None
            return
        try:
            plain = msgspec.msgpack.encode([carried.settings, carried.state, carried.periods_s])
            if self._saved.get(task_id) == plain:
                return
            snapshot = self._snapshot(slot, carried)
        except (PancakesError, TypeError, OverflowError) as error:
            self.log("error", f"the state of {slot.address} cannot be written down: {error}")
            return
        self._saved[task_id] = plain
        hand_off.feed(Checkpoint(hand_off.record.epoch, hand_off.record.incarnation, snapshot))

    # What the core asks for ------------------------------------------------------------------------------------

    def carry_out(self, task_id: TaskId, effect: Effect, done: Callable[[], None]) -> None:
        """Begins to carry out one effect; `done` lets the next one follow."""
        slot = self.slots.get(task_id.name)
        match effect:
            case Persist():
                hand_off = self.hand_offs[task_id]
                self._records.persist(
                    effect.record,
                    lambda: self.call(lambda: self._written(done)),
                    lambda reason: self.call(lambda: self._written(lambda: self._not_written(hand_off, reason))),
                )
                return
            case StartTask():
                self._start_task(task_id, effect, done)
                return
            case Send():
                self._send(effect.peer, effect.message)
            case Freeze():
                self._freeze(slot, effect)
            case Resume():
                self._resume(slot)
            case Discard():
                self._discard(task_id, slot)
            case After():
                event = effect.event
                self.after_host(effect.drawn_s(self.random), lambda: self.hand_off(task_id).feed(event))
            case Warn():
                self.log("warning", effect.text)
            case Decline():
                self._declined(task_id, effect.reason)
            case AttemptFailed():
                self._tell_migrator(lambda migrator: migrator.attempt_failed(task_id, effect.peer, effect.reason))
            case HandedOver():
                self._handed_over(task_id, effect)
        done()

    def _start_task(self, task_id: TaskId, effect: StartTask, done: Callable[[], None]) -> None:
        snapshot = Snapshot.decode(effect.snapshot)
        slot = self.slots.get(task_id.name)
        if slot is None:
            try:
                slot = self.open_slot(self._spec_of(snapshot))
            except PancakesError as error:
                self.log("error", f"{task_id} is ours, but cannot be started: {error}")
                done()
                return
        elif slot.task is not None:
            # It came back before the actor that was given away has ended.
            self.halt(slot, lambda: self._start_task(task_id, effect, done), "it comes back")
            return
        self._saved.pop(task_id, None)
        self._owed.pop(task_id, None)
        slot.carried = Carried(
            self._settings_now(slot, snapshot),
            snapshot.state,
            {timer.name: timer.period_s for timer in snapshot.timers},
        )
        slot.fence = Fence(str(task_id), (effect.epoch.n, effect.epoch.minter))
        slot.incarnation = effect.incarnation
        for seq in snapshot.sent.values():
            self.kernel.continue_seq(slot.address, seq + 1)
        arrived = task_id in self._arriving
        if arrived:
            peer = self._arriving.pop(task_id)
            self._ask_again_s[task_id] = self.kernel.host.now() + SETTLE_S
            self.event(
                "task_arrived", task=slot.name, source_agent=peer, epoch=effect.epoch.n, state=dict(snapshot.state)
            )

        def launched(reason: str) -> None:
            waiting = self._starting.pop(task_id, [])
            if reason and not waiting:
                self.log("error", f"{task_id} is ours, but was not started: {reason}")
            for then in waiting:
                then(reason)
            if reason and slot.state is TaskState.STOPPED:
                # It was refused, so it does not run, but it is still wanted: a start that is asked for may follow.
                self.hand_off(task_id).feed(Ended(Wanted.RUNNING))
                self._owed[task_id] = None
            done()

        if slot.state is TaskState.STOPPING:
            # Its service was told to stop while the record of its start was being written.
            slot.carried = None
            slot.on_running.append(launched)
            self._rest(slot, slot.reason)
            return
        self.launch(slot, launched)
        # From here on the record is what counts, and this grows old.
        slot.carried = None

    def _settings_now(self, slot: Slot, snapshot: Snapshot) -> dict[str, Any]:
        """Returns the settings that a task goes on with: its own, but what was changed in its configuration since wins."""
        settings, before, now = dict(snapshot.settings), snapshot.configured, slot.spec.settings
        if slot.name not in self._residents or before == now:
            return settings
        changed = [key for key in now if key not in before or before[key] != now[key]]
        settings.update((key, now[key]) for key in changed)
        removed = [key for key in before if key not in now]
        for key in removed:
            settings.pop(key, None)
        if changed or removed:
            names = ", ".join([*changed, *removed])
            self.log("info", f"{slot.address} takes what has changed in its configuration: {names}")
        return settings

    def _freeze(self, slot: Slot | None, effect: Freeze) -> None:
        task = slot.task if slot is not None else None
        if slot is None or task is None or slot.state is not TaskState.RUNNING:
            self._frozen_or_not(slot, effect, None, "it does not run")
            return

        answered: list[bool] = []

        def stand_still() -> None:
            if answered:
                return
            answered.append(True)
            task.pause()
            try:
                carried, reason = task.carry(), ""
            except Exception as error:  # what a task keeps in its state may be anything
                carried, reason = None, str(error)
                task.resume()
            self.call(lambda: self._frozen_or_not(slot, effect, carried, reason))

        task.call(stand_still)
        self.after_host(STUCK_S, lambda: self._give_up_freezing(slot, effect, answered))

    def _give_up_freezing(self, slot: Slot, effect: Freeze, answered: list[bool]) -> None:
        """A task that does not come back from what it is doing cannot be moved."""
        if not answered:
            answered.append(False)
            self._frozen_or_not(slot, effect, None, "it is stuck")

    def _frozen_or_not(self, slot: Slot | None, effect: Freeze, carried: Carried | None, reason: str) -> None:
        if slot is None:
            return
        hand_off = self.hand_off(self.id_of(slot))
        if carried is None or slot.task is None:
            hand_off.feed(FreezeFailed(effect.offer, reason or "it ended meanwhile"))
            return
        if not hand_off.volatile.freezing:
            # The hand-off was broken off while the task was busy: it goes on.
            late = slot.task
            late.call(late.resume)
            return
        self.hold_actuators(slot, "its task is handed over")
        try:
            snapshot = self._snapshot(slot, carried)
        except PancakesError as error:
            task = slot.task
            task.call(task.resume)
            hand_off.feed(FreezeFailed(effect.offer, str(error)))
            return
        self.event("task_frozen", task=slot.name, offer=effect.offer.n)
        hand_off.feed(Frozen(effect.offer, snapshot))

    def _resume(self, slot: Slot | None) -> None:
        if slot is None:
            return
        task = slot.task
        if task is not None:
            self.event("task_resumed", task=slot.name)
            task.call(task.resume)
        else:
            # Its actor failed while it stood still: it begins again from what was written down.
            self.relaunch(slot)

    def _discard(self, task_id: TaskId, slot: Slot | None) -> None:
        self._arriving.pop(task_id, None)
        if slot is None:
            return
        if slot.task is None and slot.state is not TaskState.STARTING:
            # It failed while it stood still, or this agent was started anew since.
            self._forget(slot)
        elif self.id_of(slot) == task_id:
            peer = self.hand_off(task_id).record.peer
            self._leaving.add(slot.name)
            # At once: what its `on_stop` may still command must not reach a wheel that the new owner's host may need.
            self.hold_actuators(slot, "its task was handed over")
            self.kernel.registry.release(slot.address)
            self.halt(slot, None, f"handed over to {peer}")

    def _declined(self, task_id: TaskId, reason: str) -> None:
        slot = self.slots.get(task_id.name)
        if slot is not None and slot.task is None and slot.state in (TaskState.STARTING, TaskState.STOPPING):
            slot.state = TaskState.STOPPED
            self._let_go(slot)
            ended, slot.on_ended = slot.on_ended, []
            for then_ended in ended:
                then_ended()
        for then in self._starting.pop(task_id, []):
            then(reason)
        # A task that failed while it stood still could not be started again; its hand-off goes on all the same.
        going_on = self.hand_off(task_id).record.phase in (Phase.FROZEN, Phase.COMMITTED)
        if task_id in self._moves and not going_on:
            self._tell_migrator(lambda migrator: migrator.abandon(task_id, reason))

    def _send(self, peer: str, message: HandOffMessage) -> None:
        self._tell_migrator(lambda migrator: migrator.send(peer, message))

    def _handed_over(self, task_id: TaskId, effect: HandedOver) -> None:
        slot = self.slots.get(task_id.name)
        move = self._moves.get(task_id)
        then = move.then if move is not None else (slot.spec.rule.then if slot is not None and slot.spec.rule else "")
        if slot is not None and slot.task is None and slot.name not in self._residents:
            self._forget(slot)
        self.event("task_handed_over", task=task_id.name, to=effect.peer, epoch=effect.epoch.n)
        self._tell_migrator(lambda migrator: migrator.moved(task_id, effect.peer))
        if then:
            self._start_then(then)

    def _start_then(self, name: str) -> None:
        slot = self.slots.get(name)
        if slot is None or slot.state is not TaskState.STOPPED:
            self.log("error", f"{name} cannot follow: {self.address} has no such task at rest")
            return
        self.begin(slot, lambda reason: self._report(slot, reason))

    def _tell_migrator(self, tell: Callable[[TaskMigrator], None]) -> None:
        migrator = self._migrator()
        if migrator is not None:
            migrator.call(lambda: tell(migrator))

    def _migrator(self) -> TaskMigrator | None:
        component = self.kernel.registry.get(join(self.agent, "network", MIGRATOR))
        return component if component is not None and hasattr(component, "negotiate") else None  # type: ignore[return-value]

    # What the migrator says ------------------------------------------------------------------------------------

    def knows(self, task_id: TaskId) -> bool:
        """Returns whether this service has a record of the task. Any thread."""
        hand_off = self.hand_offs.get(task_id)
        return hand_off is not None and (hand_off.record.phase is not Phase.ABSENT or hand_off.record.seen != NO_EPOCH)

    def receive(self, peer: str, message: HandOffMessage, refusal: str) -> None:
        """Takes a hand-off message from a peer. In this actor."""
        task_id = message.task_id
        news = isinstance(message, Transfer) and would_take(self.hand_off(task_id).record, message.offer)
        if isinstance(message, Transfer) and news and not refusal:
            refusal = self._cannot_build(message)
            if not refusal:
                self._arriving[task_id] = peer
        self.hand_off(task_id).feed(Received(peer, message, refusal))

    def _cannot_build(self, message: Transfer) -> str:
        """Builds what arrives, dormant, to find out whether it can be built at all; says why not."""
        try:
            snapshot = Snapshot.decode(message.snapshot)
            if snapshot.task_id != message.task_id:
                return f"the snapshot is of {snapshot.task_id}, not of {message.task_id}"
            spec = self._spec_of(snapshot)
            make_settings(spec.cls.Settings, snapshot.settings)
            make_settings(spec.cls.State, snapshot.state, allow_nan=True)
        except (PancakesError, msgspec.ValidationError) as error:
            return str(error)
        slot = self.slots.get(message.task_id.name)
        if slot is not None and self.id_of(slot) != message.task_id and slot.name not in self._leaving:
            return f"has a task named {slot.name} already"
        return ""

    def award(self, task_id: TaskId, peer: str, request: Solicit) -> None:
        """The bids are compared: hands the task to `peer`. In this actor."""
        self.hand_off(task_id).feed(Award(peer, request))

    def move_ended(self, task_id: TaskId, reason: str, result: Any) -> None:
        """The move is over, one way or the other. In this actor."""
        move = self._moves.pop(task_id, None)
        if move is None:
            return
        if move.answer is not None:
            self.reply(move.answer, reason, result)
        if reason and not move.dry_run:
            self._ask_again_s[task_id] = self.kernel.host.now() + ASK_AGAIN_S
            self.log("warning", f"{task_id} stays on {self.agent}: {reason}")

    def migrator_began(self) -> None:
        """The migrator has started anew and knows of no negotiation: those that wait are told. In this actor."""
        for task_id in list(self._moves):
            self.move_ended(task_id, "the Task Migrator was started anew", None)

    # Asking for a move -----------------------------------------------------------------------------------------

    def carry_out_command(self, body: Any, slot: Slot | None, request: Request) -> None:
        if slot is not None and not isinstance(body, Describe):
            hand_off = self.hand_off(self.id_of(slot))
            record, volatile = hand_off.record, hand_off.volatile
            if volatile.freezing or record.phase in (Phase.FROZEN, Phase.COMMITTED, Phase.PREPARED):
                peer = volatile.asked or record.peer
                raise ControlRefused(f"{slot.address} is being handed over between {self.agent} and {peer}")
        if isinstance(body, Migrate) and slot is not None:
            self._migrate(slot, body, request)
        else:
            super().carry_out_command(body, slot, request)

    def _migrate(self, slot: Slot, body: Migrate, answer: Request | None) -> None:
        task_id = self.id_of(slot)
        if slot.task is None or slot.state is not TaskState.RUNNING:
            raise ControlRefused(f"{slot.address} is {slot.state.value}, so it cannot move")
        if not slot.spec.type:
            raise ControlRefused(f"{slot.address} has no entry point under which another agent could find its class")
        if task_id in self._moves:
            raise ControlRefused(f"{slot.address} is being moved already")
        if body.then and body.then not in self.slots:
            raise ControlRefused(f"{self.address} has no task {body.then!r} that could follow {slot.name}")
        migrator = self._migrator()
        if migrator is None:
            raise ControlRefused(f"{slot.address} cannot move: the Network Service of {self.agent} is stopped")
        self._asks += 1
        rule = slot.spec.rule
        request = Solicit(
            task_id,
            self._asks,
            slot.spec.type,
            slot.spec.version,
            slot.spec.cls.requires,
            len(self.hand_off(task_id).record.snapshot),
            body.cost,
            rule.below if rule is not None and rule.when == "battery" else None,
        )
        self._moves[task_id] = Move(request, body.then, answer, body.dry_run)
        asked_by = answer.by if answer is not None else "rule"
        self.event("migration_asked", task=slot.name, by=asked_by, cost=body.cost)
        migrator.call(lambda: migrator.negotiate(self, request, asked_by, body.to, body.dry_run))

    def task_running(self, slot: Slot) -> None:
        rule = slot.spec.rule
        if rule is not None and rule.when not in self._watched:
            self._watched.append(rule.when)
            self.subscribe(SYSTEM, rule.when, self._on_reading, keep=LATEST)

    def _on_reading(self, packet: Packet) -> None:
        """A reading that rules watch has come."""
        if agent_of(packet.source) != self.agent:
            return
        for slot in list(self.slots.values()):
            rule = slot.spec.rule
            if rule is None or rule.when != packet.type or slot.state is not TaskState.RUNNING:
                continue
            task_id = self.id_of(slot)
            due = self.kernel.host.now() >= self._ask_again_s.get(task_id, 0.0)
            if due and task_id not in self._moves and rule.met_by(packet.body):
                # What is to follow may exist only on the agent where the rule was written.
                then = rule.then if rule.then in self.slots else ""
                try:
                    self._migrate(slot, Migrate(slot.name, then=then, cost=rule.cost), None)
                except ControlRefused as error:
                    self._ask_again_s[task_id] = self.kernel.host.now() + ASK_AGAIN_S
                    self.log("warning", f"the rule of {slot.address} could not move it: {error}")

    def refuse_stop(self) -> str:
        for task_id, hand_off in list(self.hand_offs.items()):
            if hand_off.record.phase in (Phase.FROZEN, Phase.COMMITTED, Phase.PREPARED):
                return f"{self.address} must not stop while {task_id} is being handed over"
        return ""
