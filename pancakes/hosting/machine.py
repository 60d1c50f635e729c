"""The machine of a hosted task: its life and its hand-off, joined. Pure.

A life asks for leave to start, and the record of the task gives it. A hand-off starts a task, has it stand still, and
ends it, and the life of the task carries that out. The rules here say what each means for the other; what they leave
out passes through.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from pancakes.hosting.hosting_effect import (
    AskRoom,
    Decided,
    Drop,
    Lasts,
    LetGoOn,
    OpenPlace,
    Prepare,
    Rested,
    TakeDown,
    Unreserve,
)
from pancakes.hosting.hosting_event import (
    CameToRest,
    NoPlace,
    NotPersisted,
    PartConcluded,
    Persisted,
    PlaceFree,
    Room,
    StartConfigured,
    StartWanted,
    StillOverdue,
    StoodStill,
    TakeUp,
)
from pancakes.hosting.leave import Leave
from pancakes.hosting.standing import Standing
from pancakes.hosting.turn import AnyEffect, AnyEvent, Moment, Rule, Turn
from pancakes.life.life import CLOSES, Life, State
from pancakes.life.life_effect import AskLeave, Settle, WriteRest
from pancakes.life.life_event import LeaveRefused, PutOff, StartAsked, StopAsked, Written
from pancakes.migration.core import TIMES, handle, recover
from pancakes.migration.effect import (
    AttemptFailed,
    Decline,
    Discard,
    Freeze,
    HandedOver,
    Persist,
    Remember,
    Resume,
    StartTask,
)
from pancakes.migration.event import (
    Adopt,
    Award,
    Born,
    Checkpoint,
    Concluded,
    Ended,
    Forget,
    FreezeFailed,
    PersistFailed,
    Start,
)
from pancakes.migration.record import NO_EPOCH, Phase, Record, Wanted
from pancakes.migration.snapshot import begins_alike

ACTOR: Final = frozenset((State.STARTING, State.RUNNING, State.STOPPING, State.STUCK))
"""The states of a life in which its task has an actor."""
UNDECIDED: Final = frozenset((State.ASKED, State.CALLED_OFF))
"""The states of a life in which it waits for leave."""


def unborn(record: Record) -> bool:
    """Returns whether a task was never heard of on this agent."""
    return record.phase is Phase.ABSENT and record.seen == NO_EPOCH


# What a life asks for ------------------------------------------------------------------------------------------


def _ask_leave(turn: Turn, effect: AskLeave) -> None:
    leave = turn.leave
    life = turn.life
    assert life is not None
    if leave is Leave.ENTRY and effect.again and life.asker is None:
        leave = Leave.AGAIN
    if leave is Leave.GRANTED:
        return
    if turn.at.closing:
        turn.live(LeaveRefused(CLOSES))
    elif leave is Leave.RECOVERED:
        turn.change(effects=(*turn.standing.effects, *recover(turn.standing.record, TIMES)))
    elif leave is Leave.AGAIN:
        turn.feed(Start(again=True))
    else:
        born = turn.standing.record.phase is Phase.ABSENT and life.asker is None
        # Of two tasks that are to start at once, the second is refused before its record says that it is wanted.
        turn.do(AskRoom(keep=not born and leave is not Leave.WANTED, again=effect.again))


def _settle(turn: Turn, effect: Settle) -> None:
    turn.do(effect)
    life = turn.life
    assert life is not None
    standing = turn.standing
    # One that waits for leave still may start, and one that was given away may be on its way back.
    if life.state is not State.ASKED and not standing.leaving:
        turn.do(Decided(effect.reason))
    refused = life.state is State.REFUSED or (life.state is State.STOPPED and standing.begins)
    ended = Ended(Wanted.RUNNING if life.wanted else Wanted.STOPPED)
    if refused and standing.volatile.running and ended not in standing.events[-1:]:
        # It does not run, and a start that is asked for may follow.
        turn.feed(ended)
    if standing.begins:
        turn.done()


def _write_rest(turn: Turn, effect: WriteRest) -> None:
    if turn.standing.leaving:
        # What is left of it here is its record.
        turn.live(Written())
        turn.do(Rested())
    else:
        turn.do(effect)


# What its hand-off asks for ------------------------------------------------------------------------------------


def _remember(turn: Turn, effect: Remember) -> None:
    turn.change(volatile=effect.volatile)


def _persist(turn: Turn, effect: Persist) -> None:
    turn.change(waits=effect)
    turn.do(effect)


def _start_task(turn: Turn, effect: StartTask) -> None:
    turn.change(waits=effect)
    life = turn.life
    if any(isinstance(event, Ended) for event in turn.standing.events):
        turn.done()  # it was decided otherwise since
    elif life is None:
        turn.do(OpenPlace(effect))
    elif life.state in ACTOR:
        # It came back before the actor that was given away has ended.
        turn.live(StopAsked(reason="it comes back"))
    else:
        turn.change(begins=True, stands=None, unanswered=0)
        if life.state not in UNDECIDED:
            turn.live(StartAsked(), Leave.GRANTED)
        turn.do(Prepare(effect))


def _freeze(turn: Turn, effect: Freeze) -> None:
    if turn.life is not None and turn.life.state is State.RUNNING:
        turn.change(stands=effect.offer, unanswered=turn.standing.unanswered + 1)
        turn.do(effect)
    else:
        turn.feed(FreezeFailed(effect.offer, "it does not run"))


def _resume(turn: Turn, effect: Resume) -> None:
    turn.do(effect)
    if turn.life is not None and turn.life.state not in ACTOR | UNDECIDED:
        # Its actor failed while it stood still: it begins again from what was written down.
        turn.live(StartAsked(), Leave.AGAIN)


def _discard(turn: Turn, effect: Discard) -> None:
    life = turn.life
    ends = life is not None and life.state in ACTOR
    turn.do(Drop(ends))
    if life is not None:
        record = turn.standing.record
        turn.change(leaving=True)
        turn.live(StopAsked(reason=f"handed over to {record.peer}" if ends else "it is elsewhere"))


def _decline(turn: Turn, effect: Decline) -> None:
    rule = DECLINED.get(type(turn.decided))
    if rule is not None:
        rule(turn, effect)


def _handed_over(turn: Turn, effect: HandedOver) -> None:
    if turn.life is not None and turn.life.state not in ACTOR:
        turn.change(leaving=True)
        turn.live(StopAsked(reason="it is elsewhere"))
    turn.change(to_conclude=2)
    turn.do(effect)


# What its hand-off declines, by the event ----------------------------------------------------------------------


def _start_declined(turn: Turn, effect: Decline) -> None:
    if turn.standing.record.phase is not Phase.PREPARED:
        turn.do(Unreserve())
    if turn.life is not None and turn.life.state in UNDECIDED:
        turn.live(LeaveRefused(effect.reason, for_good=True))


def _adoption_declined(turn: Turn, effect: Decline) -> None:
    turn.do(Decided(effect.reason))


def _forgetting_declined(turn: Turn, effect: Decline) -> None:
    turn.why_not = effect.reason
    turn.do(Lasts(effect.reason))


def _award_declined(turn: Turn, effect: Decline) -> None:
    turn.do(AttemptFailed("", effect.reason))


# What happens besides ------------------------------------------------------------------------------------------


def _start_configured(turn: Turn, event: StartConfigured) -> None:
    record = turn.standing.record
    if unborn(record) or (event.fresh and record.phase is Phase.OWNER):
        turn.live(StartAsked())
    elif record.phase in (Phase.OWNER, Phase.FROZEN):
        turn.live(StartAsked(), Leave.RECOVERED)
    else:
        _take_up(turn, TakeUp())
        turn.do(Settle())


def _start_wanted(turn: Turn, event: StartWanted) -> None:
    turn.live(StartAsked(), Leave.WANTED)


def _take_up(turn: Turn, event: TakeUp) -> None:
    turn.change(effects=(*turn.standing.effects, *recover(turn.standing.record, TIMES)))


def _room(turn: Turn, event: Room) -> None:
    record = turn.standing.record
    if turn.life is None or turn.life.state not in UNDECIDED:
        return
    if event.reason:
        turn.live(LeaveRefused(event.reason, event.for_good))
    elif unborn(record):
        turn.feed(Born(event.snapshot))
    elif event.snapshot and record.phase is Phase.OWNER:
        turn.feed(Ended(Wanted.STOPPED, event.snapshot))
        turn.feed(Start())
    else:
        turn.feed(Start(event.asked.again))


def _place_free(turn: Turn, event: PlaceFree) -> None:
    waits = turn.standing.waits
    if isinstance(waits, StartTask) and not turn.standing.begins:
        _start_task(turn, waits)


def _no_place(turn: Turn, event: NoPlace) -> None:
    turn.do(Decided(event.reason))
    turn.done()


def _came_to_rest(turn: Turn, event: CameToRest) -> None:
    standing, life = turn.standing, turn.life
    assert life is not None
    if turn.at.closing and life.wanted:
        # The task itself was not asked to end: it goes on when its service comes back. Each record costs a wait for
        # the disk, and of a thousand tasks most have nothing new in it.
        if event.snapshot and not (standing.idle and begins_alike(event.snapshot, standing.record.snapshot)):
            turn.feed(Checkpoint(standing.record.epoch, standing.record.incarnation, event.snapshot))
        turn.live(Written())
    else:
        turn.feed(Ended(_wanted_at_rest(life), event.snapshot))
        turn.change(rests=True)
    turn.go_on()
    turn.do(Rested())
    _place_free(turn, PlaceFree())


def _wanted_at_rest(life: Life) -> Wanted:
    if life.state is not State.FAILED:
        return Wanted.STOPPED
    # What is tried again later is still wanted, also after a reboot.
    return Wanted.FAILED if life.restarts.due_s is None else Wanted.RUNNING


def _persisted(turn: Turn, event: Persisted) -> None:
    waits = turn.standing.waits
    if isinstance(waits, Persist):
        turn.change(waits=None, record=waits.record, trouble="")


def _not_persisted(turn: Turn, event: NotPersisted) -> None:
    standing = turn.standing
    waits = standing.waits
    if not isinstance(waits, Persist):
        return
    turn.why_not = event.reason
    failed = PersistFailed(event.reason, waits.record)
    effects = handle(turn.at.me, standing.record, standing.volatile, failed, TIMES)
    turn.change(waits=None, trouble=event.reason, effects=tuple(effects))
    if standing.record.phase in DOUBT and not any(isinstance(later, Adopt) for later in standing.events):
        # An adoption is not tried again by itself: the person may have learnt better meanwhile.
        turn.do(Decided(f"{standing.record.task_id} is not adopted: {event.reason}"))
    turn.go_on()
    starts = turn.life is not None and turn.life.state is State.ASKED
    if starts:
        turn.live(PutOff(event.reason))
    record = turn.standing.record
    if record.phase is not Phase.PREPARED and not starts:
        turn.do(Unreserve())


def _stood_still(turn: Turn, event: StoodStill) -> None:
    standing, life = turn.standing, turn.life
    unanswered = max(0, standing.unanswered - 1)
    turn.change(unanswered=unanswered)
    if unanswered:
        return  # it was told so again meanwhile, and answers that
    waits = standing.stands == event.offer
    if waits:
        turn.change(stands=None)
    runs = life is not None and life.state is State.RUNNING
    if event.carried is None or not runs:
        if waits:
            turn.feed(FreezeFailed(event.offer, event.reason or "it ends"))
    elif waits and standing.volatile.freezing:
        turn.do(TakeDown(event.offer, event.carried))
    else:
        turn.do(LetGoOn())


def _still_overdue(turn: Turn, event: StillOverdue) -> None:
    """A task that does not come back from what it is doing cannot be moved."""
    if turn.standing.stands == event.offer:
        turn.change(stands=None)
        turn.feed(FreezeFailed(event.offer, "it is stuck"))


def _part_concluded(turn: Turn, event: PartConcluded) -> None:
    left = turn.standing.to_conclude - 1
    turn.change(to_conclude=left)
    if not left:
        turn.feed(Concluded())


DOUBT: Final = (Phase.COMMITTED, Phase.PREPARED)
"""The phases in which an agent cannot know by itself whether a task is its own."""

DECLINED: Final[Mapping[type, Rule]] = {
    Born: _start_declined,
    Start: _start_declined,
    Adopt: _adoption_declined,
    Forget: _forgetting_declined,
    Award: _award_declined,
}
"""What it means that the hand-off declines an event."""

RULES: Final[Mapping[type, Rule]] = {
    AskLeave: _ask_leave,
    Settle: _settle,
    WriteRest: _write_rest,
    Remember: _remember,
    Persist: _persist,
    StartTask: _start_task,
    Freeze: _freeze,
    Resume: _resume,
    Discard: _discard,
    Decline: _decline,
    HandedOver: _handed_over,
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


def step(
    life: Life | None, standing: Standing, event: AnyEvent, at: Moment
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
    turn = Turn(life, standing, at, RULES)
    turn.take(event)
    return turn.life, turn.standing, turn.effects
