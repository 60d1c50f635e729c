"""The hand-off's core: one pure function for everything that can happen to one task on one agent.

`handle` reads no clock, draws no random numbers and touches nothing: an event goes in, effects come out. The
exhaustive search in `trials/model` runs the same function. The search loses, doubles, reorders and delays messages,
and crashes agents between any two effects. Promises: at most one copy of a task runs at any moment; once the network
heals and the agents are back, exactly one does; no acknowledged packet is lost or takes effect twice.

The parts, in order: the source (gives a task away), the destination (takes it), guarded tasks (their guardians decide
who may run them), the owner (birth, start, stop, checkpoints, adoption), and the dispatch. docs/protocol.md has the
rules.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.durable.handoff_events import (
    Ack,
    AdoptionAsked,
    After,
    Arrived,
    AttemptFailed,
    Award,
    Born,
    Checkpoint,
    ClaimHeard,
    Concluded,
    Decline,
    Deliver,
    Discard,
    Effect,
    Ended,
    Event,
    ForgettingAsked,
    Forward,
    Freeze,
    FreezeFailed,
    Frozen,
    GiveUp,
    GiveWay,
    GuardsChosen,
    HandedOver,
    InDoubt,
    LookForOwner,
    PermitGiven,
    Persist,
    PersistFailed,
    Received,
    Remember,
    RemovalAsked,
    Resend,
    ReservationExpired,
    Resume,
    RunAsked,
    Seize,
    Seized,
    Send,
    StartTask,
    Times,
    Warn,
    WriteAgain,
)
from pancakes.durable.messages import Abort, Activated, Commit, Nak, Prepared, Reserve, Reserved, Transfer, Unknown
from pancakes.durable.record import (
    MORE_THAN_MOVES,
    NO_EPOCH,
    NO_GUARDS,
    Epoch,
    GuardianId,
    Guards,
    Phase,
    Record,
    Volatile,
    Wanted,
)
from pancakes.errors import RefusalCode


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
    return [
        Remember(Volatile(running=True)),
        AttemptFailed(event.peer, Refusal("unable", "did not answer the reservation in time")),
    ]


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
        AttemptFailed(volatile.asked, Refusal("failed", f"the task could not be stopped for it: {event.reason}")),
    ]


def nak(me: str, record: Record, volatile: Volatile, peer: str, message: Nak) -> list[Effect]:
    """Takes a refusal, as long as nothing is committed. A late one changes nothing."""
    if record.phase is Phase.FROZEN and (record.peer, record.offer) == (peer, message.offer):
        return _abort(record, message.refusal)
    if _waits_for(me, record, volatile, peer, message.offer):
        return [Remember(Volatile(running=True)), AttemptFailed(peer, message.refusal)]
    return []


def give_up(record: Record, event: GiveUp) -> list[Effect]:
    """Takes the task back, as long as nothing is committed."""
    if record.phase is not Phase.FROZEN or record.offer != event.offer:
        return []
    return _abort(record, Refusal("unable", event.reason))


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


def resend_source(record: Record, event: Resend, times: Times) -> list[Effect]:
    """Says again what was said, for it may be lost."""
    if record.phase is Phase.FROZEN:
        return _transfer(record, event.attempt + 1, times)
    return _commit(record, event.attempt + 1, times)


def remind(record: Record) -> list[Effect]:
    """Returns what to do about a tombstone after a restart of the agent: what was to follow may not have been done."""
    return [HandedOver(record.peer, record.seen)] if record.sequel else []


def recover_source(record: Record, times: Times) -> list[Effect]:
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


def _abort(record: Record, refusal: Refusal) -> list[Effect]:
    back = taken_back(record)
    return [
        Persist(back),
        Remember(Volatile(running=True)),
        Resume(back.epoch, back.incarnation, back.snapshot),
        Send(record.peer, Abort(record.task_id, record.offer)),
        AttemptFailed(record.peer, refusal),
    ]


def would_take(record: Record, offer: Epoch) -> bool:
    """Returns whether a TRANSFER under `offer` would be news, so that building its object makes sense."""
    return record.phase in (Phase.ABSENT, Phase.RELEASED, Phase.PREPARED) and offer > record.seen


def reserve(record: Record, event: Received, message: Reserve) -> list[Effect]:
    """Answers a reservation. The slot itself is kept by `slots.Slots`; no safety hangs on it."""
    if event.refusal:
        return [Send(event.peer, Nak(record.task_id, message.offer, event.refusal))]
    if record.phase in (Phase.ABSENT, Phase.RELEASED, Phase.PREPARED):
        return [Send(event.peer, Reserved(record.task_id, message.offer))]
    known = Refusal("conflict", f"the task is {record.phase.value} here")
    return [Send(event.peer, Nak(record.task_id, message.offer, known))]


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
    return [Persist(record), Remember(Volatile()), *recover_candidate(record, times)]


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


def resend_candidate(record: Record, event: Resend, times: Times) -> list[Effect]:
    """Asks the source again what has become of the task, which may be gone for good."""
    return [*_prepared(record, event.attempt + 1, times), LookForOwner()]


def recover_candidate(record: Record, times: Times) -> list[Effect]:
    """Returns what to do about a PREPARED record, when it is new and after a restart: stay dormant and ask.

    It never drops the snapshot by itself: the source may have committed.
    """
    return [*_prepared(record, 0, times), After(times.warn_s, InDoubt(record.offer, Phase.PREPARED))]


def _prepared(record: Record, attempt: int, times: Times) -> list[Effect]:
    return [
        Send(record.peer, Prepared(record.task_id, record.offer)),
        After(times.pause_s(attempt), Resend(record.offer, Phase.PREPARED, attempt), times.spread),
    ]


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
        effects.append(AttemptFailed(record.peer, Refusal("moved", f"its guardians gave it back to {me}")))
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


def claimed_guarded(record: Record, volatile: Volatile, event: ClaimHeard, permit: bool) -> list[Effect]:
    """Gives the task up where another agent owns it under a later epoch, unless the guardians stand by this one."""
    if record.phase is Phase.COMMITTED and event.epoch > record.offer:
        tombstone = replace(tombstone_of(record), peer=event.peer, seen=event.epoch)
        return [Persist(tombstone), HandedOver(event.peer, event.epoch)]
    if record.phase is not Phase.OWNER or permit or event.epoch <= record.epoch:
        return []
    seen = max(record.seen, event.epoch)
    failed = _broken_off(volatile, f"{event.peer} owns the task", "moved")
    tombstone = replace(tombstone_of(record), peer=event.peer, seen=seen)
    return [Remember(Volatile()), *failed, Persist(tombstone), Discard()]


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
    return [Remember(Volatile()), Persist(event.record), *recover_owner(event.record)]


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


def recover_owner(record: Record) -> list[Effect]:
    """Returns what to do about an owned task after a restart of the agent: run it from its checkpoint."""
    return _run(record) if record.wanted is Wanted.RUNNING else []


def _run(own: Record) -> list[Effect]:
    return [Remember(Volatile(running=True)), StartTask(own.epoch, own.incarnation, own.snapshot)]


def _may_be_adopted(record: Record, event: AdoptionAsked) -> bool:
    if event.snapshot:  # what follows a hand-over, and is still to be done, must not be lost with its tombstone
        return record.phase is Phase.ABSENT or (record.phase is Phase.RELEASED and not record.sequel)
    return record.phase in (Phase.COMMITTED, Phase.PREPARED) or is_disputed(record)


def _broken_off(volatile: Volatile, reason: str, code: RefusalCode = "conflict") -> list[Effect]:
    """Returns the news that a hand-off under way has come to nothing, if there was one."""
    return [AttemptFailed(volatile.asked, Refusal(code, reason))] if volatile.asked else []


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
    return gated(record, _decide(me, record, volatile, event, times, permit), permit)


def _decide(me: str, record: Record, volatile: Volatile, event: Event, times: Times, permit: bool) -> Sequence[Effect]:
    match event:
        case Received():
            return _received(me, record, volatile, event, times)
        case Resend():
            return _resend(record, event, times)
        case Checkpoint():
            return checkpoint(record, volatile, event)
        case Arrived():
            return arrived(record, volatile)
        case Award():
            return awarded(me, record, volatile, event, times)
        case ReservationExpired():
            return reservation_expired(me, record, volatile, event)
        case Frozen():
            return frozen(me, record, volatile, event, times)
        case FreezeFailed():
            return freeze_failed(me, record, volatile, event)
        case GiveUp():
            return give_up(record, event)
        case InDoubt():
            return _in_doubt(record, event)
        case Born():
            return born(me, record, event)
        case RunAsked():
            return start(me, record, volatile, event)
        case Ended():
            return ended(record, volatile, event)
        case Concluded():
            return concluded(record)
        case AdoptionAsked():
            return adopt(me, record, event)
        case ForgettingAsked():
            return forget(me, record, volatile, event)
        case RemovalAsked():
            return remove(me, record, volatile)
        case ClaimHeard() if record.phase is Phase.PREPARED:
            return overtaken(record, event)
        case ClaimHeard():
            by_person = event.peer and is_by_person(record, event.epoch)
            if record.guarded and not by_person and (event.epoch != record.epoch or not event.peer):
                return claimed_guarded(record, volatile, event, permit)
            return claimed(me, record, volatile, event)
        case PermitGiven():
            return permit_given(record, volatile)
        case GuardsChosen():
            return guards_chosen(me, record, event)
        case Seized():
            return seized(me, record, volatile, event)
        case PersistFailed():
            return _persist_failed(record, volatile, event, times)
        case WriteAgain():
            return write_again(record, volatile, event)


def recover(record: Record, times: Times = TIMES) -> list[Effect]:
    """Decides what to do about a task after a restart of the agent, its record read back from disk.

    A guarded task waits for its guardians: what they have granted before is not known any more.
    """
    return gated(record, _recover(record, times), permit=False)


def _recover(record: Record, times: Times) -> list[Effect]:
    match record.phase:
        case Phase.OWNER:
            return recover_owner(record)
        case Phase.FROZEN:
            # Presumed abort: no candidate can have got a COMMIT.
            back = taken_back(record)
            return [Persist(back), *recover_owner(back)]
        case Phase.COMMITTED:
            return recover_source(record, times)
        case Phase.PREPARED:
            return recover_candidate(record, times)
        case Phase.RELEASED:
            return remind(record)
        case _:
            return []


def _received(me: str, record: Record, volatile: Volatile, event: Received, times: Times) -> list[Effect]:
    peer, message = event.peer, event.message
    match message:
        case Reserve():
            return reserve(record, event, message)
        case Transfer():
            return transfer(record, event, message, times)
        case Commit():
            return commit(record, event, message)
        case Abort():
            return abort(record, event, message)
        case Reserved():
            return reserved(me, record, volatile, peer, message)
        case Nak():
            return nak(me, record, volatile, peer, message)
        case Prepared():
            return prepared(me, record, peer, message, times)
        case Activated():
            return activated(record, peer, message)
        case Unknown():
            return unknown(record, peer, message)
        case _:
            # MOVED is news for the senders of packets to the task; it changes no agent's right to run it.
            return []


def _resend(record: Record, event: Resend, times: Times) -> list[Effect]:
    if (record.phase, record.offer) != (event.phase, event.offer):
        return []
    half = resend_candidate if record.phase is Phase.PREPARED else resend_source
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
            AttemptFailed(volatile.asked, Refusal("failed", event.reason)),
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
