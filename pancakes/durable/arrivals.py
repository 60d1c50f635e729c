"""Takes tasks in, from other agents and from the journal: checks them, opens a slot, and prepares their start.

All in the service's actor.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec.structs import replace

from pancakes.control import Refusal, Revive
from pancakes.durable.checkpoints import carried_of, settings_now, spec_of
from pancakes.durable.delivery import COURIER, SendUnsent
from pancakes.durable.host_state import HostState
from pancakes.durable.hosting import SURE, BeganFrom, Place
from pancakes.durable.installed import Installed
from pancakes.durable.questions import Disputes
from pancakes.durable.reconcile import AskRoom, NoPlace, PlaceFree, Room
from pancakes.durable.record import TaskId
from pancakes.durable.register import NO_EPOCH, Standing
from pancakes.durable.register_messages import Judge
from pancakes.durable.snapshot import Snapshot
from pancakes.durable.store import Records
from pancakes.errors import MigrationError, PancakesError
from pancakes.kernel.payload_size import in_brief
from pancakes.packet import Fence, join
from pancakes.settings import SettingsError, make_settings, plain_settings
from pancakes.supervision.lifecycle import CLOSES, Admitted, LeaveRefused
from pancakes.supervision.slots import Slot
from pancakes.task import Task, TaskSpec
from pancakes.util.arrays import alike

if TYPE_CHECKING:
    from pancakes.durable.client_service import ClientServiceCore

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
    """

    def __init__(
        self,
        host: ClientServiceCore,
        catalogue: Installed,
        records: Records,
        state: HostState,
        disputes: Disputes,
    ) -> None:
        self._host = host
        self._disputes = disputes
        self._catalogue = catalogue
        self._records = records
        self._state = state

    def found(self, place: Place) -> list[TaskSpec]:
        """Takes up a record that was on disk; returns its task, if the configuration does not have it."""
        host, task_id, record = self._host, place.task_id, place.record
        if not record.snapshot:
            return []
        try:
            snapshot = Snapshot.decode(record.snapshot)
            # In each start of the agent, and of the service, later than in the one before.
            life = (host.boot << 40) + int(host.kernel.host.now() * 1000.0)
            place.began = BeganFrom(record.epoch.n, snapshot.heard, life)
            # One that has left has no slot, also if its checkpoint is kept here for it: another task may have its name.
            has_left = record.standing in (Standing.RELEASED, Standing.MEMBER) and not record.was_ours
            specs = [] if has_left or task_id.name in host.residents else [self._spec_here(snapshot)]
        except (PancakesError, msgspec.ValidationError) as error:
            if task_id.name not in host.residents:  # else that is said where its start is refused
                host.log("error", f"{task_id} rests in the journal and cannot be started: {error}")
            return []
        if record.standing is Standing.HEIR:
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
        record = place.record
        lost = self._records.lost(record.task_id) if record.unborn else None
        return lost.undecided(self._host.agent) if lost is not None else ""

    def judge(self, judge: Judge) -> Refusal | None:
        """Say why a task that an agent offers cannot run here; None: it can. Its actuators are kept for it."""
        place = self._host.places.get(judge.task_id) or self._host.places.unkept(judge.task_id)
        if not self._state.is_expected(judge.peer, judge.task_id):
            return Refusal("invalid", "was not asked for room for it first")
        refusal = self.cannot_build(judge.peer, place, judge.state)
        if refusal is None:
            self._host.places.keep(place)
            place.came_from = judge.peer
        return refusal

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
            if there is not place and not there.course.leaving:
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
        registry, record = self._host.kernel.registry, place.record
        place.unsure = SURE
        if lost := self._lost(place):
            registry.unreserve(slot.address)
            return Room(lost, for_good=True)
        if unsure := self._disputes.unsure(slot, place):
            place.unsure = unsure
            if unsure.for_good:
                registry.unreserve(slot.address)
            else:  # no other task takes them from it while it waits
                registry.reserve(slot.address, slot.spec.cls.requires)
            return Room(unsure.why, for_good=unsure.for_good, waits=not unsure.for_good)
        reason = self._host.admit(slot)
        if not reason and record.snapshot and slot.carried is None and not slot.fresh:
            try:
                Snapshot.decode(record.snapshot)
            except MigrationError as error:
                reason = self._unreadable(slot, error)
        if not reason and asked.keep:
            reason = registry.reserve(slot.address, slot.spec.cls.requires)
        if reason:
            return Room(reason)
        if slot.fresh:
            slot.fresh = False
            self._host.drop_state(slot)
        snapshot = self._host.snapshot_at_rest(slot)
        if not snapshot and record.may_begin:
            snapshot = self._host.snapshot(slot, None)
        other = place.other
        return Room(snapshot=snapshot, floor=other.epoch if other is not None else NO_EPOCH)

    def _unreadable(self, slot: Slot, error: MigrationError) -> str:
        return (
            f"what is on disk of it cannot be read: {error}; if another version of Pancakes has written it, start that,"
            f" or `pancakes task restart --drop-state {self._host.agent}/{slot.name}` begins it"
            f" as its configuration says, without its state"
        )

    def open(self, place: Place) -> PlaceFree | NoPlace | None:
        """Open a place for a task among the tasks of the service; return what follows."""
        if place.task_id.name in self._host.slots:
            return None  # the actor of a task of the same name that was given away has not ended yet
        try:
            self._host.open_slot(self._spec_here(Snapshot.decode(place.record.snapshot)))
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

    def prepare(self, slot: Slot, place: Place, fresh: bool) -> Admitted | LeaveRefused:
        """Give the place of a task what it begins with, and its actuators; return whether it may start."""
        record = place.record
        try:
            snapshot = Snapshot.decode(record.snapshot)
        except MigrationError as error:
            return LeaveRefused(self._unreadable(slot, error))
        place.written, place.looked_s = None, self._host.kernel.host.now()
        slot.carried = replace(carried_of(snapshot), settings=self._settings_now(slot, snapshot))
        slot.fence = Fence(str(place.task_id), (record.epoch.n, record.epoch.minter.agent))
        kernel = self._host.kernel
        posted = snapshot.posted
        if posted is not None:
            # What it sent from another agent goes on from here under its address here, as no agent takes it otherwise,
            # and with stamps of the mission time here.
            posted = posted.of_agent(self._host.agent, kernel.restamped)
        self._host.outbox.arrive(str(place.task_id), posted, fresh, kernel.host.now())
        if posted is not None:
            kernel.tell(COURIER, SendUnsent())
        if place.came_from:
            place.ask_again_s = self._host.kernel.host.now() + SETTLE_S
            state = in_brief(snapshot.state)
            self._host.event(
                "task_arrived", task=slot.name, source_agent=place.came_from, epoch=record.epoch.n, state=state
            )
            place.came_from = ""
        place.unsure = self._disputes.copied.of(place) or SURE
        reason = CLOSES if self._host.closing else place.unsure.why or self._host.admit(slot)
        reason = reason or self._host.kernel.registry.hold(slot.address, slot.spec.cls.requires)
        return LeaveRefused(reason) if reason else Admitted()

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
