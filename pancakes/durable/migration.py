"""Migrates hosted tasks away: asks for bids, pauses the task, hands it over, and does what follows.

`Mover` takes the request of a person or a rule, and the award of the Task Migrator. `Departures` carries out what the
migration asks of the task: pause, resume, leave. All in the service's actor.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import replace

from pancakes.control import Describe, Migrate, Refusal, Remove, Stop
from pancakes.durable.after_migration import Sequel
from pancakes.durable.bidding_messages import (
    MIGRATOR,
    AttemptOver,
    BidAwarded,
    HasMoved,
    MoveOver,
    MoverBegan,
    Negotiate,
)
from pancakes.durable.hosting import Move, Place
from pancakes.durable.messages import REGISTRAR
from pancakes.durable.reconcile import (
    AttemptFailed,
    Award,
    Freeze,
    FreezeFailed,
    Frozen,
    HandedOver,
    Outcome,
    RestOverdue,
    StartWanted,
    StillOverdue,
    StoodStill,
    TakeDown,
    Write,
)
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Standing, Wanted
from pancakes.durable.register_messages import Concluded
from pancakes.durable.snapshot import Snapshot
from pancakes.errors import ControlRefusedError, MigrationError, PancakesError
from pancakes.kernel.handlers import LATEST
from pancakes.kernel.mailbox import tell
from pancakes.migration import (
    AGAIN_S,
    MigrationReport,
    MigrationRule,
    cost_text,
    fault_of_choice,
)
from pancakes.packet import SYSCTRL, SYSTEM, Fence, Packet, agent_of, join
from pancakes.supervision.lifecycle import RESTS, Request, State
from pancakes.supervision.messages import Carried, GoOn, StandStill
from pancakes.supervision.slots import CHANGES, STUCK_S, Slot

if TYPE_CHECKING:
    from pancakes.durable.client_service import ClientServiceCore


class Departures:
    """Carries out what migrations ask of tasks that leave one service. All in that service's actor.

    Args:
        host: the service.
    """

    def __init__(self, host: ClientServiceCore) -> None:
        self._host = host

    def freeze(self, slot: Slot, place: Place, effect: Freeze) -> StoodStill | None:
        """Pause a task; its actor answers `StoodStill`. If it has none, that is returned."""
        if slot.task is None:
            return StoodStill(effect.number, reason="it does not run")
        tell(slot.task, StandStill(effect.number))
        self._host.after_host(STUCK_S, partial(self._host.feed_place, place, StillOverdue(effect.number)))
        return None

    def take_down(self, slot: Slot, place: Place, effect: TakeDown) -> Frozen | FreezeFailed:
        """Write down a task that is paused, and hold its actuators; return what follows."""
        self._host.hold_actuators(slot, "its task is handed over")
        assert isinstance(effect.carried, Carried)
        try:
            snapshot = self._host.snapshot(slot, effect.carried, self._host.outbox.leave(str(place.task_id)))
        except PancakesError as error:
            self._host.outbox.stay(str(place.task_id))
            self.let_go_on(slot, place)
            return FreezeFailed(str(error))
        self._host.event("task_frozen", task=slot.name, offer=place.record.epoch.n)
        move = place.move
        sequel = Sequel(move.then, move.ledger).encode() if move is not None else b""
        return Frozen(snapshot, sequel)

    def let_go_on(self, slot: Slot, place: Place) -> None:
        """Let a task go on that is paused, under the epoch of its record."""
        if slot.task is not None:
            epoch = place.record.epoch
            slot.fence = Fence(str(place.task_id), (epoch.n, epoch.minter.agent))
            tell(slot.task, GoOn(slot.fence))

    def look_at_rest(self, place: Place) -> None:
        """A guarded task comes to rest: that is done once its members know, as else a taker would go on with it."""
        members = ", ".join(sorted({one.agent for one in place.record.members} - {self._host.agent}))
        reason = (
            f"{place.task_id} is stopped on {self._host.agent}, but too few of its guardians ({members}) have confirmed"
            " that: if they cannot be reached, another agent may go on with it"
        )
        self._host.after_host(STOP_HEARD_S, lambda: self._rest_overdue(place, reason))

    def _rest_overdue(self, place: Place, reason: str) -> None:
        if place.removal is None:  # else that waits for them
            self._host.feed_place(place, RestOverdue(reason))

    def resume(self, place: Place, slot: Slot | None) -> None:
        """Lets a task go on that does not leave after all."""
        self._host.outbox.stay(str(place.task_id))
        if slot is not None and slot.task is not None:
            self._host.event("task_resumed", task=slot.name)
            self.let_go_on(slot, place)

    def drop(self, place: Place, slot: Slot | None, ends: bool) -> None:
        """Forgets what is owed for a task, and kept for it."""
        self._host.kernel.registry.unreserve(join(self._host.address, place.task_id.name))
        # What it was, down to the last byte of its state, is elsewhere now.
        place.came_from, place.letters, place.written, place.ask_again_s = "", None, None, 0.0
        self._host.outbox.gone(str(place.task_id), ends)
        if ends and slot is not None:
            # At once: what its `on_stop` may still command must not reach a wheel that the new owner's host may need.
            self._host.hold_actuators(slot, "its task was handed over")
            self._host.kernel.registry.release(slot.address)

    def vacate(self, slot: Slot) -> list[Place]:
        """A task was given away: what is left of it here is the tombstone in the journal.

        Returns:
            The places of other tasks of this name, which may wait for its slot.
        """
        slot.carried = None
        slot.mailbox.clear_data()
        if slot.fence is not None:
            self._host.outbox.ended(slot.fence.task_id)
        if slot.name not in self._host.residents:
            del self._host.slots[slot.name]
            self._host.kernel.tasks.strike_out(self._host.name, slot.name)
        return self._host.places.named(slot.name)


STOP_HEARD_S: Final = 4.0
"""A stop waits this long for the members of the task, in host time."""


class Mover:
    """Looks after the moves of one service's tasks. All in that service's actor.

    Args:
        host: the service.
    """

    def __init__(self, host: ClientServiceCore) -> None:
        self._host = host
        self._broken_off: list[tuple[Record, MigrationReport]] = []  # by the end of this service's predecessor
        self._not_followed: list[tuple[TaskId, str]] = []  # what was stopped, and what was to start in its place
        self._watched: list[str] = []
        self._asks = 0

    def begin(self) -> None:
        """The service has begun: accounts for the moves that its predecessor's end has broken off."""
        for record, ledger in self._broken_off:
            reason = f"{self._host.address} was started again before {ledger.winner} had the task"
            stayed = ledger.stayed(str(record.epoch), reason)
            self._host.kernel.tell(REGISTRAR, Concluded(record.task_id))
            over = AttemptOver(self._host, record.task_id, "", Refusal("conflict", reason), stayed)
            self._host.kernel.tell(MIGRATOR, over)
        for task_id, then in self._not_followed:
            self._start_follower(self._host.places[task_id], then)
        self._broken_off, self._not_followed = [], []
        self._host.kernel.tell(MIGRATOR, MoverBegan(self._host))

    def found(self, record: Record) -> None:
        """Learns of a record that was on disk."""
        if not record.owned or not record.sequel:
            return
        sequel = self.sequel_of(record)
        if sequel.ledger is not None:
            self._broken_off.append((record, sequel.ledger))
        elif record.wanted is Wanted.STOPPED:
            self._not_followed.append((record.task_id, sequel.then))

    def sequel_of(self, record: Record) -> Sequel:
        """Return what is to follow a migration; nothing, if that cannot be read."""
        return self._read(record.task_id, record.sequel)

    def _read(self, task_id: TaskId, sequel: bytes) -> Sequel:
        try:
            return Sequel.decode(sequel)
        except MigrationError as error:
            self._host.log("error", f"what was to follow the migration of {task_id} is not done: {error}")
            return Sequel()

    def refuse_elsewhere(self, slot: Slot, body: Any) -> None:
        """See whether something can be asked here of a task. A stop can, also while it is being handed over.

        Raises:
            ControlRefusedError: it is on its way, it has left, or it is being removed.
        """
        place = self._host.places.at[slot.name]
        record, describes = place.record, isinstance(body, Describe)
        going = (place.course.paused and not isinstance(body, Stop)) or record.in_doubt
        if going and not describes:
            moving = place.course.moving
            peer = moving.heir.agent if moving is not None else record.peer
            raise ControlRefusedError(
                f"{slot.address} is being handed over between {self._host.agent} and {peer}", "busy"
            )
        if place.course.leaving and not describes:
            raise ControlRefusedError(f"{slot.address} was handed over, and has not ended yet", "busy")
        if place.removal is not None and not describes:
            raise ControlRefusedError(f"{slot.address} is being removed", "busy")
        asks_state = describes and (body.state or body.began)
        changes = asks_state or isinstance(body, Stop | Migrate | Remove) or type(body) in CHANGES
        if record.standing in (Standing.RELEASED, Standing.MEMBER) and not record.removed and changes:
            raise ControlRefusedError(f"{record.task_id} moved to {record.peer}", "moved")

    # Asking for a move -----------------------------------------------------------------------------------------

    def negotiate(self, slot: Slot, body: Migrate, answer: Request | None) -> None:
        """Has the Task Migrator ask the neighbours for bids.

        Args:
            slot: the task.
            body: what is asked for.
            answer: the request to answer; None: a rule asks.

        Raises:
            ControlRefusedError: the task cannot move now.
        """
        self.refuse_elsewhere(slot, body)
        host = self._host
        place = host.places.at[slot.name]
        if slot.task is None or slot.life.state is not State.RUNNING:
            raise ControlRefusedError(f"{slot.how_it_is}, so it cannot move")
        if not slot.spec.type:
            raise ControlRefusedError(
                f"{slot.address} has no entry point under which another agent could find its class", "unsupported"
            )
        if place.move is not None:
            raise ControlRefusedError(f"{slot.address} is being moved already", "busy")
        fault = fault_of_choice(body.cost)
        if fault:
            raise ControlRefusedError(f"{slot.address} cannot move: {fault}", "unable")
        if body.then and body.then not in host.slots:
            raise ControlRefusedError(
                f"{host.address} has no task {body.then!r} that could follow {slot.name}", "not_found"
            )
        if host.kernel.actor(MIGRATOR) is None:
            raise ControlRefusedError(
                f"{slot.address} cannot move: the Network Service of {host.agent} is stopped", "unable"
            )
        self._asks += 1
        try:
            snapshot = replace(
                Snapshot.decode(place.record.snapshot),
                # What it is now. The last checkpoint may be of an older version of its class.
                type=slot.spec.type,
                version=slot.spec.version,
                service=host.name,
                requires=slot.spec.cls.requires,
            )
            request = snapshot.solicit(self._asks, body.cost, slot.spec.rule)
        except MigrationError as error:
            raise ControlRefusedError(
                f"{place.task_id} cannot move for the cost {cost_text(body.cost)}: {error}", "unable"
            ) from None
        place.move = Move(request, body.then, answer, body.dry_run)
        asked_by = answer.by if answer is not None else "rule"
        host.event("migration_asked", task=slot.name, by=asked_by, cost=cost_text(body.cost), to=body.to)
        host.kernel.tell(MIGRATOR, Negotiate(self._host, request, asked_by, body.to, body.dry_run))

    def check_follower(self, slot: Slot, name: str) -> None:
        """See that a task can start in the place of another one, which is being stopped.

        Raises:
            ControlRefusedError: it cannot start here.
        """
        host = self._host
        if name == slot.name:
            raise ControlRefusedError(f"{name} cannot follow itself: restart it", "invalid")
        other = host.slots.get(name)
        if other is None:
            raise ControlRefusedError(f"{host.address} has no task {name!r} that could follow {slot.name}", "not_found")
        place = host.places.at[name]
        if place.record.standing in (Standing.RELEASED, Standing.MEMBER) and not place.record.removed:
            raise ControlRefusedError(f"{name} cannot follow {slot.name}: it moved to {place.record.peer}", "moved")
        if other.life.state not in RESTS:
            raise ControlRefusedError(f"{name} cannot follow {slot.name}: it is {other.life.word} already", "conflict")
        if reason := host.admit(other):
            raise ControlRefusedError(f"{name} cannot follow {slot.name}: {reason}", "unable")

    def write_stop(self, place: Place, event: Any) -> None:
        """Have the stop of a task written, and with it what starts in its place: one write, so neither is forgotten."""
        stops = event.wanted is Wanted.STOPPED
        sequel = Sequel(place.then).encode() if stops else b""
        then = partial(self._stop_written, place, place.then) if stops else None
        self._host.tell_registrar(place, event, then, write=Write.REST, sequel=sequel)

    def _stop_written(self, place: Place, name: str, outcome: Outcome, why: str) -> None:
        if outcome is Outcome.WRITTEN and place.then == name:
            self._start_follower(place, name)

    def look_at_stopped(self, slot: Slot, place: Place) -> None:
        """A task was asked to stop: if it was at rest already, nothing is written."""
        if place.then and slot.life.at_rest and place.course.settled:
            self._start_follower(place, place.then)

    def _start_follower(self, gone: Place, name: str) -> None:
        gone.then, gone.to_follow = "", 1
        self._follow(name, gone)

    def watch(self, slot: Slot) -> None:
        """A task runs: watches what its rule for moving is about."""
        rule = slot.spec.rule
        if rule is not None and not rule.allocated and rule.when not in self._watched:
            self._watched.append(rule.when)
            self._host.subscribe(SYSTEM, rule.when, self._on_reading, queue=LATEST)

    def _on_reading(self, packet: Packet) -> None:
        """A reading that rules watch has come."""
        host = self._host
        if agent_of(packet.source) != host.agent:
            return
        for slot in list(host.slots.values()):
            rule = slot.spec.rule
            if rule is None or rule.when != packet.type or slot.life.state is not State.RUNNING:
                continue
            place = host.places.at[slot.name]
            if host.kernel.host.now() < place.ask_again_s or place.move is not None:
                continue
            # What is to follow may exist only on the agent where the rule was written.
            then = rule.then if rule.then in host.slots else ""
            try:
                if rule.met_by(packet.body):
                    self.negotiate(slot, Migrate(slot.name, then=then, cost=rule.cost), None)
            except (ControlRefusedError, MigrationError) as error:
                self._refused(place, rule, f"the rule of {slot.address} could not move it: {error}")

    # What the Task Migrator tells ------------------------------------------------------------------------------

    def heard(self, place: Place, message: BidAwarded | MoveOver) -> None:
        """The agent with the lowest bid keeps room for the task, or a migration is over."""
        if isinstance(message, MoveOver):
            self._over(place, message)
            return
        if place.move is not None:
            place.move.ledger = message.ledger
        self._host.feed_place(place, Award(message.heir))

    def _over(self, place: Place, over: MoveOver) -> None:
        move, place.move = place.move, None
        if move is not None and move.answer is not None:
            self._host.reply(move.answer, Refusal.if_any(over.reason), over.result)
        if move is not None and over.reason and not move.dry_run:
            rule = place.slot.spec.rule if place.slot is not None and move.answer is None else None
            why = f"{over.task_id} stays on {self._host.agent}: {over.reason}"
            self._refused(place, rule, why, "info" if move.answer is not None else "warning")
        if place.account is not None and not over.reason:
            place.account = None
            self._has_followed(place)

    def _refused(self, place: Place, rule: MigrationRule | None, why: str, level: str = "warning") -> None:
        """No agent takes a task now. Where its rule has asked, that says what is done then.

        Args:
            place: the task's place.
            rule: the rule that asked for the move; None: a person did, or a program.
            why: why it stays, as a sentence.
            level: that of the sentence on `log`; one who has asked is told it anyway.
        """
        host, slot = self._host, place.slot
        host.log(level, why)
        place.ask_again_s = host.kernel.host.now() + (rule.again_s if rule is not None else AGAIN_S)
        other = host.slots.get(rule.otherwise) if rule is not None and rule.otherwise else None
        if slot is None or other is None or other.life.state not in RESTS:
            return
        if reason := host.admit(other):
            host.log("error", f"{other.address} cannot start in the place of {slot.address}: {reason}")
            return
        host.log("warning", f"{slot.address} is stopped, and {other.address} starts in its place")
        # As anybody would ask for it: so it is wanted stopped, also after a reboot. The other one waits for what the
        # task holds.
        host.publish(SYSCTRL, Stop(slot.name, then=other.name))

    def migrator_began(self) -> None:
        """The migrator has started again and knows of no negotiation: the requests that wait are answered.

        A migration under way goes on without it, and with it the move.
        """
        for place in list(self._host.places.values()):
            if place.account is not None:
                self._host.kernel.tell(MIGRATOR, place.account)
            elif place.move is not None and place.move.ledger is None:
                self._over(place, MoveOver(place.task_id, "the Task Migrator was started again", None))

    # What migrations ask for ------------------------------------------------------------------------------------

    def attempt_failed(self, place: Place, effect: AttemptFailed) -> None:
        """The migration to a bidder has come to nothing, or (no peer) none can begin now."""
        ledger = place.move.take_ledger() if place.move is not None else None
        if effect.peer or place.move is not None:
            message = AttemptOver(self._host, place.task_id, effect.peer, effect.refusal, ledger)
            self._host.kernel.tell(MIGRATOR, message)

    def handed_over(self, place: Place, effect: HandedOver) -> None:
        """Another agent has the task: does what is to follow."""
        self._host.event("task_handed_over", task=place.task_id.name, to=effect.peer, epoch=effect.epoch.n)
        sequel, place.to_follow = self._read(place.task_id, effect.sequel), 2  # its account, and another task
        # In a turn of its own: after a restart of the agent this comes while the other tasks are being started.
        self._host.call(lambda: self._conclude(place, effect, sequel))

    def _conclude(self, place: Place, effect: HandedOver, sequel: Sequel) -> None:
        host, task_id, peer = self._host, place.task_id, effect.peer
        keeper = f"the Task Migrator of {host.agent}" if place.move is not None else host.address
        on_its_way = f"{keeper} was started again while the task was on its way"
        note = f"{on_its_way}, so the duration ends with the choice of {peer}"
        # Where the migrator does not run, it is told once it does.
        place.account = HasMoved(host, task_id, peer, str(effect.epoch), sequel.ledger, note)
        host.kernel.tell(MIGRATOR, place.account)
        self._follow(sequel.then, place)

    def _follow(self, name: str, gone: Place) -> None:
        """Starts a task because another one has gone; once its record says that it is wanted, that is concluded."""
        host = self._host
        slot = host.slots.get(name)
        reason = ""
        if slot is None or slot.life.state not in RESTS:
            if name and (slot is None or slot.life.state in (State.STOPPING, State.STUCK)):
                reason = f"{name} cannot follow: {host.address} has no such task at rest"
        elif reason := host.admit(slot):
            reason = f"{slot.address} cannot follow: {reason}"
        else:
            place = host.places.at[slot.name]
            place.follows = gone.task_id
            host.feed_place(place, StartWanted())
            return
        if reason:
            host.log("error", reason)
        self._has_followed(gone)

    def followed(self, place: Place, gone: TaskId) -> None:
        """The start of a task that follows another one is decided."""
        place.follows = None
        self._has_followed(self._host.places[gone])

    def _has_followed(self, gone: Place) -> None:
        """A part of what follows a migration or a stop is done; once all is, it is taken out of the task's record."""
        gone.to_follow -= 1
        if not gone.to_follow:
            self._host.kernel.tell(REGISTRAR, Concluded(gone.task_id))
