"""The hand-off's core, seen from the agent that gives a task away (PROTOCOL: migration, source)."""

from __future__ import annotations

from msgspec.structs import replace

from pancakes.mesh.migration.effect import (
    After,
    AttemptFailed,
    Decline,
    Discard,
    Effect,
    Freeze,
    HandedOver,
    Persist,
    Remember,
    Resume,
    Send,
    Warn,
)
from pancakes.mesh.migration.epoch import NO_EPOCH, Epoch
from pancakes.mesh.migration.event import Award, FreezeFailed, Frozen, GiveUp, InDoubt, Resend, ReservationExpired
from pancakes.mesh.migration.guards import NO_GUARDS
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


def next_offer(me: str, record: Record) -> Epoch:
    """Returns the epoch that the owner offers next."""
    return Epoch(record.seen.n + 1, me)


def awarded(me: str, record: Record, volatile: Volatile, event: Award, times: Times) -> list[Effect]:
    """Asks the winner for a reservation. The task runs on."""
    if record.phase is not Phase.OWNER or not volatile.running:
        return [Decline(f"{record.task_id} does not run here, so it cannot be given away")]
    if volatile.asked:
        return [Decline(f"{record.task_id} is already being handed over to {volatile.asked}")]
    offer = next_offer(me, record)
    return [
        Remember(Volatile(running=True, asked=event.peer)),
        Send(event.peer, Reserve(record.task_id, offer, event.request)),
        After(times.reserve_s, ReservationExpired(event.peer, offer)),
    ]


def reservation_expired(me: str, record: Record, volatile: Volatile, event: ReservationExpired) -> list[Effect]:
    """Gives a silent winner up; the next bidder's turn."""
    if not _waits_for(me, record, volatile, event.peer, event.offer):
        return []
    return [Remember(Volatile(running=True)), AttemptFailed(event.peer, "did not answer the reservation in time")]


def reserved(me: str, record: Record, volatile: Volatile, peer: str, message: Reserved) -> list[Effect]:
    """Stops the task: the winner keeps a slot for it."""
    if not _waits_for(me, record, volatile, peer, message.offer):
        return []
    return [Remember(Volatile(running=True, asked=peer, freezing=True)), Freeze(message.offer)]


def frozen(me: str, record: Record, volatile: Volatile, event: Frozen, times: Times) -> list[Effect]:
    """Writes the stopped task down and sends it. From here on it may be on disk in two places, at rest in both."""
    if record.phase is not Phase.OWNER or not volatile.freezing or event.offer != next_offer(me, record):
        return []
    record = replace(
        record,
        phase=Phase.FROZEN,
        seen=event.offer,
        offer=event.offer,
        peer=volatile.asked,
        snapshot=event.snapshot,
        sequel=event.sequel,
    )
    wait_s = times.prepare_s + times.transfer_s(len(event.snapshot))
    give_up = GiveUp(event.offer, f"did not say within {wait_s:.1f} s that it has the snapshot")
    return [Persist(record), Remember(Volatile()), *_transfer(record, 0, times), After(wait_s, give_up)]


def freeze_failed(me: str, record: Record, volatile: Volatile, event: FreezeFailed) -> list[Effect]:
    """Leaves the task where it is: it could not be stopped."""
    if record.phase is not Phase.OWNER or not volatile.freezing or event.offer != next_offer(me, record):
        return []
    return [
        Remember(Volatile(running=True)),
        AttemptFailed(volatile.asked, f"the task could not be stopped for it: {event.reason}"),
    ]


def nak(me: str, record: Record, volatile: Volatile, peer: str, message: Nak) -> list[Effect]:
    """Takes a refusal, as long as nothing is committed. A late one changes nothing."""
    if record.phase is Phase.FROZEN and (record.peer, record.offer) == (peer, message.offer):
        return _abort(record, message.reason)
    if _waits_for(me, record, volatile, peer, message.offer):
        return [Remember(Volatile(running=True)), AttemptFailed(peer, message.reason)]
    return []


def give_up(record: Record, event: GiveUp) -> list[Effect]:
    """Takes the task back, as long as nothing is committed."""
    if record.phase is not Phase.FROZEN or record.offer != event.offer:
        return []
    return _abort(record, event.reason)


def prepared(me: str, record: Record, peer: str, message: Prepared, times: Times) -> list[Effect]:
    """Commits: the destination has the snapshot on its disk."""
    if message.offer.minter != me:
        return []
    if (record.peer, record.offer) == (peer, message.offer):
        if record.phase is Phase.FROZEN:
            record = replace(record, phase=Phase.COMMITTED)
            return [
                # The point of no return.
                Persist(record),
                Discard(),
                *_commit(record, 0, times),
                After(times.warn_s, InDoubt(record.offer, Phase.COMMITTED)),
            ]
        if record.phase is Phase.COMMITTED:
            return [Send(peer, _commit_of(record))]
    if record.seen >= message.offer:
        # We remember being past it, so it was never committed to them, or they have had their answer.
        return [Send(peer, Abort(record.task_id, message.offer))]
    return [
        Send(peer, Unknown(record.task_id, message.offer)),
        Warn(f"{peer} holds {record.task_id} under the offer {message.offer} of ours, which our disk has lost"),
    ]


def activated(record: Record, peer: str, message: Activated) -> list[Effect]:
    """Turns the record into a tombstone: the destination owns the task."""
    if record.phase is not Phase.COMMITTED or (record.peer, record.offer) != (peer, message.offer):
        return []
    return [Persist(tombstone_of(record)), HandedOver(peer, message.offer)]


def tombstone_of(record: Record) -> Record:
    """Returns what is left here of a task that another agent owns."""
    return replace(record, phase=Phase.RELEASED, offer=NO_EPOCH, snapshot=b"", guards=NO_GUARDS, no=0)


def concluded(record: Record) -> list[Effect]:
    """Forgets what was to follow the hand-over: it has been done."""
    if record.phase is not Phase.RELEASED or not record.sequel:
        return []
    return [Persist(replace(record, sequel=b""))]


def unknown(record: Record, peer: str, message: Unknown) -> list[Effect]:
    """Tells people that the other side has lost its disk. Nothing here can undo that."""
    if (record.peer, record.offer) != (peer, message.offer) or record.phase not in (Phase.COMMITTED, Phase.PREPARED):
        return []
    return [
        Warn(
            f"{peer} has lost its disk during the hand-off {message.offer} of {record.task_id}:"
            f" if the task runs nowhere, adopt it by force on the agent that holds it"
        )
    ]


def resend(record: Record, event: Resend, times: Times) -> list[Effect]:
    """Says again what was said, for it may be lost."""
    if record.phase is Phase.FROZEN:
        return _transfer(record, event.attempt + 1, times)
    return _commit(record, event.attempt + 1, times)


def remind(record: Record) -> list[Effect]:
    """Returns what to do about a tombstone after a restart of the agent: what was to follow may not have been done."""
    return [HandedOver(record.peer, record.seen)] if record.sequel else []


def recover(record: Record, times: Times) -> list[Effect]:
    """Returns what to do about a COMMITTED record after a restart of the agent: it stays in doubt and asks."""
    return [*_commit(record, 0, times), After(times.warn_s, InDoubt(record.offer, Phase.COMMITTED))]


def taken_back(record: Record) -> Record:
    """Returns the record of a FROZEN task that stays here after all; `seen` keeps the offer from being reused."""
    return replace(record, phase=Phase.OWNER, offer=NO_EPOCH, peer="", sequel=b"")


def _waits_for(me: str, record: Record, volatile: Volatile, peer: str, offer: Epoch) -> bool:
    """Returns whether `peer` was asked for a reservation of `offer`, and nothing has come of that yet."""
    owned = record.phase is Phase.OWNER and volatile.running and not volatile.freezing
    return owned and volatile.asked == peer and offer == next_offer(me, record)


def _transfer(record: Record, attempt: int, times: Times) -> list[Effect]:
    # A large snapshot gets the time that it needs, before it is sent all over again.
    pause_s = times.resend_s + times.transfer_s(len(record.snapshot))
    return [
        Send(record.peer, Transfer(record.task_id, record.offer, record.snapshot)),
        After(pause_s, Resend(record.offer, Phase.FROZEN, attempt), times.spread),
    ]


def _commit(record: Record, attempt: int, times: Times) -> list[Effect]:
    return [
        Send(record.peer, _commit_of(record)),
        After(times.pause_s(attempt), Resend(record.offer, Phase.COMMITTED, attempt), times.spread),
    ]


def _commit_of(record: Record) -> Commit:
    if not record.guarded:
        return Commit(record.task_id, record.offer)
    return Commit(record.task_id, record.offer, record.guards, record.epoch, record.no)


def _abort(record: Record, reason: str) -> list[Effect]:
    back = taken_back(record)
    return [
        Persist(back),
        Remember(Volatile(running=True)),
        Resume(back.epoch, back.incarnation, back.snapshot),
        Send(record.peer, Abort(record.task_id, record.offer)),
        AttemptFailed(record.peer, reason),
    ]
