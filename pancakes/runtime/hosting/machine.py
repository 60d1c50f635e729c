"""The machine of a hosted task: its life and its hand-off, joined. Pure.

A life asks for leave to start, and the record of the task gives it. A hand-off starts a task, has it stand still, and
ends it, and the life of the task carries that out. The rules here say what each means for the other; what they leave
out passes through.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Final, get_args

from msgspec.structs import replace

from pancakes.mesh.migration import core
from pancakes.mesh.migration import effect as handoff_effect
from pancakes.mesh.migration import event as handoff_event
from pancakes.mesh.migration.owner import dispute_of
from pancakes.mesh.migration.record import Phase, Wanted
from pancakes.runtime.hosting import hosting_effect, hosting_event
from pancakes.runtime.hosting.leave import Leave
from pancakes.runtime.hosting.now import Now
from pancakes.runtime.hosting.standing import Standing, disputed_in
from pancakes.runtime.life import life_effect, life_event, table
from pancakes.runtime.life.life import ACTOR, CLOSES, UNDECIDED, Life, State

_LIFE_EVENTS: Final = frozenset(get_args(life_event.Event))
_HOSTING_EVENTS: Final = frozenset(get_args(hosting_event.HostingEvent))

AnyEvent = life_event.Event | handoff_event.Event | hosting_event.HostingEvent
AnyEffect = hosting_effect.PassedOn | hosting_effect.SlotEffect | hosting_effect.HostingEffect


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
        self._lives: deque[tuple[life_event.Event, Leave]] = deque()
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
                self.live(life_event.Written(self.why_not))
            if not was_settled:
                self.do(hosting_effect.Lasts())
        if self.standing.leaving and self.life is not None and self.life.at_rest:
            self.change(leaving=False)
            self.do(hosting_effect.Vacate())

    def do(self, effect: AnyEffect) -> None:
        """Has an effect carried out, after those before it."""
        self.effects.append(effect)

    def change(self, **changes: Any) -> None:
        """Changes how the task stands."""
        self.standing = replace(self.standing, **changes)

    def feed(self, event: handoff_event.Event) -> None:
        """Feeds an event to the hand-off, which takes it after those before it."""
        self.change(events=(*self.standing.events, event))

    def live(self, event: life_event.Event, leave: Leave = Leave.ENTRY) -> None:
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
            self.life, effects = table.handle(self.life, event, self.at.now_s, self.at.draw)
            for effect in effects:
                self._carry(effect)
        self._living = False

    def refuse(self, reason: str) -> None:
        """Refuses the life the leave that it waits for, for good, unless that is about to happen."""
        self.unreserve()
        if not any(isinstance(event, life_event.LeaveRefused) for event, _ in self._lives):
            self.live(life_event.LeaveRefused(reason, for_good=True))

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
                effects = core.handle(self.at.me, standing.record, standing.volatile, self.decided, self.at.permit)
                self.change(events=tuple(waiting), effects=tuple(effects))
            else:
                break

    def _carry(self, effect: life_effect.Effect | handoff_effect.Effect) -> None:
        if isinstance(effect, hosting_effect.Joined):
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
            self.do(hosting_effect.Unreserve())


Rule = Callable[[HostingStep, Any], None]


def idle(standing: Standing) -> bool:
    """Returns whether every event so far is dealt with and every effect carried out."""
    return standing.waits is None and not standing.effects and not standing.events


def settled(standing: Standing) -> bool:
    """Returns whether in addition all that was decided is on disk: nothing is left that could not be written."""
    return idle(standing) and standing.volatile.again is None


# What a life asks for ------------------------------------------------------------------------------------------


def _ask_leave(step: HostingStep, effect: life_effect.AskLeave) -> None:
    leave, life = step.leave, step.life
    assert life is not None
    if leave is Leave.ENTRY and effect.again and life.asker is None:
        leave = Leave.AGAIN
    if leave is Leave.GRANTED:
        return
    if step.at.closing:
        step.live(life_event.LeaveRefused(CLOSES))
    elif (disputed := disputed_in(step.standing)) is not None:
        step.refuse(dispute_of(step.at.me, disputed))
    elif leave is Leave.RECOVERED:
        step.change(effects=(*step.standing.effects, *core.recover(step.standing.record)))
    elif leave is Leave.AGAIN:
        step.feed(handoff_event.RunAsked(again=True))
    else:
        born = step.standing.record.phase is Phase.ABSENT and life.asker is None
        # Of two tasks that are to start at once, the second is refused before its record says that it is wanted.
        step.do(hosting_effect.AskRoom(keep=not born and leave is not Leave.WANTED, again=effect.again))


def _settle(step: HostingStep, effect: life_effect.Settle) -> None:
    step.do(effect)
    life, standing = step.life, step.standing
    assert life is not None
    # One that waits for leave still may start, and one that was given away may be on its way back.
    if life.state is not State.ASKED and not standing.leaving:
        step.do(hosting_effect.Decided(effect.reason))
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


def _write_rest(step: HostingStep, effect: life_effect.WriteRest) -> None:
    if step.standing.leaving:
        # What is left of it here is its record.
        step.live(life_event.Written())
        step.do(hosting_effect.Rested())
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
            step.do(hosting_effect.Decided("it was stopped since"))
    elif life is None:
        step.do(hosting_effect.OpenPlace(effect))
    elif life.state not in ACTOR:  # else it came back before the actor that was given away has ended
        step.change(begins=True, unanswered=0)
        if life.state not in UNDECIDED:
            step.live(life_event.StartAsked(), Leave.GRANTED)
        step.do(hosting_effect.Prepare(effect))


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
        step.live(life_event.StartAsked(), Leave.AGAIN)


def _give_way(step: HostingStep, effect: handoff_effect.GiveWay) -> None:
    life = step.life
    if life is not None and life.state in UNDECIDED:
        step.refuse(effect.reason)
    elif life is not None:
        step.live(life_event.StopAsked(reason=effect.reason))
        if life.state is State.REFUSED:
            step.do(life_effect.WriteRest())  # what it carried when it was refused


def _discard(step: HostingStep, effect: handoff_effect.Discard) -> None:
    life = step.life
    ends = life is not None and life.state in ACTOR
    step.do(hosting_effect.Drop(ends))
    reason = f"handed over to {step.standing.record.peer}" if ends else "it is elsewhere"
    step.change(leaving=life is not None)
    if life is not None and life.state in UNDECIDED:
        step.refuse(reason)
    elif life is not None:
        step.live(life_event.StopAsked(reason=reason))


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
        step.live(life_event.LeaveRefused(effect.reason, for_good=True))


# What happens besides ------------------------------------------------------------------------------------------


def _start_configured(step: HostingStep, event: hosting_event.StartConfigured) -> None:
    record = step.standing.record
    if record.may_begin or (event.fresh and record.phase is Phase.OWNER):
        step.live(life_event.StartAsked())
    elif record.phase in (Phase.OWNER, Phase.FROZEN):
        step.live(life_event.StartAsked(), Leave.RECOVERED)
    else:
        _take_up(step, hosting_event.TakeUp())
        step.do(life_effect.Settle())


def _start_wanted(step: HostingStep, event: hosting_event.StartWanted) -> None:
    step.live(life_event.StartAsked(), Leave.WANTED)


def _take_up(step: HostingStep, event: hosting_event.TakeUp) -> None:
    step.change(effects=(*step.standing.effects, *core.recover(step.standing.record)))


def _room(step: HostingStep, event: hosting_event.Room) -> None:
    record = step.standing.record
    if step.life is None or step.life.state not in UNDECIDED:
        step.unreserve()  # it was decided otherwise since
        return
    if event.reason and not record.in_doubt:  # else its hand-off decides where it runs
        step.live(life_event.LeaveRefused(event.reason, event.for_good))
    elif record.may_begin and step.standing.waits is None:  # else it is being adopted
        step.feed(handoff_event.Born(event.snapshot, event.guardian))
    elif event.snapshot:
        step.feed(handoff_event.Ended(Wanted.STOPPED, event.snapshot))
        step.feed(handoff_event.RunAsked())
    else:
        step.feed(handoff_event.RunAsked(event.asked.again))


def _place_free(step: HostingStep, event: hosting_event.PlaceFree) -> None:
    waits = step.standing.waits
    if isinstance(waits, handoff_effect.StartTask):
        _start_task(step, waits)


def _no_place(step: HostingStep, event: hosting_event.NoPlace) -> None:
    step.do(hosting_effect.Decided(event.reason))
    step.done()


def _came_to_rest(step: HostingStep, event: hosting_event.CameToRest) -> None:
    standing, life = step.standing, step.life
    assert life is not None
    record, wanted = standing.record, _wanted_at_rest(life)
    alike = event.snapshot in (b"", record.snapshot)
    if step.at.closing and idle(standing) and wanted is record.wanted and alike:
        # Each record costs a wait for the disk, and of a thousand tasks whose service ends most have nothing new.
        step.live(life_event.Written())
    else:
        step.feed(handoff_event.Ended(wanted, event.snapshot))
        step.change(rests=True)
    step.go_on()
    step.do(hosting_effect.Rested())


def _wanted_at_rest(life: Life) -> Wanted:
    if life.state is State.FAILED and life.restarts.due_s is None:
        return Wanted.FAILED
    # What is to start again, or ends with its service, is still wanted, also after a reboot.
    return Wanted.RUNNING if life.wanted else Wanted.STOPPED


def _persisted(step: HostingStep, event: hosting_event.Persisted) -> None:
    waits = step.standing.waits
    if isinstance(waits, handoff_effect.Persist):
        step.change(waits=None, record=waits.record, trouble="")
        if waits.record.phase is Phase.PREPARED:
            # An adoption that could not be written down comes too late.
            step.do(hosting_effect.Decided(f"{waits.record.task_id} is on its way here from {waits.record.peer}"))


def _not_persisted(step: HostingStep, event: hosting_event.NotPersisted) -> None:
    standing, record = step.standing, step.standing.record
    waits = standing.waits
    if not isinstance(waits, handoff_effect.Persist):
        return
    step.why_not = event.reason
    failed = handoff_event.PersistFailed(event.reason, waits.record)
    effects = core.handle(step.at.me, standing.record, standing.volatile, failed, step.at.permit)
    step.change(waits=None, trouble=event.reason, effects=tuple(effects))
    owner = standing.record.phase is Phase.OWNER
    if waits.record.phase is Phase.ABSENT or (owner and waits.record.phase is Phase.RELEASED):
        step.do(hosting_effect.Lasts(event.reason))
    adopted_later = any(isinstance(later, handoff_event.AdoptionAsked) for later in standing.events)
    adopted = owner and waits.record.epoch != standing.record.epoch
    elsewhere = (record.in_doubt or record.phase is Phase.RELEASED) and not record.removed
    if (elsewhere or adopted) and not adopted_later:
        # An adoption is not tried again by itself: the person may have learnt better meanwhile.
        step.do(hosting_effect.Decided(f"{standing.record.task_id} is not adopted: {event.reason}"))
    step.go_on()
    state = step.life.state if step.life is not None else None
    asked_later = any(isinstance(later, handoff_event.RunAsked) for later in step.standing.events)
    if state in UNDECIDED and step.standing.record.phase is Phase.FROZEN and not asked_later:
        # Its agent has crashed, and the hand-off is broken off later, or goes on.
        step.live(life_event.LeaveRefused(event.reason, for_good=True))
    elif state in UNDECIDED:
        step.live(life_event.PutOff(event.reason))
    if state is not State.ASKED:
        step.unreserve()


def _stood_still(step: HostingStep, event: hosting_event.StoodStill) -> None:
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
        step.do(hosting_effect.TakeDown(event.offer, event.carried))
    else:
        step.do(hosting_effect.LetGoOn())


def _still_overdue(step: HostingStep, event: hosting_event.StillOverdue) -> None:
    """A task that does not come back from what it is doing cannot be moved."""
    if step.standing.volatile.freezing:
        step.feed(handoff_event.FreezeFailed(event.offer, "it is stuck"))


def _part_concluded(step: HostingStep, event: hosting_event.PartConcluded) -> None:
    left = step.standing.to_conclude - 1
    step.change(to_conclude=left)
    if not left:
        step.feed(handoff_event.Concluded())


DECLINED: Final[Mapping[type, Rule]] = {
    handoff_event.RunAsked: _start_declined,
    handoff_event.AdoptionAsked: lambda step, effect: step.do(hosting_effect.Decided(effect.reason)),
    handoff_event.ForgettingAsked: lambda step, effect: step.do(hosting_effect.Lasts(effect.reason)),
    handoff_event.RemovalAsked: lambda step, effect: step.do(hosting_effect.Lasts(effect.reason)),
    handoff_event.Award: lambda step, effect: step.do(handoff_effect.AttemptFailed("", effect.reason)),
}
"""What it means that the hand-off declines an event."""

RULES: Final[Mapping[type, Rule]] = {
    life_effect.AskLeave: _ask_leave,
    life_effect.Settle: _settle,
    life_effect.WriteRest: _write_rest,
    handoff_effect.Remember: _remember,
    handoff_effect.Persist: _persist,
    handoff_effect.StartTask: _start_task,
    handoff_effect.Freeze: _freeze,
    handoff_effect.Resume: _resume,
    handoff_effect.GiveWay: _give_way,
    handoff_effect.Discard: _discard,
    handoff_effect.Decline: _decline,
    handoff_effect.HandedOver: _handed_over,
    hosting_event.StartConfigured: _start_configured,
    hosting_event.StartWanted: _start_wanted,
    hosting_event.TakeUp: _take_up,
    hosting_event.Room: _room,
    hosting_event.PlaceFree: _place_free,
    hosting_event.NoPlace: _no_place,
    hosting_event.CameToRest: _came_to_rest,
    hosting_event.Persisted: _persisted,
    hosting_event.NotPersisted: _not_persisted,
    hosting_event.StoodStill: _stood_still,
    hosting_event.StillOverdue: _still_overdue,
    hosting_event.PartConcluded: _part_concluded,
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
