"""Services whose tasks outlive a crash and move between agents.

Each task has a durable record, and a hand-off whose core (`pancakes.migration`) decides what may happen to it. This
actor is the one place where the events of a task come together, and where the core's effects are carried out, strictly
in order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from pancakes.closing import STUCK_S
from pancakes.control import Adopt, Describe, Forget, Migrate
from pancakes.errors import ControlRefused, MigrationError, PancakesError
from pancakes.kernel.keep import LATEST
from pancakes.kernel.tell import tell
from pancakes.life.life import RESTS, State
from pancakes.life.life_event import LeaveRefused, StartAsked, StopAsked
from pancakes.migration.candidate import would_take
from pancakes.migration.cost import cost_text, fault_of_choice
from pancakes.migration.effect import (
    AttemptFailed,
    Decline,
    Discard,
    Effect,
    Freeze,
    HandedOver,
    Resume,
    Send,
)
from pancakes.migration.event import Award, Concluded, FreezeFailed, Frozen, Received
from pancakes.migration.handoff import HandOff
from pancakes.migration.ledger import Ledger
from pancakes.migration.messages import HandOffMessage, Solicit, Transfer
from pancakes.migration.record import NO_EPOCH, Epoch, Phase, Record, TaskId
from pancakes.migration.rule import ASK_AGAIN_S
from pancakes.migration.sequel import Sequel
from pancakes.migration.snapshot import Snapshot
from pancakes.packet import SYSTEM, Packet, agent_of, join
from pancakes.request import Request
from pancakes.services.adoption import DOUBT
from pancakes.services.bidding_messages import (
    Accounted,
    AttemptOver,
    BidAwarded,
    BrokenOff,
    Came,
    HasMoved,
    MigratorBegan,
    MoveOver,
    Negotiate,
    SendTo,
    ServiceBegan,
)
from pancakes.services.decisions import Decisions
from pancakes.services.migrator import TaskMigrator
from pancakes.services.recorded import Leave, RecordedService
from pancakes.services.snapshots import spec_of
from pancakes.settings import make_settings
from pancakes.slot import Slot
from pancakes.task import TaskSpec
from pancakes.task_messages import GoOn, StandStill, Stood

SETTLE_S = 10.0
"""How long, in host time, a rule leaves a task alone that has just arrived: no ping-pong."""
MIGRATOR = "TaskMigrator"


class Move(msgspec.Struct):
    """A move that is under way.

    Attributes:
        request: what the neighbours are asked.
        then: a task to start here once the other has gone.
        answer: whom to answer; None where a rule asked.
        dry_run: whether nothing is to be moved.
        ledger: the account as it stands while a hand-off is under way; None before the first, and between two.
    """

    request: Solicit
    then: str
    answer: Request | None
    dry_run: bool
    ledger: Ledger | None = None


class DurableService(RecordedService):
    """A service whose tasks have durable records and can move to other agents.

    Args:
        records: where the records are kept.
        catalogue: where the classes of tasks that arrive are found.
    """

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        self._moves: dict[TaskId, Move] = {}
        self._broken_off: list[tuple[Record, Ledger]] = []  # by the end of this service's predecessor
        self._ask_again_s: dict[TaskId, float] = {}
        self._watched: list[str] = []
        self._freezes: dict[TaskId, Epoch] = {}  # the hand-offs for which tasks are to stand still
        self._concluding: dict[TaskId, int] = {}  # how much of what follows a hand-over is still to be done
        self._asks = 0
        self._decisions = Decisions(self)

    def after_start(self) -> None:
        super().after_start()
        for record, ledger in self._broken_off:
            self._account_for_broken_off(record, ledger)
        self.tell_migrator(ServiceBegan(self))

    def _account_for_broken_off(self, record: Record, ledger: Ledger) -> None:
        reason = f"{self.address} was started anew before {ledger.winner} had the task"
        ledger = ledger.stayed(str(record.offer), reason)
        self.tell_migrator(BrokenOff(self, record.task_id, ledger, reason))

    def specs(self) -> Sequence[TaskSpec]:
        specs = super().specs()
        # A task that is in doubt may be started any moment: nobody here may take its actuators before.
        for hand_off in self.hand_offs.values():
            record = hand_off.record
            ledger = self.sequel_of(record).ledger
            if record.phase is Phase.FROZEN and ledger is not None:
                self._broken_off.append((record, ledger))
            if record.phase is Phase.PREPARED:
                requires = Snapshot.decode(record.snapshot).requires
                reason = self.kernel.registry.reserve(self._place_of(record.task_id), requires)
                if reason:
                    self.log("warning", f"no actuators are kept for {record.task_id}: {reason}")
        return specs

    def task_arrived(self, task_id: TaskId) -> None:
        self._ask_again_s[task_id] = self.kernel.host.now() + SETTLE_S

    def carry_out_move(self, task_id: TaskId, slot: Slot | None, effect: Effect) -> None:
        match effect:
            case Send():
                self._send(effect.peer, effect.message)
            case Freeze():
                self._freeze(task_id, slot, effect)
            case Resume():
                self._resume(task_id, slot)
            case Discard():
                self._discard(task_id, slot)
            case Decline():
                self._declined(task_id, effect.reason)
            case AttemptFailed():
                ledger = self._attempt_over(task_id)
                self.tell_migrator(AttemptOver(self, task_id, effect.peer, effect.reason, ledger))
            case HandedOver():
                self._handed_over(task_id, effect)

    def _freeze(self, task_id: TaskId, slot: Slot | None, effect: Freeze) -> None:
        task = slot.task if slot is not None else None
        if slot is None or task is None or slot.life.state is not State.RUNNING:
            self.hand_off(task_id).feed(FreezeFailed(effect.offer, "it does not run"))
            return
        self._freezes[task_id] = effect.offer
        tell(task, StandStill(effect.offer))
        self.after_host(STUCK_S, lambda: self._give_up_freezing(task_id, effect.offer))

    def _give_up_freezing(self, task_id: TaskId, offer: Epoch) -> None:
        """A task that does not come back from what it is doing cannot be moved."""
        if self._freezes.get(task_id) == offer:
            del self._freezes[task_id]
            self.hand_off(task_id).feed(FreezeFailed(offer, "it is stuck"))

    def _stood(self, slot: Slot, stood: Stood) -> None:
        """A task stands still, or cannot be moved."""
        task_id = self.id_of(slot)
        hand_off = self.hand_off(task_id)
        waits = self._freezes.get(task_id) == stood.offer
        if waits:
            del self._freezes[task_id]
        if stood.carried is None:
            if waits:
                hand_off.feed(FreezeFailed(stood.offer, stood.reason))
            return
        if not waits or not hand_off.volatile.freezing:
            # The hand-off was broken off while the task was busy: it goes on.
            tell(stood.task, GoOn())
            return
        self.hold_actuators(slot, "its task is handed over")
        courier = self._postbox.courier()
        try:
            snapshot = self._snapshot(slot, stood.carried, courier.leave(task_id) if courier is not None else None)
        except PancakesError as error:
            self._stays(task_id)
            tell(stood.task, GoOn())
            hand_off.feed(FreezeFailed(stood.offer, str(error)))
            return
        self.event("task_frozen", task=slot.name, offer=stood.offer.n)
        move = self._moves.get(task_id)
        sequel = Sequel(move.then, move.ledger).encode() if move is not None else b""
        hand_off.feed(Frozen(stood.offer, snapshot, sequel))

    def _stays(self, task_id: TaskId) -> None:
        courier = self._postbox.courier()
        if courier is not None:
            courier.stay(task_id)

    def _resume(self, task_id: TaskId, slot: Slot | None) -> None:
        self._stays(task_id)
        if slot is None:
            return
        task = slot.task
        if task is not None:
            self.event("task_resumed", task=slot.name)
            tell(task, GoOn())
        else:
            # Its actor failed while it stood still: it begins again from what was written down.
            self._leave[task_id] = Leave.AGAIN
            self.feed(slot, StartAsked())

    def _discard(self, task_id: TaskId, slot: Slot | None) -> None:
        self._arriving.pop(task_id, None)
        self.kernel.registry.unreserve(self._place_of(task_id))
        self._postbox.forget(task_id)
        # What it was, down to the last byte of its state, is elsewhere now.
        self._checkpoints.forget(task_id)
        self._ask_again_s.pop(task_id, None)
        ends = slot is not None and slot.task is not None and self.id_of(slot) == task_id
        courier = self._postbox.courier()
        if courier is not None:
            courier.gone(task_id, ends)
        if slot is None:
            return
        if slot.task is None and slot.life.state is not State.ASKED:
            # It failed while it stood still, or this agent was started anew since.
            self._forget(slot)
        elif self.id_of(slot) == task_id:
            peer = self.hand_off(task_id).record.peer
            self._leaving.add(slot.name)
            # At once: what its `on_stop` may still command must not reach a wheel that the new owner's host may need.
            self.hold_actuators(slot, "its task was handed over")
            self.kernel.registry.release(slot.address)
            self.feed(slot, StopAsked(reason=f"handed over to {peer}"))

    def _declined(self, task_id: TaskId, reason: str) -> None:
        slot = self.slots.get(task_id.name)
        if slot is not None and slot.life.state in (State.ASKED, State.CALLED_OFF):
            self.feed(slot, LeaveRefused(reason, for_good=True))
        for then in self._starting.pop(task_id, []):
            then(reason)
        if self.hand_off(task_id).record.phase is not Phase.PREPARED:
            self.kernel.registry.unreserve(self._place_of(task_id))
        # A task that failed while it stood still could not be started again; its hand-off goes on all the same.
        going_on = self.hand_off(task_id).record.phase in (Phase.FROZEN, Phase.COMMITTED)
        if task_id in self._moves and not going_on:
            ledger = self._attempt_over(task_id)
            self.tell_migrator(AttemptOver(self, task_id, "", reason, ledger))

    def _send(self, peer: str, message: HandOffMessage) -> None:
        self.tell_migrator(SendTo(peer, message))

    def _handed_over(self, task_id: TaskId, effect: HandedOver) -> None:
        slot = self.slots.get(task_id.name)
        if slot is not None and slot.task is None and slot.name not in self._residents:
            self._forget(slot)
        self.event("task_handed_over", task=task_id.name, to=effect.peer, epoch=effect.epoch.n)
        sequel = self.sequel_of(self.hand_off(task_id).record)
        # In a turn of its own: after a restart of the agent this comes while the other tasks are being started.
        self.call(lambda: self._conclude(task_id, effect, sequel))

    def sequel_of(self, record: Record) -> Sequel:
        try:
            return Sequel.decode(record.sequel)
        except MigrationError as error:
            self.log("error", f"what was to follow the hand-over of {record.task_id} is not done: {error}")
            return Sequel()

    def _conclude(self, task_id: TaskId, effect: HandedOver, sequel: Sequel) -> None:
        """Does what is to follow a hand-over; only when all of it is done, or on disk, does the record forget it."""
        self._concluding[task_id] = 2
        anew = f"the Task Migrator of {self.agent}" if task_id in self._moves else self.address
        peer = effect.peer
        note = f"{anew} was started anew while the task was on its way, so the duration ends with the choice of {peer}"
        if self.migrator() is None:
            self.log("warning", f"the move of {task_id} to {peer} leaves no account: the Network Service is stopped")
            self._one_done(task_id)
        else:
            self.tell_migrator(HasMoved(self, task_id, peer, str(effect.epoch), sequel.ledger, note))
        self._follow(sequel.then, lambda: self._one_done(task_id))

    def _one_done(self, task_id: TaskId) -> None:
        self._concluding[task_id] -= 1
        if not self._concluding[task_id]:
            del self._concluding[task_id]
            self.hand_off(task_id).feed(Concluded())

    def _follow(self, name: str, then: Callable[[], None]) -> None:
        """Starts a task because another one has gone; `then` is called once its record says that it is wanted."""
        slot = self.slots.get(name)
        if slot is None or slot.life.state not in RESTS:
            if name and (slot is None or slot.life.state in (State.STOPPING, State.STUCK)):
                self.log("error", f"{name} cannot follow: {self.address} has no such task at rest")
            then()
            return
        reason = self.admit(slot)
        if reason:
            self.log("error", f"{slot.address} cannot follow: {reason}")
            then()
            return

        task_id = self.id_of(slot)
        self._starting.setdefault(task_id, []).append(lambda why_not: then())
        self._leave[task_id] = Leave.WANTED
        self.feed(slot, StartAsked())

    def _attempt_over(self, task_id: TaskId) -> Ledger | None:
        """A hand-off has come to nothing. Returns its account as it stood."""
        move = self._moves.get(task_id)
        if move is None:
            return None
        ledger, move.ledger = move.ledger, None
        return ledger

    def tell_migrator(self, message: object) -> None:
        """Tells the Task Migrator something, where it runs."""
        migrator = self.migrator()
        if migrator is not None:
            tell(migrator, message)

    def migrator(self) -> TaskMigrator | None:
        """Returns the Task Migrator; None: it does not run."""
        component = self.kernel.registry.get(join(self.agent, "network", MIGRATOR))
        return component if isinstance(component, TaskMigrator) else None

    # What others tell ------------------------------------------------------------------------------------------

    def on_receive(self, message: Any) -> Any:
        match message:
            case Came():
                self._receive(message.peer, message.message, message.refusal)
            case BidAwarded():
                self._award(message)
            case Accounted():
                self._one_done(message.task_id)
            case MoveOver():
                self._move_ended(message.task_id, message.reason, message.result)
            case MigratorBegan():
                self._migrator_began()
            case Stood():
                slot = self.slots.get(message.task.name)
                if slot is not None and slot.task is message.task:
                    self._stood(slot, message)
            case _:
                return super().on_receive(message)
        return None

    def knows(self, task_id: TaskId) -> bool:
        """Returns whether this service has a record of the task. Any thread."""
        hand_off = self.hand_offs.get(task_id)
        return hand_off is not None and (hand_off.record.phase is not Phase.ABSENT or hand_off.record.seen != NO_EPOCH)

    def _receive(self, peer: str, message: HandOffMessage, refusal: str) -> None:
        """Takes a hand-off message from a peer. In this actor."""
        task_id = message.task_id
        news = isinstance(message, Transfer) and would_take(self.hand_off(task_id).record, message.offer)
        if isinstance(message, Transfer) and news and not refusal:
            refusal = self._cannot_build(message)
            if not refusal:
                self._arriving[task_id] = peer
        self.hand_off(task_id).feed(Received(peer, message, refusal))

    def _cannot_build(self, message: Transfer) -> str:
        """Builds what arrives, dormant, and keeps its actuators for it; says why that cannot be."""
        try:
            snapshot = Snapshot.decode(message.snapshot)
            if snapshot.task_id != message.task_id:
                return f"the snapshot is of {snapshot.task_id}, not of {message.task_id}"
            if snapshot.service != self.name:
                return f"has a record of {message.task_id} in its service {self.name!r}, not in {snapshot.service!r}"
            spec = spec_of(snapshot, self._catalogue)
            make_settings(spec.cls.Settings, snapshot.settings, owner=spec.name)
            make_settings(spec.cls.State, snapshot.state, allow_nan=True)
        except (PancakesError, msgspec.ValidationError) as error:
            return str(error)
        slot = self.slots.get(message.task_id.name)
        if slot is not None and self.id_of(slot) != message.task_id and slot.name not in self._leaving:
            return f"has a task named {slot.name} already"
        return self.kernel.registry.reserve(self._place_of(message.task_id), snapshot.requires)

    def _award(self, awarded: BidAwarded) -> None:
        """The bids are compared: hands the task to the cheapest bidder."""
        move = self._moves.get(awarded.task_id)
        if move is not None:
            move.ledger = awarded.ledger
        self.hand_off(awarded.task_id).feed(Award(awarded.peer, awarded.request))

    def _move_ended(self, task_id: TaskId, reason: str, result: Any) -> None:
        """The move is over, one way or the other. In this actor."""
        move = self._moves.pop(task_id, None)
        if move is None:
            return
        if move.answer is not None:
            self.reply(move.answer, reason, result)
        if reason and not move.dry_run:
            self._ask_again_s[task_id] = self.kernel.host.now() + ASK_AGAIN_S
            self.log("warning", f"{task_id} stays on {self.agent}: {reason}")

    def _migrator_began(self) -> None:
        """The migrator has started anew and knows of no negotiation: those that wait are told. In this actor.

        A hand-off under way goes on without it, and with it the move.
        """
        for task_id, move in list(self._moves.items()):
            if move.ledger is None:
                self._move_ended(task_id, "the Task Migrator was started anew", None)

    # Asking for a move -----------------------------------------------------------------------------------------

    def carry_out_command(self, body: Any, slot: Slot | None, request: Request) -> None:
        if isinstance(body, Adopt):
            self._decisions.adopt(body, request)
            return
        if isinstance(body, Forget):
            self._decisions.forget(body, request)
            return
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
        if slot.task is None or slot.life.state is not State.RUNNING:
            raise ControlRefused(f"{slot.address} is {slot.life.word}, so it cannot move")
        if not slot.spec.type:
            raise ControlRefused(f"{slot.address} has no entry point under which another agent could find its class")
        if task_id in self._moves:
            raise ControlRefused(f"{slot.address} is being moved already")
        fault = fault_of_choice(body.cost)
        if fault:
            raise ControlRefused(f"{slot.address} cannot move: {fault}")
        if body.then and body.then not in self.slots:
            raise ControlRefused(f"{self.address} has no task {body.then!r} that could follow {slot.name}")
        migrator = self.migrator()
        if migrator is None:
            raise ControlRefused(f"{slot.address} cannot move: the Network Service of {self.agent} is stopped")
        self._asks += 1
        rule = slot.spec.rule
        request = Solicit(
            task_id,
            self._asks,
            slot.spec.type,
            slot.spec.version,
            self.name,
            slot.spec.cls.requires,
            len(self.hand_off(task_id).record.snapshot),
            body.cost,
            rule.below if rule is not None and rule.when == "battery" else None,
        )
        self._moves[task_id] = Move(request, body.then, answer, body.dry_run)
        asked_by = answer.by if answer is not None else "rule"
        self.event("migration_asked", task=slot.name, by=asked_by, cost=cost_text(body.cost), to=body.to)
        tell(migrator, Negotiate(self, request, asked_by, body.to, body.dry_run))

    # What a person decides -------------------------------------------------------------------------------------

    def has(self, name: str) -> bool:
        # What was given away and stands in doubt has no slot any more, nor has what came here and was lost.
        return super().has(name) or self._decisions.concern(name)

    def records_of(self, name: str) -> list[Record]:
        """Returns what this service has of tasks of a name. Any thread."""
        return [self.hand_offs[task_id].record for task_id in list(self._ids.get(name, ()))]

    def _not_written(self, hand_off: HandOff, reason: str) -> None:
        super()._not_written(hand_off, reason)
        record = hand_off.record
        slot = self._slot_of(record.task_id)
        starts = slot is not None and slot.life.state is State.ASKED
        if record.phase is not Phase.PREPARED and not starts and record.task_id not in self._starting:
            self.kernel.registry.unreserve(self._place_of(record.task_id))
        if record.phase in DOUBT and hand_off.idle:
            # An adoption is not tried again by itself: the person may have learnt better meanwhile.
            for then in self._starting.pop(record.task_id, []):
                then(f"{record.task_id} is not adopted: {reason}")

    # Rules -----------------------------------------------------------------------------------------------------

    def task_running(self, slot: Slot) -> None:
        super().task_running(slot)
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
            if rule is None or rule.when != packet.type or slot.life.state is not State.RUNNING:
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
