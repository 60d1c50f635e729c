"""Takes tasks in, from other agents and from the journal: checks them, opens a slot, and prepares their start.

All in the service's actor. What a peer may leave here without handing it over is bounded.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import msgspec
from msgspec.structs import replace

from pancakes.control import Refusal, Revive
from pancakes.durable.checkpoints import carried_of, settings_now, spec_of
from pancakes.durable.courier import COURIER, SendUnsent
from pancakes.durable.handoff import would_take
from pancakes.durable.handoff_events import Received, StartTask
from pancakes.durable.host_state import HostState
from pancakes.durable.hosting import SURE, HostingService, LastSaid, PeerTalk, Place, began_from
from pancakes.durable.installed import Installed
from pancakes.durable.messages import Abort, Commit, HandOffMessage, Nak, Piece, Reserve, Transfer, is_for
from pancakes.durable.ownership_checks import Disputes
from pancakes.durable.record import Phase, TaskId, is_out_of_reach
from pancakes.durable.snapshot import Assembly, Snapshot
from pancakes.durable.state_machine import AskRoom, NoPlace, PlaceFree, Room, idle
from pancakes.durable.store import Records
from pancakes.errors import MigrationError, PancakesError, RemoteProtocolError
from pancakes.kernel.payload_size import in_brief
from pancakes.packet import Fence, Packet, agent_of, join
from pancakes.settings import SettingsError, make_settings, plain_settings
from pancakes.supervision.lifecycle import CLOSES, Admitted, LeaveRefused
from pancakes.supervision.slots import Slot
from pancakes.task import Task, TaskSpec
from pancakes.util.arrays import alike

MOST_IN_DOUBT: Final = 64
"""So many tasks of one peer are kept that it has brought and not handed over, ..."""
MOST_IN_DOUBT_BYTES: Final = 64 * 1024 * 1024
"""... and so many bytes of them; one may always be kept."""
MOST_LEFT: Final = 4096
"""So many tasks of one peer are remembered that it has brought and taken back: a mark is never deleted."""
SETTLE_S: Final = 10.0
"""How long, in host time, a rule leaves a task alone that has just arrived: no ping-pong."""


class Arrivals:
    """Takes tasks in, from other agents and from the journal. All in the service's actor.

    Args:
        host: the service.
        catalogue: where the classes of tasks that arrive are found.
        records: says which service has the record of a task.
        state: says whether this agent can take a task.
        disputes: says what this agent does not know of its tasks.
        talk: how it talks to other agents.
    """

    def __init__(
        self,
        host: HostingService,
        catalogue: Installed,
        records: Records,
        state: HostState,
        disputes: Disputes,
        talk: PeerTalk,
    ) -> None:
        self._host = host
        self._disputes = disputes
        self._catalogue = catalogue
        self._records = records
        self._state = state
        self._talk = talk
        self._assembly = Assembly()
        self._refused = LastSaid()

    def found(self, place: Place) -> list[TaskSpec]:
        """Takes up a record that was on disk; returns its task, where the configuration does not have it."""
        host, task_id, record = self._host, place.task_id, place.standing.record
        if not record.snapshot:
            return []
        try:
            snapshot = Snapshot.decode(record.snapshot)
            # In each start of the agent, and of the service, later than in the one before.
            life = (self._talk.boot << 40) + int(host.kernel.host.now() * 1000.0)
            place.began = began_from(record.epoch, snapshot, life)
            specs = [] if task_id.name in host.residents else [self._spec_here(snapshot)]
        except (PancakesError, msgspec.ValidationError) as error:
            if task_id.name not in host.residents:  # else that is said where its start is refused
                host.log("error", f"{task_id} rests in the journal and cannot be started: {error}")
            return []
        if record.phase is Phase.PREPARED:
            # A task that is in doubt may be started any moment: no other task here may take its actuators before.
            reason = host.kernel.registry.reserve(join(host.address, task_id.name), snapshot.requires)
            if reason:
                host.log("warning", f"no actuators are kept for {task_id}: {reason}")
        return specs

    def undecided(self, slot: Slot, place: Place) -> str:
        """Says why a task would not start, as this agent does not know what it must know; empty: it does."""
        if lost := self._lost(place):
            return lost
        unsure = self._disputes.unsure(slot, place, starts=False)
        return unsure.why if unsure is not None else ""

    def _lost(self, place: Place) -> str:
        record = place.standing.record
        lost = self._records.lost(record.task_id) if record.phase is Phase.ABSENT else None
        return lost.undecided(self._host.agent) if lost is not None else ""

    def receive(self, packet: Packet, place: Place, refusal: Refusal | None = None) -> Received | None:
        """Takes a hand-off message of a peer.

        Args:
            packet: the message.
            place: the place of its task.
            refusal: why a reservation is refused already; None: it is not.

        Returns:
            What to feed to the place of the task; None: the rest of its snapshot is still to come, it was meant for
            this agent with another disk, or another service has its record, and answers once it is asked.
        """
        peer, record = agent_of(packet.source), place.standing.record
        message = self._whole(peer, packet.body, place) if is_for(packet.body, self._talk.me.journal) else None
        if message is None:
            return None
        if isinstance(message, Reserve):
            if refusal is None and is_out_of_reach(message.offer, record.seen):
                too_far = f"the epoch {message.offer} is further from {record.seen} than any task comes"
                refusal = Refusal("invalid", too_far)
            refusal = refusal or self._full_of(peer, place, 0) or self._state.reserve(peer, message)
            if refusal is None:
                place.promised = (peer, message.offer)
            return Received(peer, message, refusal)
        if isinstance(message, Transfer):
            self._state.free(message.task_id)
            if not would_take(record, message.offer):
                return Received(peer, message)
            size = len(message.snapshot)
            refusal = self._full_of(peer, place, size) or self.cannot_build(peer, place, message.snapshot)
            place.came_from = peer if refusal is None else ""
            return Received(peer, message, refusal)
        if record.unborn and self._records.service_of(message.task_id) not in ("", self._host.name):
            return None
        return Received(peer, message)

    def _full_of(self, peer: str, place: Place, more_bytes: int) -> Refusal | None:
        """Returns why no more is kept of what a peer has brought and not handed over; None: there is room."""
        records = self._records.all().values()
        left = sum(it.phase is Phase.ABSENT and it.peer == peer for it in records)
        if place.standing.record.unborn and left >= MOST_LEFT:
            return self._at_bound(peer, f"remembers {left} tasks that {peer} has brought and taken back, and no more")
        kept = [it for it in records if it.phase is Phase.PREPARED and it.peer == peer and it.task_id != place.task_id]
        size = sum(len(it.snapshot) for it in kept) + more_bytes
        if len(kept) < MOST_IN_DOUBT and (not kept or size <= MOST_IN_DOUBT_BYTES):
            return None
        drops = f"`pancakes task forget-peer {self._host.agent} {peer}` drops them"
        return self._at_bound(
            peer, f"keeps {len(kept)} tasks that {peer} has brought and not handed over, and no more: {drops}"
        )

    def _at_bound(self, peer: str, why: str) -> Refusal:
        if self._refused.is_news(peer, why):
            self._host.log("warning", f"{self._host.agent} {why}")
        return Refusal("unable", why)

    def is_unused(self, place: Place) -> bool:
        """Returns whether nothing has come of a place that was promised to a peer."""
        used = place.slot, place.taking, place.creation, place.adoption, place.follows, place.move
        return place.standing.record.unborn and idle(place.standing) and not any(it is not None for it in used)

    def comes(self, place: Place) -> bool:
        """Returns whether a snapshot of a task is on its way."""
        return self._assembly.has(place.task_id)

    def _whole(self, peer: str, message: HandOffMessage | Piece, place: Place) -> HandOffMessage | None:
        """Returns a message as it is; of a piece of a snapshot, the whole once all pieces are there."""
        if not isinstance(message, Piece):
            if isinstance(message, (Commit, Abort)):
                self._assembly.end(peer, message.task_id)
            return message
        if place.promised != (peer, message.offer):
            # Where it is no news, its sender hears by another message what became of it.
            if would_take(place.standing.record, message.offer):
                unasked = Refusal("invalid", "was not asked for a place for it first")
                self._talk.hand_off(peer, Nak(message.task_id, message.offer, unasked))
            return None
        try:
            return self._assembly.add(peer, message)
        except RemoteProtocolError as error:
            self._talk.hand_off(peer, Nak(message.task_id, message.offer, Refusal("invalid", str(error))))
            return None

    def drop_pieces(self, peer: str) -> None:
        """Forgets the pieces of a peer that has gone: a snapshot that was on its way would come anew."""
        self._assembly.drop(peer)

    def cannot_build(self, peer: str, place: Place, encoded: bytes) -> Refusal | None:
        """Builds a task that a peer brings, dormant, and keeps its actuators for it; returns why it cannot."""
        task_id = place.task_id
        try:
            snapshot = Snapshot.decode(encoded)
            if fault := self._host.kernel.access.fault(peer, "host", snapshot.type):
                return Refusal("forbidden", fault)
            if snapshot.task_id != task_id:
                return Refusal("invalid", f"the snapshot is of {snapshot.task_id}, not of {task_id}")
            here = self._records.service_of(task_id) or self._host.name
            if not here == snapshot.service == self._host.name:
                other = f"has a record of {task_id} in its service {here!r}, not in {snapshot.service!r}"
                return Refusal("unsupported", other)
            spec = spec_of(snapshot, self._catalogue)
            make_settings(spec.cls.Settings, snapshot.settings, owner=spec.name)
            make_settings(spec.cls.State, snapshot.state, allow_nan=True, owner=spec.name, noun="state")
            if outside := self._host.kernel.folders.refusal_of(spec.cls.Settings, snapshot.settings):
                return Refusal("invalid", f"bad settings for {spec.name}: {outside}")
        except (PancakesError, msgspec.ValidationError) as error:
            return Refusal.of(error)
        slot = self._host.slots.get(task_id.name)
        if slot is not None:
            there = self._host.places.at[slot.name]
            if there is not place and not there.standing.leaving:
                return Refusal("conflict", f"has a task named {slot.name} already")
        why_not = self._host.kernel.registry.reserve(join(self._host.address, task_id.name), snapshot.requires)
        return Refusal.if_any(why_not)

    def as_configured(self, body: Revive) -> bytes:
        """Returns a task as it begins that a person has described, encoded.

        Raises:
            PancakesError: its class is not installed here, or it cannot be written.
        """
        cls, version = self._catalogue.find(body.type)
        return Snapshot(
            task_id=TaskId.parse(body.task_id),
            type=body.type,
            version=version,
            service=self._host.name,
            requires=cls.requires,
            settings=body.settings,
            configured=body.settings,
            restart=body.restart,
            durability=body.durability,
            migrate=body.migrate,
            guard=body.guard,
        ).encode()

    def room(self, slot: Slot, place: Place, asked: AskRoom) -> Room:
        """Sees whether a task can run here now, and what it would begin with."""
        registry, record = self._host.kernel.registry, place.standing.record
        place.unsure = SURE
        if lost := self._lost(place):
            registry.unreserve(slot.address)
            return Room(asked, lost, for_good=True)
        if unsure := self._disputes.unsure(slot, place):
            registry.unreserve(slot.address)
            place.unsure = unsure
            return Room(asked, unsure.why, for_good=unsure.for_good)
        reason = self._host.admit(slot)
        if not reason and record.snapshot and slot.carried is None and not slot.fresh:
            try:
                Snapshot.decode(record.snapshot)
            except MigrationError as error:
                reason = self._unreadable(slot, error)
        if not reason and asked.keep:
            reason = registry.reserve(slot.address, slot.spec.cls.requires)
        if reason:
            return Room(asked, reason)
        if slot.fresh:
            slot.fresh = False
            self._host.drop_state(slot)
        snapshot = self._host.snapshot_at_rest(slot)
        if not snapshot and record.may_begin:
            snapshot = self._host.snapshot(slot, None)
        return Room(asked, snapshot=snapshot, guardian=self._host.first_guardian(place))

    def _unreadable(self, slot: Slot, error: MigrationError) -> str:
        return (
            f"what is on disk of it cannot be read: {error}; if another version of Pancakes has written it, start that,"
            f" or `pancakes task restart --drop-state {self._host.agent}/{slot.name}` begins it"
            f" as its configuration says, without its state"
        )

    def open(self, place: Place, start: StartTask) -> PlaceFree | NoPlace | None:
        """Opens a place for a task among the tasks of the service; returns what follows."""
        if place.task_id.name in self._host.slots:
            return None  # the actor of a task of the same name that was given away has not ended yet
        try:
            self._host.open_slot(self._spec_here(Snapshot.decode(start.snapshot)))
        except (PancakesError, msgspec.ValidationError) as error:
            self._host.log("error", f"{place.task_id} is ours, but cannot be started: {error}")
            return NoPlace(str(error))
        return PlaceFree()

    def _spec_here(self, snapshot: Snapshot) -> TaskSpec:
        """Returns how to start a task that this agent's configuration does not name.

        Raises:
            PancakesError: its class is not installed here.
        """
        spec = spec_of(snapshot, self._catalogue)
        # On its birthplace no file names it, or none does any more.
        born_here = snapshot.task_id.birthplace == self._host.agent
        return replace(spec, created=True) if born_here else spec

    def prepare(self, slot: Slot, place: Place, start: StartTask) -> Admitted | LeaveRefused:
        """Gives the place of a task what it begins with, and its actuators; returns whether it may start."""
        try:
            snapshot = Snapshot.decode(start.snapshot)
        except MigrationError as error:
            return LeaveRefused(self._unreadable(slot, error))
        place.written, place.looked_s = None, self._host.kernel.host.now()
        slot.carried = replace(carried_of(snapshot), settings=self._settings_now(slot, snapshot))
        slot.fence = Fence(str(place.task_id), (start.epoch.n, start.epoch.minter))
        kernel = self._host.kernel
        self._host.outbox.arrive(place.task_id, snapshot.posted, start.fresh, kernel.host.now(), kernel.restamped)
        if snapshot.posted is not None:
            self._host.kernel.tell(COURIER, SendUnsent())
        if place.came_from:
            place.ask_again_s = self._host.kernel.host.now() + SETTLE_S
            state = in_brief(snapshot.state)
            self._host.event(
                "task_arrived", task=slot.name, source_agent=place.came_from, epoch=start.epoch.n, state=state
            )
            place.came_from = ""
        place.unsure = self._disputes.copied.of(place) or SURE
        reason = CLOSES if self._host.closing else place.unsure.why or self._host.admit(slot)
        reason = reason or self._host.kernel.registry.hold(slot.address, slot.spec.cls.requires)
        return LeaveRefused(reason) if reason else Admitted(start.incarnation + 1)

    def _settings_now(self, slot: Slot, snapshot: Snapshot) -> Mapping[str, Any]:
        """Returns the settings that a task goes on with: its own, and what its configuration has changed since."""
        if slot.name not in self._host.residents or alike(snapshot.configured, slot.spec.settings):
            return snapshot.settings
        configured = slot.spec.settings
        if snapshot.created:
            # The file names it for the first time, and may say all of its settings, as `config show` does.
            cls = slot.spec.cls
            snapshot = replace(snapshot, configured=_with_defaults(cls, snapshot.configured))
            configured = _with_defaults(cls, configured)
        settings, names = settings_now(snapshot, configured)
        if names:
            self._host.log("info", f"{slot.address} takes what has changed in its configuration: {', '.join(names)}")
        return settings


def _with_defaults(cls: type[Task], settings: Mapping[str, Any]) -> Mapping[str, Any]:
    try:
        return plain_settings(make_settings(cls.Settings, settings))
    except SettingsError:  # it is of another version
        return settings
