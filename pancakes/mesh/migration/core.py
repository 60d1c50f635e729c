"""The hand-off's core: one pure function for everything that can happen to one task on one agent.

`handle` reads no clock, draws no random numbers and touches nothing: an event goes in, effects come out.
The same function runs in every agent and in the exhaustive search of `tests/migration`, which lets every
message be lost, doubled, reordered and delayed, and crashes every agent between any two effects.

What it promises: at any moment at most one copy of a task runs; once the network heals and agents come
back, exactly one does; no acknowledged packet is lost or takes effect twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from msgspec.structs import replace

from pancakes.mesh.migration import candidate, guarded_task, owner, source
from pancakes.mesh.migration.effect import After, AttemptFailed, Effect, Persist, Remember, Resume, Warn
from pancakes.mesh.migration.event import (
    AdoptionAsked,
    Arrived,
    Award,
    Born,
    Checkpoint,
    ClaimHeard,
    Concluded,
    Ended,
    Event,
    ForgettingAsked,
    FreezeFailed,
    Frozen,
    GiveUp,
    GuardsChosen,
    InDoubt,
    PermitGiven,
    PersistFailed,
    Received,
    RemovalAsked,
    Resend,
    ReservationExpired,
    RunAsked,
    Seized,
    WriteAgain,
)
from pancakes.mesh.migration.messages import (
    Abort,
    Activated,
    Commit,
    Nak,
    Prepared,
    Reserve,
    Reserved,
    Transfer,
    Unknown,
)
from pancakes.mesh.migration.record import Phase, Record
from pancakes.mesh.migration.times import Times
from pancakes.mesh.migration.volatile import Volatile

TIMES: Final = Times()
"""The durations that PROTOCOL names."""


def handle(
    me: str, record: Record, volatile: Volatile, event: Event, permit: bool = True, times: Times = TIMES
) -> list[Effect]:
    """Decides what one event means for one task.

    Args:
        me: this agent's name.
        record: the task's durable record here; `Record(task_id)` where there is none.
        volatile: what is known until the next crash.
        event: what has happened.
        permit: of a guarded task: whether its guardians let it act now.
        times: how long things may take.

    Returns:
        What to do, strictly in this order; empty where nothing follows.
    """
    return guarded_task.gated(record, _decide(me, record, volatile, event, times, permit), permit)


def _decide(me: str, record: Record, volatile: Volatile, event: Event, times: Times, permit: bool) -> Sequence[Effect]:
    match event:
        case Received():
            return _received(me, record, volatile, event, times)
        case Resend():
            return _resend(record, event, times)
        case Checkpoint():
            return owner.checkpoint(record, volatile, event)
        case Arrived():
            return owner.arrived(record, volatile)
        case Award():
            return source.awarded(me, record, volatile, event, times)
        case ReservationExpired():
            return source.reservation_expired(me, record, volatile, event)
        case Frozen():
            return source.frozen(me, record, volatile, event, times)
        case FreezeFailed():
            return source.freeze_failed(me, record, volatile, event)
        case GiveUp():
            return source.give_up(record, event)
        case InDoubt():
            return _in_doubt(record, event)
        case Born():
            return owner.born(me, record, event)
        case RunAsked():
            return owner.start(me, record, volatile, event)
        case Ended():
            return owner.ended(record, volatile, event)
        case Concluded():
            return source.concluded(record)
        case AdoptionAsked():
            return owner.adopt(me, record, event)
        case ForgettingAsked():
            return owner.forget(me, record, volatile, event)
        case RemovalAsked():
            return owner.remove(me, record, volatile)
        case ClaimHeard() if record.phase is Phase.PREPARED:
            return candidate.overtaken(record, event)
        case ClaimHeard():
            by_person = event.peer and guarded_task.is_by_person(record, event.epoch)
            if record.guarded and not by_person and (event.epoch != record.epoch or not event.peer):
                return guarded_task.claimed(record, volatile, event, permit)
            return owner.claimed(me, record, volatile, event)
        case PermitGiven():
            return guarded_task.permit_given(record, volatile)
        case GuardsChosen():
            return guarded_task.guards_chosen(me, record, event)
        case Seized():
            return guarded_task.seized(me, record, volatile, event)
        case PersistFailed():
            return _persist_failed(record, volatile, event, times)
        case WriteAgain():
            return owner.write_again(record, volatile, event)


def recover(record: Record, times: Times = TIMES) -> list[Effect]:
    """Decides what to do about a task after a restart of the agent, its record read back from disk.

    A guarded task waits for its guardians: what they have granted before is not known any more.
    """
    return guarded_task.gated(record, _recover(record, times), permit=False)


def _recover(record: Record, times: Times) -> list[Effect]:
    match record.phase:
        case Phase.OWNER:
            return owner.recover(record)
        case Phase.FROZEN:
            # Presumed abort: no candidate can have got a COMMIT.
            back = source.taken_back(record)
            return [Persist(back), *owner.recover(back)]
        case Phase.COMMITTED:
            return source.recover(record, times)
        case Phase.PREPARED:
            return candidate.recover(record, times)
        case Phase.RELEASED:
            return source.remind(record)
        case _:
            return []


def _received(me: str, record: Record, volatile: Volatile, event: Received, times: Times) -> list[Effect]:
    peer, message = event.peer, event.message
    match message:
        case Reserve():
            return candidate.reserve(record, event, message)
        case Transfer():
            return candidate.transfer(record, event, message, times)
        case Commit():
            return candidate.commit(record, event, message)
        case Abort():
            return candidate.abort(record, event, message)
        case Reserved():
            return source.reserved(me, record, volatile, peer, message)
        case Nak():
            return source.nak(me, record, volatile, peer, message)
        case Prepared():
            return source.prepared(me, record, peer, message, times)
        case Activated():
            return source.activated(record, peer, message)
        case Unknown():
            return source.unknown(record, peer, message)
        case _:
            # MOVED is news for the senders of packets to the task; it changes no agent's right to run it.
            return []


def _resend(record: Record, event: Resend, times: Times) -> list[Effect]:
    if (record.phase, record.offer) != (event.phase, event.offer):
        return []
    half = candidate.resend if record.phase is Phase.PREPARED else source.resend
    return half(record, event, times)


def _in_doubt(record: Record, event: InDoubt) -> list[Effect]:
    if (record.phase, record.offer) != (event.phase, event.offer):
        return []
    if record.phase is Phase.PREPARED:
        story = f"is here, at rest, and {record.peer} does not say whether it was given away"
    else:
        story = f"was given to {record.peer}, which does not say that it has it"
    return [Warn(f"{record.task_id} {story} (offer {record.offer}): the hand-off goes on by itself once it answers")]


def _persist_failed(record: Record, volatile: Volatile, event: PersistFailed, times: Times) -> list[Effect]:
    """Goes on after a write that failed.

    The disk may hold the old record or the new one; `record` is the old one. Nothing that was to follow has
    happened, in particular no message was sent. Both are as safe as a crash just before, or just after. The journal's
    store tells people.
    """
    if record.phase is Phase.OWNER and volatile.freezing:
        return [
            Remember(Volatile(running=True)),
            Resume(record.epoch, record.incarnation, record.snapshot),
            AttemptFailed(volatile.asked, event.reason),
        ]
    again = _again(record, volatile, event)
    if isinstance(again, WriteAgain):
        return [Remember(replace(volatile, again=again.record)), After(times.retry_write_s, again)]
    return [After(times.retry_write_s, again)] if again is not None else []


def _again(record: Record, volatile: Volatile, event: PersistFailed) -> Event | None:
    """Returns what to try again by itself; in the other phases the other side's next message does it."""
    if record.phase is Phase.FROZEN:
        return GiveUp(record.offer, event.reason)
    # Of an adoption the person may have learnt better meanwhile.
    adopted = record.phase is Phase.OWNER and event.record.epoch != record.epoch
    ours = (record.phase in (Phase.ABSENT, Phase.OWNER) or record.removed) and event.record.phase is Phase.OWNER
    if ours and not adopted and not volatile.running:
        return WriteAgain(record, event.record)
    return None
