"""The hand-off's core, seen from the agent that takes a task (PROTOCOL: migration, destination)."""

from __future__ import annotations

from msgspec.structs import replace

from pancakes.mesh.migration.effect import (
    After,
    Discard,
    Effect,
    LookForOwner,
    Persist,
    Remember,
    Seize,
    Send,
    StartTask,
    Warn,
)
from pancakes.mesh.migration.epoch import NO_EPOCH, Epoch
from pancakes.mesh.migration.event import ClaimHeard, InDoubt, Received, Resend
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


def would_take(record: Record, offer: Epoch) -> bool:
    """Returns whether a TRANSFER under `offer` would be news, so that building its object makes sense."""
    return record.phase in (Phase.ABSENT, Phase.RELEASED, Phase.PREPARED) and offer > record.seen


def reserve(record: Record, event: Received, message: Reserve) -> list[Effect]:
    """Answers a reservation. The slot itself is kept by `slots.Slots`; no safety hangs on it."""
    if event.refusal:
        return [Send(event.peer, Nak(record.task_id, message.offer, event.refusal))]
    if record.phase in (Phase.ABSENT, Phase.RELEASED, Phase.PREPARED):
        return [Send(event.peer, Reserved(record.task_id, message.offer))]
    return [Send(event.peer, Nak(record.task_id, message.offer, f"the task is {record.phase.value} here"))]


def transfer(record: Record, event: Received, message: Transfer, times: Times) -> list[Effect]:
    """Puts a snapshot on disk, dormant."""
    if record.phase is Phase.PREPARED and message.offer == record.offer:
        return [Send(event.peer, Prepared(record.task_id, message.offer))]
    if not would_take(record, message.offer):
        return []
    # A higher offer than one that we hold proves that the older one was aborted.
    if event.refusal:
        return [Send(event.peer, Nak(record.task_id, message.offer, event.refusal))]
    record = Record(
        record.task_id,
        Phase.PREPARED,
        epoch=record.epoch,
        seen=message.offer,
        offer=message.offer,
        peer=event.peer,
        snapshot=message.snapshot,
    )
    return [Persist(record), Remember(Volatile()), *recover(record, times)]


def commit(record: Record, event: Received, message: Commit) -> list[Effect]:
    """Becomes the owner: on disk first, then in deed, and then says so."""
    answer = Send(event.peer, Activated(record.task_id, message.offer))
    if record.phase is Phase.PREPARED and record.offer == message.offer:
        if record.peer != event.peer:
            return []
        if message.guards.sets:
            return [Seize(event.peer, message)]  # the guardians decide; until then it stays as it is
        own = Record(record.task_id, Phase.OWNER, epoch=message.offer, seen=message.offer, snapshot=record.snapshot)
        return [
            Persist(own),
            Remember(Volatile(running=True)),
            StartTask(own.epoch, own.incarnation, own.snapshot, fresh=True),
            answer,
        ]
    if record.seen >= message.offer:
        # We ran it, and may have moved it on already.
        return [answer]
    return [
        Send(event.peer, Unknown(record.task_id, message.offer)),
        Warn(f"{event.peer} gave us {record.task_id} under the offer {message.offer}, which our disk has lost"),
    ]


def abort(record: Record, event: Received, message: Abort) -> list[Effect]:
    """Drops a dormant snapshot that its owner took back; remembers `seen`, and which agent has the task."""
    if record.phase is not Phase.PREPARED or (record.peer, record.offer) != (event.peer, message.offer):
        return []
    return [Persist(replace(record, phase=Phase.ABSENT, offer=NO_EPOCH, snapshot=b"")), Discard()]


def overtaken(record: Record, event: ClaimHeard) -> list[Effect]:
    """Drops a dormant snapshot where another agent owns the task under an epoch that is later than the offer.

    No agent ever runs the task under that offer then. A COMMIT that comes late is answered as if it had run here, so
    that the source lets go of the task too.
    """
    if event.epoch <= record.offer:
        return []
    dropped = replace(record, phase=Phase.ABSENT, seen=event.epoch, offer=NO_EPOCH, peer=event.peer, snapshot=b"")
    return [Persist(dropped), Discard()]


def resend(record: Record, event: Resend, times: Times) -> list[Effect]:
    """Asks the source again what has become of the task, which may be gone for good."""
    return [*_prepared(record, event.attempt + 1, times), LookForOwner()]


def recover(record: Record, times: Times) -> list[Effect]:
    """Returns what to do about a PREPARED record, when it is new and after a restart: stay dormant and ask.

    It never drops the snapshot by itself: the source may have committed.
    """
    return [*_prepared(record, 0, times), After(times.warn_s, InDoubt(record.offer, Phase.PREPARED))]


def _prepared(record: Record, attempt: int, times: Times) -> list[Effect]:
    return [
        Send(record.peer, Prepared(record.task_id, record.offer)),
        After(times.pause_s(attempt), Resend(record.offer, Phase.PREPARED, attempt), times.spread),
    ]
