"""The hand-off's core, as far as a guarded task differs: its guardians decide which agent may run it. Pure.

Its owner acts only while more than half of the guardians have granted it a lease; so where another agent owns the task
under a later epoch, the guardians have decided that, and nothing is left to dispute (docs/protocol.md, guardians).
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from pancakes.mesh.migration.effect import (
    AttemptFailed,
    Discard,
    Effect,
    HandedOver,
    Persist,
    Remember,
    Send,
    StartTask,
)
from pancakes.mesh.migration.epoch import MORE_THAN_MOVES, Epoch
from pancakes.mesh.migration.event import ClaimHeard, GuardsChosen, Seized
from pancakes.mesh.migration.guards import NO_GUARDS, GuardianId, Guards
from pancakes.mesh.migration.messages import Activated
from pancakes.mesh.migration.record import Phase, Record, Wanted
from pancakes.mesh.migration.source import tombstone_of
from pancakes.mesh.migration.volatile import Volatile


def first_guards(epoch: Epoch, guardian: GuardianId | None) -> Guards:
    """Returns the guardians of a task that begins under an epoch: this agent alone, until others are chosen."""
    return Guards(epoch, 0, ((guardian,),)) if guardian is not None else NO_GUARDS


def gated(record: Record, effects: Sequence[Effect], permit: bool) -> list[Effect]:
    """Returns the effects as they are for a guarded task: checkpoints are numbered, and without a permit none starts.

    A start that is left out here follows with `PermitGiven`.

    Args:
        record: the record before them.
        effects: what was decided.
        permit: whether the task may act now.
    """
    out: list[Effect] = []
    starts = any(isinstance(effect, StartTask) for effect in effects)
    for effect in effects:
        if isinstance(effect, Persist):
            record = _numbered(record, effect.record)
            out.append(Persist(record))
        elif not (record.guarded and starts and not permit):
            out.append(effect)
        elif isinstance(effect, Remember):
            out.append(Remember(replace(effect.volatile, running=False)))
        elif not isinstance(effect, StartTask):
            out.append(effect)
    return out


def _numbered(before: Record, record: Record) -> Record:
    if not record.guarded or before.epoch != record.epoch:
        return record
    alike = (before.snapshot, before.wanted) == (record.snapshot, record.wanted)
    return replace(record, no=before.no if alike else before.no + 1)


def is_checkpoint(before: Record, record: Record) -> bool:
    """Returns whether a record of a guarded task brings nothing but a newer checkpoint."""
    return (
        before.guarded and before.no != record.no and replace(before, snapshot=record.snapshot, no=record.no) == record
    )


def permit_given(record: Record, volatile: Volatile) -> list[Effect]:
    """Starts a task that has waited for its guardians."""
    waits = record.phase is Phase.OWNER and record.wanted is Wanted.RUNNING and volatile.again is None
    if not waits or volatile.running or not record.guarded:
        return []
    start = StartTask(record.epoch, record.incarnation, record.snapshot, fresh=volatile.fresh)
    return [Remember(Volatile(running=True)), start]


def guards_chosen(me: str, record: Record, event: GuardsChosen) -> list[Effect]:
    """Writes down the guardians; they are told with the next lease that the owner asks for."""
    if record.phase is not Phase.OWNER or (record.guards.sets == event.sets and not event.jump):
        return []
    if event.jump or (not record.guarded and record.epoch.minter != me):
        # A guardian believes only the agent that has minted an epoch.
        epoch = Epoch(max(record.seen.n, event.seen) + (event.jump or 1), me)
        return [Persist(replace(record, epoch=epoch, seen=epoch, guards=Guards(epoch, 0, event.sets)))]
    return [Persist(replace(record, guards=Guards(record.epoch, record.guards.version + 1, event.sets)))]


def seized(me: str, record: Record, volatile: Volatile, event: Seized) -> list[Effect]:
    """Becomes the owner by the word of the guardians: on disk first, then in deed, and then says so."""
    if event.epoch <= record.seen or event.epoch.minter != me or volatile.running or record.phase is Phase.FROZEN:
        return []
    given = (Phase.PREPARED, event.source, event.offer)
    if event.source and (record.phase, record.peer, record.offer) != given:
        return []
    own = Record(
        record.task_id,
        Phase.OWNER,
        event.epoch,
        event.epoch,
        wanted=event.wanted,
        snapshot=event.snapshot,
        guards=Guards(event.epoch, 0, event.guards.sets),
    )
    effects: list[Effect] = [Persist(own)]
    if record.phase is Phase.COMMITTED:
        effects.append(AttemptFailed(record.peer, f"its guardians gave it back to {me}"))
    if own.wanted is Wanted.RUNNING:
        effects.append(Remember(Volatile(running=True, fresh=bool(event.source))))
        effects.append(StartTask(own.epoch, own.incarnation, own.snapshot, fresh=bool(event.source)))
    if event.source:
        effects.append(Send(event.source, Activated(record.task_id, event.offer)))
    return effects


def is_by_person(record: Record, epoch: Epoch) -> bool:
    """Returns whether another owner's epoch comes of a person's decision that the owner of this record is lost.

    Nothing else raises an epoch so far at once, and this owner's own may have been raised by moves since. The guardians
    were not asked, so it is as with a task without any.
    """
    return record.phase is Phase.OWNER and epoch.n - record.epoch.n >= MORE_THAN_MOVES // 2


def claimed(record: Record, volatile: Volatile, event: ClaimHeard, permit: bool) -> list[Effect]:
    """Gives the task up where another agent owns it under a later epoch, unless the guardians stand by this one."""
    if record.phase is Phase.COMMITTED and event.epoch > record.offer:
        tombstone = replace(tombstone_of(record), peer=event.peer, seen=event.epoch)
        return [Persist(tombstone), HandedOver(event.peer, event.epoch)]
    if record.phase is not Phase.OWNER or permit or event.epoch <= record.epoch:
        return []
    seen = max(record.seen, event.epoch)
    failed = [AttemptFailed(volatile.asked, f"{event.peer} owns the task")] if volatile.asked else []
    tombstone = replace(tombstone_of(record), peer=event.peer, seen=seen)
    return [Remember(Volatile()), *failed, Persist(tombstone), Discard()]
