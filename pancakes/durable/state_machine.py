"""The state machine of a hosted task: joins its life (start, stop, restart) and its hand-off. Pure.

A life asks for permission to start, and the record of the task gives it. A hand-off starts, pauses and ends a task,
and the life of the task carries that out. The table `RULES` says what each effect of one half means for the other;
all other effects pass through unchanged.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, Final, get_args

import msgspec
from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.durable import handoff
from pancakes.durable import handoff_events as handoff_effect
from pancakes.durable import handoff_events as handoff_event
from pancakes.durable.handoff import dispute_of, is_disputed
from pancakes.durable.handoff_events import Effect, Event, Persist, StartTask
from pancakes.durable.record import Epoch, GuardianId, Phase, Record, Volatile, Wanted
from pancakes.supervision import lifecycle, lifecycle_table
from pancakes.supervision.lifecycle import ACTOR, CLOSES, UNDECIDED, Life, State
from pancakes.supervision.restart import Draw


class AskRoom(msgspec.Struct, frozen=True):
    """See whether it can run here now; to be answered, once, by `Room`.

    Attributes:
        keep: whether its actuators are to be kept for it from now on.
        again: whether it was running, and failed.
    """

    keep: bool
    again: bool


class OpenPlace(msgspec.Struct, frozen=True):
    """Open a place for it among the tasks; to be answered by `PlaceFree` or `NoPlace`.

    Attributes:
        start: what it is to be started from.
    """

    start: StartTask


class Prepare(msgspec.Struct, frozen=True):
    """Give its place what it begins with, and its actuators; to be answered by `Admitted` or `LeaveRefused`.

    Attributes:
        start: what it is to be started from.
    """

    start: StartTask


class Unreserve(msgspec.Struct, frozen=True):
    """Keep no actuators for it any longer; those that it holds it keeps."""


class Decided(msgspec.Struct, frozen=True):
    """Tell the requests that wait whether it starts.

    Attributes:
        reason: why it does not run; empty: it runs.
    """

    reason: str


class Lasts(msgspec.Struct, frozen=True):
    """Tell the requests that wait that all that was decided about it is on disk.

    Attributes:
        why_not: why it is not; empty: it is.
    """

    why_not: str = ""


class Rested(msgspec.Struct, frozen=True):
    """It has come to rest: where its service ends, the next task's turn has come."""


class TakeDown(msgspec.Struct, frozen=True):
    """It stands still: hold its actuators and write it down; to be answered by `Frozen` or `FreezeFailed`.

    Attributes:
        offer: the hand-off.
        carried: what it carries.
    """

    offer: Epoch
    carried: object


class LetGoOn(msgspec.Struct, frozen=True):
    """It stands still for a hand-off that was broken off: let it go on."""


class Drop(msgspec.Struct, frozen=True):
    """Forget what is owed for it and kept for it: it was given away, or never ran here.

    Attributes:
        ends: whether its actor is still to end; its actuators are taken from it at once.
    """

    ends: bool


class Vacate(msgspec.Struct, frozen=True):
    """Clear its place: it is elsewhere. Where others wait for the place, they are fed `PlaceFree`."""


Joined = lifecycle.AskLeave | lifecycle.Settle | lifecycle.WriteRest | handoff_effect.OfLife
"""Effects of the one half that mean something for the other: the machine has a rule for each."""

PassedOn = (
    lifecycle.Spawn
    | lifecycle.TellToEnd
    | lifecycle.Revoke
    | lifecycle.LetGo
    | lifecycle.TryAt
    | lifecycle.LookAgain
    | lifecycle.Settle
    | lifecycle.WriteRest
    | lifecycle.Answer
    | lifecycle.Tell
)
"""Effects of a life that the machine passes on."""

SlotEffect = AskRoom | Prepare | Rested | TakeDown | LetGoOn | Vacate | handoff_effect.Freeze
"""Effects that are carried out at the slot of a task."""

HostingEffect = (
    OpenPlace
    | Unreserve
    | Decided
    | Lasts
    | Drop
    | handoff_effect.Persist
    | handoff_effect.Resume
    | handoff_effect.HandedOver
    | handoff_effect.OfHost
)
"""Effects that a task without a slot may have too."""


class StartConfigured(msgspec.Struct, frozen=True):
    """Its service begins, and starts it, or takes up the hand-off that its record tells of.

    Attributes:
        fresh: whether it is to begin as the configuration says, whatever its record says.
    """

    fresh: bool = False


class StartWanted(msgspec.Struct, frozen=True):
    """It is to run because another task has left; where its actuators are not free yet, it waits for them."""


class TakeUp(msgspec.Struct, frozen=True):
    """Its service begins, and it has no place there: only its record is left."""


class Room(msgspec.Struct, frozen=True):
    """The answer to `AskRoom`.

    Attributes:
        asked: what this answers.
        reason: why it cannot run here now; empty: it can.
        for_good: whether to try again is no use.
        snapshot: what it is to begin with, encoded; empty: what its record says.
        guardian: of a guarded task: its first guardian, where it is born now.
    """

    asked: AskRoom
    reason: str = ""
    for_good: bool = False
    snapshot: bytes = b""
    guardian: GuardianId | None = None


class PlaceFree(msgspec.Struct, frozen=True):
    """There is a place for it now: it was opened, or the task that had it is gone."""


class NoPlace(msgspec.Struct, frozen=True):
    """No place can be opened for it.

    Attributes:
        reason: why, as a sentence.
    """

    reason: str


class CameToRest(msgspec.Struct, frozen=True):
    """The answer to `WriteRest`.

    Attributes:
        snapshot: what it carried at the end, encoded; empty: what its record says.
    """

    snapshot: bytes


class Persisted(msgspec.Struct, frozen=True):
    """The record is on disk for good."""


class NotPersisted(msgspec.Struct, frozen=True):
    """The record could not be written.

    Attributes:
        reason: why.
    """

    reason: str


class StoodStill(msgspec.Struct, frozen=True):
    """The answer of its actor to `Freeze`.

    Attributes:
        offer: the hand-off.
        carried: what it carries, for `TakeDown`; None: it cannot say, and goes on.
        reason: why it cannot.
    """

    offer: Epoch
    carried: object = None
    reason: str = ""


class StillOverdue(msgspec.Struct, frozen=True):
    """It should stand still by now.

    Attributes:
        offer: the hand-off.
    """

    offer: Epoch


class PartConcluded(msgspec.Struct, frozen=True):
    """One of the two things that follow its hand-over is done."""


HostingEvent = (
    StartConfigured
    | StartWanted
    | TakeUp
    | Room
    | PlaceFree
    | NoPlace
    | CameToRest
    | Persisted
    | NotPersisted
    | StoodStill
    | StillOverdue
    | PartConcluded
)


class Leave(Enum):
    """By what a start of a hosted task gets leave."""

    ENTRY = "entry"
    """By a new entry in its record, which says that it runs."""
    WANTED = "wanted"
    """By an entry, also where another task has its actuators just now: it follows once these are free."""
    AGAIN = "again"
    """By an entry that says that it runs again; the actor that ran before is gone."""
    RECOVERED = "recovered"
    """By its record as it was found on disk."""
    GRANTED = "granted"
    """It has leave: its record says that it runs."""


class Now(msgspec.Struct, frozen=True):
    """What a rule may ask besides how the task stands.

    Attributes:
        me: this agent's name.
        now_s: host time.
        draw: draws the length of a pause.
        closing: whether the task's service ends.
        permit: of a guarded task: whether its guardians let it act.
    """

    me: str
    now_s: float
    draw: Draw
    closing: bool
    permit: bool


class Standing(msgspec.Struct, frozen=True):
    """What is known of a task on this agent, and what is still to be carried out.

    Attributes:
        record: its durable record, as it is on disk.
        volatile: what is known until the next crash.
        trouble: why the record could not be written when that was tried last; empty where it could.
        events: those of its hand-off that wait until all effects of the one before are carried out.
        effects: those of its hand-off that are still to be carried out, in this order.
        waits: the effect that is being carried out and takes time; None: none.
        begins: whether its life has taken up the `StartTask` that `waits` is.
        leaving: whether it was given away, and its place is cleared once its actor has ended.
        unanswered: how often its actor was told to stand still, and has not answered.
        rests: whether its life waits until its rest is on disk.
        to_conclude: how much of what follows its hand-over is still to be done.
    """

    record: Record
    volatile: Volatile = Volatile()
    trouble: str = ""
    events: tuple[Event, ...] = ()
    effects: tuple[Effect, ...] = ()
    waits: Persist | StartTask | None = None
    begins: bool = False
    leaving: bool = False
    unanswered: int = 0
    rests: bool = False
    to_conclude: int = 0


def disputed_in(standing: Standing) -> Record | None:
    """Returns the record that says that another agent owns the task too, also where it is not on disk yet."""
    writing = standing.waits.record if isinstance(standing.waits, Persist) else None
    records = (standing.record, standing.volatile.again, writing)
    return next((record for record in records if record is not None and is_disputed(record)), None)


_LIFE_EVENTS: Final = frozenset(get_args(lifecycle.Event))
_HOSTING_EVENTS: Final = frozenset(get_args(HostingEvent))

AnyEvent = lifecycle.Event | handoff_event.Event | HostingEvent
AnyEffect = PassedOn | SlotEffect | HostingEffect


class HostingStep:
    """One step: what it has changed so far, and what is to be done.

    Args:
        life: the life of the task; None: it has no place here.
        standing: how it stands besides.
        at: the moment.

    Attributes:
        effects: what is to be done, in this order.
        why_not: why the record could not be written, where that is the event.
    """

    def __init__(self, life: Life | None, standing: Standing, at: Now) -> None:
        self.life = life
        self.standing = standing
        self.at = at
        self.effects: list[Any] = []
        self.why_not = ""
        self._lives: deque[tuple[lifecycle.Event, Leave]] = deque()
        self._living = False
        self.leave = Leave.ENTRY
        self.decided: handoff_event.Event | None = None

    def take(self, event: AnyEvent) -> None:
        """Takes the event of this step."""
        was_settled = settled(self.standing)
        if type(event) in _LIFE_EVENTS:
            self.live(event)  # type: ignore[arg-type]
        elif type(event) in _HOSTING_EVENTS:
            RULES[type(event)](self, event)
        else:
            self.feed(event)  # type: ignore[arg-type]
        self.go_on()
        if settled(self.standing):
            if self.standing.rests:
                self.change(rests=False)
                self.live(lifecycle.Written(self.why_not))
            if not was_settled:
                self.do(Lasts())
        if self.standing.leaving and self.life is not None and self.life.at_rest:
            self.change(leaving=False)
            self.do(Vacate())

    def do(self, effect: AnyEffect) -> None:
        """Has an effect carried out, after those before it."""
        self.effects.append(effect)

    def change(self, **changes: Any) -> None:
        """Changes how the task stands."""
        self.standing = replace(self.standing, **changes)

    def feed(self, event: handoff_event.Event) -> None:
        """Feeds an event to the hand-off, which takes it after those before it."""
        self.change(events=(*self.standing.events, event))

    def live(self, event: lifecycle.Event, leave: Leave = Leave.ENTRY) -> None:
        """Feeds an event to the life, which takes it after those before it.

        Args:
            event: the event.
            leave: by what a start that follows gets leave.
        """
        self._lives.append((event, leave))
        if self._living:
            return
        self._living = True
        while self._lives:
            event, self.leave = self._lives.popleft()
            assert self.life is not None
            self.life, effects = lifecycle_table.handle(self.life, event, self.at.now_s, self.at.draw)
            for effect in effects:
                self._carry(effect)
        self._living = False

    def refuse(self, reason: str) -> None:
        """Refuses the life the leave that it waits for, for good, unless that is about to happen."""
        self.unreserve()
        if not any(isinstance(event, lifecycle.LeaveRefused) for event, _ in self._lives):
            self.live(lifecycle.LeaveRefused(reason, for_good=True))

    def go_on(self) -> None:
        """Goes on with the hand-off, until one of its effects takes time."""
        while self.standing.waits is None:
            standing = self.standing
            if standing.effects:
                effect, *later = standing.effects
                self.change(effects=tuple(later))
                self._carry(effect)
            elif standing.events:
                self.decided, *waiting = standing.events
                effects = handoff.handle(self.at.me, standing.record, standing.volatile, self.decided, self.at.permit)
                self.change(events=tuple(waiting), effects=tuple(effects))
            else:
                break

    def _carry(self, effect: lifecycle.Effect | handoff_effect.Effect) -> None:
        if isinstance(effect, Joined):
            RULES[type(effect)](self, effect)
        elif not isinstance(effect, handoff_effect.OfPackets):
            self.do(effect)

    def done(self) -> None:
        """The start that the hand-off asked for is decided: it goes on."""
        self.change(waits=None, begins=False)
        self.unreserve()
        self.go_on()

    def unreserve(self) -> None:
        """Has no actuators kept for it any longer; those of one that is on its way here stay."""
        if self.standing.record.phase is not Phase.PREPARED:
            self.do(Unreserve())


Rule = Callable[[HostingStep, Any], None]


def idle(standing: Standing) -> bool:
    """Returns whether every event so far is dealt with and every effect carried out."""
    return standing.waits is None and not standing.effects and not standing.events


def settled(standing: Standing) -> bool:
    """Returns whether in addition all that was decided is on disk: nothing is left that could not be written."""
    return idle(standing) and standing.volatile.again is None


# What a life asks for ------------------------------------------------------------------------------------------


def _ask_leave(step: HostingStep, effect: lifecycle.AskLeave) -> None:
    leave, life = step.leave, step.life
    assert life is not None
    if leave is Leave.ENTRY and effect.again and life.asker is None:
        leave = Leave.AGAIN
    if leave is Leave.GRANTED:
        return
    if step.at.closing:
        step.live(lifecycle.LeaveRefused(CLOSES))
    elif (disputed := disputed_in(step.standing)) is not None:
        step.refuse(dispute_of(step.at.me, disputed))
    elif leave is Leave.RECOVERED:
        step.change(effects=(*step.standing.effects, *handoff.recover(step.standing.record)))
    elif leave is Leave.AGAIN:
        step.feed(handoff_event.RunAsked(again=True))
    else:
        born = step.standing.record.phase is Phase.ABSENT and life.asker is None
        # Of two tasks that are to start at once, the second is refused before its record says that it is wanted.
        step.do(AskRoom(keep=not born and leave is not Leave.WANTED, again=effect.again))


def _settle(step: HostingStep, effect: lifecycle.Settle) -> None:
    step.do(effect)
    life, standing = step.life, step.standing
    assert life is not None
    # One that waits for leave still may start, and one that was given away may be on its way back.
    if life.state is not State.ASKED and not standing.leaving:
        step.do(Decided(effect.reason))
    refused = life.state is State.REFUSED or (life.state is State.STOPPED and standing.begins)
    ended = handoff_event.Ended(Wanted.RUNNING if life.wanted else Wanted.STOPPED)
    known = settled(standing) and not standing.volatile.running and standing.record.wanted is ended.wanted
    kinds = handoff_event.Ended, handoff_event.RunAsked
    last_said = [later for later in standing.events if isinstance(later, kinds)][-1:]
    if refused and not known and ended not in last_said:
        # It does not run, and a start that is asked for may follow.
        step.feed(ended)
    if standing.begins:
        step.done()


def _write_rest(step: HostingStep, effect: lifecycle.WriteRest) -> None:
    if step.standing.leaving:
        # What is left of it here is its record.
        step.live(lifecycle.Written())
        step.do(Rested())
    else:
        step.do(effect)


# What its hand-off asks for ------------------------------------------------------------------------------------


def _remember(step: HostingStep, effect: handoff_effect.Remember) -> None:
    step.change(volatile=effect.volatile)


def _persist(step: HostingStep, effect: handoff_effect.Persist) -> None:
    step.change(waits=effect)
    step.do(effect)


def _start_task(step: HostingStep, effect: handoff_effect.StartTask) -> None:
    step.change(waits=effect)
    life = step.life
    if any(isinstance(event, handoff_event.Ended) for event in step.standing.events):
        step.change(waits=None)  # it was decided otherwise since
        if life is None or life.at_rest:
            step.do(Decided("it was stopped since"))
    elif life is None:
        step.do(OpenPlace(effect))
    elif life.state not in ACTOR:  # else it came back before the actor that was given away has ended
        step.change(begins=True, unanswered=0)
        if life.state not in UNDECIDED:
            step.live(lifecycle.StartAsked(), Leave.GRANTED)
        step.do(Prepare(effect))


def _freeze(step: HostingStep, effect: handoff_effect.Freeze) -> None:
    if step.life is not None and step.life.state is State.RUNNING:
        step.change(unanswered=step.standing.unanswered + 1)
        step.do(effect)
    else:
        step.feed(handoff_event.FreezeFailed(effect.offer, "it does not run"))


def _resume(step: HostingStep, effect: handoff_effect.Resume) -> None:
    step.do(effect)
    if step.life is not None and step.life.state not in ACTOR | UNDECIDED:
        # Its actor failed while it stood still: it begins again from what was written down.
        step.live(lifecycle.StartAsked(), Leave.AGAIN)


def _give_way(step: HostingStep, effect: handoff_effect.GiveWay) -> None:
    life = step.life
    if life is not None and life.state in UNDECIDED:
        step.refuse(effect.reason)
    elif life is not None:
        step.live(lifecycle.StopAsked(reason=effect.reason))
        if life.state is State.REFUSED:
            step.do(lifecycle.WriteRest())  # what it carried when it was refused


def _discard(step: HostingStep, effect: handoff_effect.Discard) -> None:
    life = step.life
    ends = life is not None and life.state in ACTOR
    step.do(Drop(ends))
    reason = f"handed over to {step.standing.record.peer}" if ends else "it is elsewhere"
    step.change(leaving=life is not None)
    if life is not None and life.state in UNDECIDED:
        step.refuse(reason)
    elif life is not None:
        step.live(lifecycle.StopAsked(reason=reason))


def _decline(step: HostingStep, effect: handoff_effect.Decline) -> None:
    rule = DECLINED.get(type(step.decided))
    if rule is not None:
        rule(step, effect)


def _handed_over(step: HostingStep, effect: handoff_effect.HandedOver) -> None:
    step.change(leaving=step.life is not None, to_conclude=2)
    step.do(effect)


# What its hand-off declines, by the event ----------------------------------------------------------------------


def _start_declined(step: HostingStep, effect: handoff_effect.Decline) -> None:
    step.unreserve()
    if step.life is not None and step.life.state in UNDECIDED:
        step.live(lifecycle.LeaveRefused(effect.reason, for_good=True))


# What happens besides ------------------------------------------------------------------------------------------


def _start_configured(step: HostingStep, event: StartConfigured) -> None:
    record = step.standing.record
    if record.may_begin or (event.fresh and record.phase is Phase.OWNER):
        step.live(lifecycle.StartAsked())
    elif record.phase in (Phase.OWNER, Phase.FROZEN):
        step.live(lifecycle.StartAsked(), Leave.RECOVERED)
    else:
        _take_up(step, TakeUp())
        step.do(lifecycle.Settle())


def _start_wanted(step: HostingStep, event: StartWanted) -> None:
    step.live(lifecycle.StartAsked(), Leave.WANTED)


def _take_up(step: HostingStep, event: TakeUp) -> None:
    step.change(effects=(*step.standing.effects, *handoff.recover(step.standing.record)))


def _room(step: HostingStep, event: Room) -> None:
    record = step.standing.record
    if step.life is None or step.life.state not in UNDECIDED:
        step.unreserve()  # it was decided otherwise since
        return
    if event.reason and not record.in_doubt:  # else its hand-off decides where it runs
        step.live(lifecycle.LeaveRefused(event.reason, event.for_good))
    elif record.may_begin and step.standing.waits is None:  # else it is being adopted
        step.feed(handoff_event.Born(event.snapshot, event.guardian))
    elif event.snapshot:
        step.feed(handoff_event.Ended(Wanted.STOPPED, event.snapshot))
        step.feed(handoff_event.RunAsked())
    else:
        step.feed(handoff_event.RunAsked(event.asked.again))


def _place_free(step: HostingStep, event: PlaceFree) -> None:
    waits = step.standing.waits
    if isinstance(waits, handoff_effect.StartTask):
        _start_task(step, waits)


def _no_place(step: HostingStep, event: NoPlace) -> None:
    step.do(Decided(event.reason))
    step.done()


def _came_to_rest(step: HostingStep, event: CameToRest) -> None:
    standing, life = step.standing, step.life
    assert life is not None
    record, wanted = standing.record, _wanted_at_rest(life)
    alike = event.snapshot in (b"", record.snapshot)
    if step.at.closing and idle(standing) and wanted is record.wanted and alike:
        # Each record costs a wait for the disk, and of a thousand tasks whose service ends most have nothing new.
        step.live(lifecycle.Written())
    else:
        step.feed(handoff_event.Ended(wanted, event.snapshot))
        step.change(rests=True)
    step.go_on()
    step.do(Rested())


def _wanted_at_rest(life: Life) -> Wanted:
    if life.state is State.FAILED and life.restarts.due_s is None:
        return Wanted.FAILED
    # What is to start again, or ends with its service, is still wanted, also after a reboot.
    return Wanted.RUNNING if life.wanted else Wanted.STOPPED


def _persisted(step: HostingStep, event: Persisted) -> None:
    waits = step.standing.waits
    if isinstance(waits, handoff_effect.Persist):
        step.change(waits=None, record=waits.record, trouble="")
        if waits.record.phase is Phase.PREPARED:
            # An adoption that could not be written down comes too late.
            step.do(Decided(f"{waits.record.task_id} is on its way here from {waits.record.peer}"))


def _not_persisted(step: HostingStep, event: NotPersisted) -> None:
    standing, record = step.standing, step.standing.record
    waits = standing.waits
    if not isinstance(waits, handoff_effect.Persist):
        return
    step.why_not = event.reason
    failed = handoff_event.PersistFailed(event.reason, waits.record)
    effects = handoff.handle(step.at.me, standing.record, standing.volatile, failed, step.at.permit)
    step.change(waits=None, trouble=event.reason, effects=tuple(effects))
    owner = standing.record.phase is Phase.OWNER
    if waits.record.phase is Phase.ABSENT or (owner and waits.record.phase is Phase.RELEASED):
        step.do(Lasts(event.reason))
    adopted_later = any(isinstance(later, handoff_event.AdoptionAsked) for later in standing.events)
    adopted = owner and waits.record.epoch != standing.record.epoch
    elsewhere = (record.in_doubt or record.phase is Phase.RELEASED) and not record.removed
    if (elsewhere or adopted) and not adopted_later:
        # An adoption is not tried again by itself: the person may have learnt better meanwhile.
        step.do(Decided(f"{standing.record.task_id} is not adopted: {event.reason}"))
    step.go_on()
    state = step.life.state if step.life is not None else None
    asked_later = any(isinstance(later, handoff_event.RunAsked) for later in step.standing.events)
    if state in UNDECIDED and step.standing.record.phase is Phase.FROZEN and not asked_later:
        # Its agent has crashed, and the hand-off is broken off later, or goes on.
        step.live(lifecycle.LeaveRefused(event.reason, for_good=True))
    elif state in UNDECIDED:
        step.live(lifecycle.PutOff(event.reason))
    if state is not State.ASKED:
        step.unreserve()


def _stood_still(step: HostingStep, event: StoodStill) -> None:
    standing, life = step.standing, step.life
    unanswered = max(0, standing.unanswered - 1)
    step.change(unanswered=unanswered)
    if unanswered:
        return  # it was told so again meanwhile, and answers that
    runs = life is not None and life.state is State.RUNNING
    given_up = handoff_event.FreezeFailed
    if event.carried is None or not runs:
        step.feed(handoff_event.FreezeFailed(event.offer, event.reason or "it ends"))
    elif standing.volatile.freezing and not any(isinstance(later, given_up) for later in standing.events):
        step.do(TakeDown(event.offer, event.carried))
    else:
        step.do(LetGoOn())


def _still_overdue(step: HostingStep, event: StillOverdue) -> None:
    """A task that does not come back from what it is doing cannot be moved."""
    if step.standing.volatile.freezing:
        step.feed(handoff_event.FreezeFailed(event.offer, "it is stuck"))


def _part_concluded(step: HostingStep, event: PartConcluded) -> None:
    left = step.standing.to_conclude - 1
    step.change(to_conclude=left)
    if not left:
        step.feed(handoff_event.Concluded())


DECLINED: Final[Mapping[type, Rule]] = {
    handoff_event.RunAsked: _start_declined,
    handoff_event.AdoptionAsked: lambda step, effect: step.do(Decided(effect.reason)),
    handoff_event.ForgettingAsked: lambda step, effect: step.do(Lasts(effect.reason)),
    handoff_event.RemovalAsked: lambda step, effect: step.do(Lasts(effect.reason)),
    handoff_event.Award: lambda step, effect: step.do(
        handoff_effect.AttemptFailed("", Refusal("conflict", effect.reason))
    ),
}
"""What it means that the hand-off declines an event."""

RULES: Final[Mapping[type, Rule]] = {
    lifecycle.AskLeave: _ask_leave,
    lifecycle.Settle: _settle,
    lifecycle.WriteRest: _write_rest,
    handoff_effect.Remember: _remember,
    handoff_effect.Persist: _persist,
    handoff_effect.StartTask: _start_task,
    handoff_effect.Freeze: _freeze,
    handoff_effect.Resume: _resume,
    handoff_effect.GiveWay: _give_way,
    handoff_effect.Discard: _discard,
    handoff_effect.Decline: _decline,
    handoff_effect.HandedOver: _handed_over,
    StartConfigured: _start_configured,
    StartWanted: _start_wanted,
    TakeUp: _take_up,
    Room: _room,
    PlaceFree: _place_free,
    NoPlace: _no_place,
    CameToRest: _came_to_rest,
    Persisted: _persisted,
    NotPersisted: _not_persisted,
    StoodStill: _stood_still,
    StillOverdue: _still_overdue,
    PartConcluded: _part_concluded,
}
"""What each effect of the one half means for the other, and what follows each event of the host."""


def handle(
    life: Life | None, standing: Standing, event: AnyEvent, at: Now
) -> tuple[Life | None, Standing, list[AnyEffect]]:
    """Decides what an event means.

    Args:
        life: the life of the task; None: it has no place here.
        standing: how it stands besides.
        event: what has happened.
        at: the moment.

    Returns:
        Its life and how it stands from now on, and what is to be done, in this order.
    """
    step = HostingStep(life, standing, at)
    step.take(event)
    return step.life, step.standing, step.effects
