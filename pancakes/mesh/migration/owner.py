"""The hand-off's core, seen from the agent that a task lives on: birth, start, end, checkpoints, packets."""

from __future__ import annotations

from msgspec.structs import replace

from pancakes.mesh.migration.effect import (
    Ack,
    AttemptFailed,
    Decline,
    Deliver,
    Discard,
    Effect,
    Forward,
    GiveWay,
    Persist,
    Remember,
    StartTask,
)
from pancakes.mesh.migration.epoch import MORE_THAN_MOVES, Epoch
from pancakes.mesh.migration.event import (
    AdoptionAsked,
    Born,
    Checkpoint,
    ClaimHeard,
    Ended,
    ForgettingAsked,
    RunAsked,
    WriteAgain,
)
from pancakes.mesh.migration.guarded_task import first_guards
from pancakes.mesh.migration.record import Phase, Record, Wanted
from pancakes.mesh.migration.volatile import Volatile


def born(me: str, record: Record, event: Born) -> list[Effect]:
    """Makes this agent the owner of a task that never ran before, or was removed."""
    if not record.may_begin:
        return [_decline(record)]
    if record.task_id.birthplace != me:
        return [Decline(f"{record.task_id} can be born on {record.task_id.birthplace} alone, this is {me}")]
    # An actuator that has obeyed the task which was removed obeys no lower epoch.
    epoch = Epoch(record.seen.n + 1 if record.removed else 0, me)
    own = Record(
        record.task_id, Phase.OWNER, epoch, epoch, snapshot=event.snapshot, guards=first_guards(epoch, event.guardian)
    )
    return [Persist(own), *_run(own)]


def start(me: str, record: Record, volatile: Volatile, event: RunAsked) -> list[Effect]:
    """Starts a task that this agent owns; refuses where it does not."""
    if record.phase is not Phase.OWNER:
        return [_decline(record)]
    if volatile.running and not event.again:
        return [Decline(f"{record.task_id} runs already")]
    if disputed := _disputed(record, volatile):
        return [Decline(dispute_of(me, disputed))]
    if event.again and record.wanted is not Wanted.RUNNING:
        return [Decline(f"{record.task_id} is not restarted, it is to be {record.wanted.value}")]
    own = replace(record, wanted=Wanted.RUNNING, incarnation=record.incarnation + 1)
    return [
        # Until the record is on disk nothing runs, also where the write fails.
        Remember(Volatile()),
        *_broken_off(volatile, "the task failed and was started again"),
        Persist(own),
        *_run(own),
    ]


def ended(record: Record, volatile: Volatile, event: Ended) -> list[Effect]:
    """Writes down that the task shall not run, so that this outlives a reboot."""
    if record.phase is not Phase.OWNER:
        return [_decline(record)]
    disputed = _disputed(record, volatile)
    end = replace(disputed or replace(record, wanted=event.wanted), snapshot=event.snapshot or record.snapshot)
    reason = f"the task was {'stopped' if event.wanted is Wanted.STOPPED else 'given up by its service'}"
    return [Remember(Volatile()), *_broken_off(volatile, reason), Persist(end)]


def write_again(record: Record, volatile: Volatile, event: WriteAgain) -> list[Effect]:
    """Writes down what failed to be written, and goes on from there, unless something else was decided since."""
    if record != event.old or volatile.running or volatile.again != event.record:
        return []
    return [Remember(Volatile()), Persist(event.record), *recover(event.record)]


def claimed(me: str, record: Record, volatile: Volatile, event: ClaimHeard) -> list[Effect]:
    """Stands still where another agent owns the task under an epoch that is not lower.

    No hand-off makes two owners, and each gives its owner a higher epoch than all before: so the other has it from a
    restored disk, or by a person's word. Of two under one epoch neither knows whether it is the copy: both stand still.
    """
    if record.phase is not Phase.OWNER or event.epoch < record.epoch:
        return []
    if is_disputed(record):
        if event.epoch <= record.seen:
            return []
        return [Persist(replace(record, peer=event.peer, seen=event.epoch))]  # an adoption here must be higher
    own = replace(record, wanted=Wanted.DISPUTED, peer=event.peer, seen=max(record.seen, event.epoch))
    reason = dispute_of(me, own)
    return [
        Remember(Volatile(again=own)),  # no start is given leave from now on
        *_broken_off(volatile, reason),
        GiveWay(reason),
        Persist(own),
        Remember(Volatile()),
    ]


def checkpoint(record: Record, volatile: Volatile, event: Checkpoint) -> list[Effect]:
    """Writes the task down, and only then acknowledges what it has consumed.

    A packet that comes twice takes the same way (its number in `consumed`, no effect): that it lies in the
    duplicate filter of the task that runs does not mean that it lies in the one on disk.
    A checkpoint of a former epoch or incarnation is not taken: the packets that it consumed come again.
    """
    current = record.epoch == event.epoch and record.incarnation == event.incarnation
    if record.phase is not Phase.OWNER or not volatile.running or not current:
        return []
    return [Persist(replace(record, snapshot=event.snapshot)), *(Ack(packet) for packet in event.consumed)]


def arrived(record: Record, volatile: Volatile) -> list[Effect]:
    """Says what becomes of a packet for the task: here, on to its new host, or kept by its sender."""
    if record.phase is Phase.OWNER and volatile.running and not volatile.freezing:
        return [Deliver()]
    if record.phase in (Phase.RELEASED, Phase.ABSENT) and record.peer:
        return [Forward(record.peer, record.seen)]
    # Stopped or undecided: the sender keeps the packet, for want of an acknowledgement, and sends it again.
    return []


def adopt(me: str, record: Record, event: AdoptionAsked) -> list[Effect]:
    """Takes a task that is in doubt or disputed, or whose record was lost, under a new epoch, on a person's word."""
    if not _may_be_adopted(record, event):
        return [Decline(f"{record.task_id} is {record.phase.value} here: there is nothing to adopt")]
    # Agents that took a guarded task over have minted epochs of which none is known here.
    jump = event.jump if event.guardian is None else max(event.jump, MORE_THAN_MOVES)
    epoch = Epoch(max(record.seen.n, event.seen) + jump, me)
    snapshot, guards = event.snapshot or record.snapshot, first_guards(epoch, event.guardian)
    own = Record(record.task_id, Phase.OWNER, epoch, epoch, snapshot=snapshot, guards=guards)
    return [Persist(own), *_run(own)]


def forget(me: str, record: Record, volatile: Volatile, event: ForgettingAsked) -> list[Effect]:
    """Writes down that a task is not here: it is not born here again, and what was here of a disputed one is gone."""
    seen = max(record.seen, event.seen, Epoch(0, me))
    if event.owner and record.phase is Phase.OWNER and record.wanted is not Wanted.RUNNING and not volatile.running:
        tombstone = Record(record.task_id, Phase.RELEASED, record.epoch, seen, peer=event.owner)
        return [Remember(Volatile()), Persist(tombstone), Discard()]
    if record.phase is Phase.PREPARED and record.offer == event.offer:  # and no later one, that is on its way
        return [Remember(Volatile()), Persist(Record(record.task_id, seen=max(seen, record.offer))), Discard()]
    if record.phase is not Phase.ABSENT:
        return [Decline(f"{record.task_id} is {record.phase.value} here: there is nothing to forget")]
    return [Remember(Volatile()), Persist(Record(record.task_id, seen=seen))]


def remove(me: str, record: Record, volatile: Volatile) -> list[Effect]:
    """Writes down that a task is nowhere from now on; what was here of it is gone."""
    if record.phase is not Phase.OWNER or is_disputed(record):
        return [Decline(dispute_of(me, record)) if is_disputed(record) else _decline(record)]
    if record.wanted is Wanted.RUNNING or volatile.running:
        return [Decline(f"{record.task_id} was started since")]
    if others := sorted({one.agent for one in record.guards.members()} - {me}):
        return [Decline(f"{record.task_id} is guarded by {', '.join(others)} still")]
    seen = max(record.seen, record.epoch)
    tombstone = Record(record.task_id, Phase.RELEASED, record.epoch, seen, wanted=Wanted.REMOVED)
    return [Remember(Volatile()), Persist(tombstone), Discard()]


def is_disputed(record: Record) -> bool:
    """Returns whether the task rests here because another agent owns it too."""
    return record.phase is Phase.OWNER and record.wanted is Wanted.DISPUTED


def dispute_of(me: str, record: Record) -> str:
    """Returns why a disputed task rests, and what a person can do, as a sentence."""
    return (
        f"{record.task_id} is owned by {record.peer} too: it rests on {me} (epoch {record.epoch}) until you decide with"
        f" `pancakes task resolve AGENT/{record.task_id.name}` which of the two lives"
    )


def recover(record: Record) -> list[Effect]:
    """Returns what to do about an owned task after a restart of the agent: run it from its checkpoint."""
    return _run(record) if record.wanted is Wanted.RUNNING else []


def _run(own: Record) -> list[Effect]:
    return [Remember(Volatile(running=True)), StartTask(own.epoch, own.incarnation, own.snapshot)]


def _may_be_adopted(record: Record, event: AdoptionAsked) -> bool:
    if event.snapshot:  # what follows a hand-over, and is still to be done, must not be lost with its tombstone
        return record.phase is Phase.ABSENT or (record.phase is Phase.RELEASED and not record.sequel)
    return record.phase in (Phase.COMMITTED, Phase.PREPARED) or is_disputed(record)


def _broken_off(volatile: Volatile, reason: str) -> list[Effect]:
    """Returns the news that a hand-off under way has come to nothing, if there was one."""
    return [AttemptFailed(volatile.asked, reason)] if volatile.asked else []


def _disputed(record: Record, volatile: Volatile) -> Record | None:
    """Returns the record that says that the task is disputed, also where it could not be written yet; None: none."""
    return next((it for it in (record, volatile.again) if it is not None and is_disputed(it)), None)


def _decline(record: Record) -> Decline:
    """Returns why this agent may not start or stop the task."""
    task_id, peer = record.task_id, record.peer
    match record.phase:
        case Phase.OWNER:
            return Decline(f"{task_id} is here already")
        case Phase.FROZEN:
            return Decline(f"{task_id} is being handed over to {peer}")
        case Phase.COMMITTED:
            return Decline(f"{task_id} was given to {peer}, which has not yet said that it has it")
        case Phase.PREPARED:
            return Decline(f"{task_id} is on its way here from {peer}, which has not yet given it away")
        case Phase.RELEASED if record.removed:
            return Decline(f"{task_id} was removed")
        case Phase.RELEASED:
            return Decline(f"{task_id} moved to {peer}")
        case _:
            if peer:
                return Decline(f"{task_id} is not here, {peer} had it last")
            return Decline(f"{task_id} is not here: it was forgotten; `pancakes task adopt` runs it here all the same")
