"""Joins what the register of a task wants of its actor with the actor's life (start, stop, restart). Pure.

`rules.desired` says what the actor is to do: run, be paused, or end. The life of the task asks for leave to start, and
comes to rest. `handle` brings the two together: an event comes in, effects go out. All writes go to the registrar, and
come back as `Came`. The reader follows a migration in `rules` (who may have the task) and here (what its actor does
meanwhile).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, Final, get_args

import msgspec
from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.durable import rules
from pancakes.durable.record import Record, dispute_of, why_not_here
from pancakes.durable.register import MORE_THAN_MIGRATIONS, NOBODY, Epoch, Identity, Standing, Wanted
from pancakes.durable.rules import Desired
from pancakes.durable.times import Times
from pancakes.supervision import lifecycle, lifecycle_table
from pancakes.supervision.lifecycle import ACTOR, CLOSES, UNDECIDED, Life, State
from pancakes.supervision.restart import Draw

TIMES: Final = Times()


class Outcome(Enum):
    """What became of an event."""

    DECLINED = "declined"
    """It does not fit how the task stands now."""
    FAILED = "failed"
    """It could not be written, and is not tried again."""
    DELAYED = "delayed"
    """It could not be written, and is tried again."""
    WRITTEN = "written"
    """It is on disk here."""
    COUNTS = "counts"
    """It is on enough disks: a take-over keeps it."""
    LAPSED = "lapsed"
    """It was written, and another agent owns the task now, which may not have it."""


class Write(Enum):
    """What a write of this machine is for."""

    START = "start"
    REST = "rest"
    OFFER = "offer"
    GIVE_UP = "give up"
    SAVE = "save"
    """A checkpoint of a task that runs. The service asks for it."""


# Effects ------------------------------------------------------------------------------------------------------------


class Tell(msgspec.Struct, frozen=True):
    """Feed an event to the registrar; what becomes of it comes back as `Came`.

    Attributes:
        write: what it is for.
        event: one of `rules`.
        sequel: of an offer: what follows once the task has gone, encoded.
    """

    write: Write
    event: Any
    sequel: bytes = b""


class AskRoom(msgspec.Struct, frozen=True):
    """See whether the task can run here now; to be answered, once, by `Room`.

    Attributes:
        keep: whether its actuators are to be kept for it from now on.
        again: whether it was running, and failed.
    """

    keep: bool
    again: bool


class OpenPlace(msgspec.Struct, frozen=True):
    """Open a place for it among the tasks; to be answered by `PlaceFree` or `NoPlace`, perhaps later."""


class Prepare(msgspec.Struct, frozen=True):
    """Give its place what it begins with, and its actuators; to be answered by `Admitted` or `LeaveRefused`.

    Attributes:
        fresh: whether it goes on exactly from where it was paused on another agent.
    """

    fresh: bool


class Unreserve(msgspec.Struct, frozen=True):
    """Keep no actuators for it any longer; those that it holds it keeps."""


class Decided(msgspec.Struct, frozen=True):
    """Tell the requests that wait whether it starts.

    Attributes:
        reason: why it does not run; empty: it runs.
    """

    reason: str


class Rested(msgspec.Struct, frozen=True):
    """It has come to rest: if its service ends, the next task's turn has come."""


class Freeze(msgspec.Struct, frozen=True):
    """Pause its actor, which is to answer `StoodStill`."""

    number: int


class TakeDown(msgspec.Struct, frozen=True):
    """It is paused: hold its actuators and write it down; to be answered by `Frozen` or `FreezeFailed`."""

    carried: object


class LetGoOn(msgspec.Struct, frozen=True):
    """Its actor may go on, under the epoch of its record."""


class Hold(msgspec.Struct, frozen=True):
    """It is paused by the clock: hold its actuators."""


class Resume(msgspec.Struct, frozen=True):
    """It does not leave after all."""


class AttemptFailed(msgspec.Struct, frozen=True):
    """A migration to an agent has come to nothing, or (no peer) none can begin now."""

    peer: str
    refusal: Refusal


class HandedOver(msgspec.Struct, frozen=True):
    """Another agent has the task: do what is to follow."""

    peer: str
    epoch: Epoch
    sequel: bytes


class Drop(msgspec.Struct, frozen=True):
    """Forget what is owed for it and kept for it: another agent has it, or nobody.

    Attributes:
        ends: whether its actor is still to end; its actuators are taken from it at once.
    """

    ends: bool


class Vacate(msgspec.Struct, frozen=True):
    """Clear its place: it is elsewhere. Others that wait for the place are fed `PlaceFree`."""


class After(msgspec.Struct, frozen=True):
    """Feed an event after a time, in host seconds."""

    delay_s: float
    event: Any


class Warn(msgspec.Struct, frozen=True):
    """Tell people."""

    text: str


HostEffect = Tell | OpenPlace | Unreserve | Decided | Drop | Resume | AttemptFailed | HandedOver | After | Warn
"""Effects that a task without a slot may have too."""
SlotEffect = AskRoom | Prepare | Rested | Freeze | TakeDown | LetGoOn | Hold | Vacate


# Events -------------------------------------------------------------------------------------------------------------


class Came(msgspec.Struct, frozen=True):
    """The registrar says how the task stands.

    Attributes:
        record: what is on disk.
        desired: what its actor is to do.
        outcomes: what became of the writes of this machine, and why.
    """

    record: Record
    desired: Desired
    outcomes: tuple[tuple[Write, Outcome, str], ...] = ()


class ServiceBegan(msgspec.Struct, frozen=True):
    """Its service begins, and starts it if it is here and has a place.

    Attributes:
        fresh: whether it begins as the configuration says, whatever its record says.
    """

    fresh: bool = False


class StartWanted(msgspec.Struct, frozen=True):
    """It is to run because another task has left; if its actuators are not free yet, it waits for them."""


class Room(msgspec.Struct, frozen=True):
    """The answer to `AskRoom`.

    Attributes:
        reason: why it cannot run here now; empty: it can.
        for_good: whether to try again is no use.
        waits: whether it waits for what other agents know, and its actuators are kept for it meanwhile.
        snapshot: what it begins with, encoded; empty: what its record says.
        floor: the highest epoch that any other agent knows of it, if it begins now.
    """

    reason: str = ""
    for_good: bool = False
    waits: bool = False
    snapshot: bytes = b""
    floor: Epoch = Epoch(-1, NOBODY)


class PlaceFree(msgspec.Struct, frozen=True):
    """There is a place for it now: it was opened, or the task that had it is gone."""


class NoPlace(msgspec.Struct, frozen=True):
    """No place can be opened for it, and why."""

    reason: str


class CameToRest(msgspec.Struct, frozen=True):
    """The answer to `WriteRest`: what it carried at the end, encoded; empty: what its record says."""

    snapshot: bytes


class RestOverdue(msgspec.Struct, frozen=True):
    """The members have not confirmed in time that it rests, and why that matters."""

    reason: str


class Award(msgspec.Struct, frozen=True):
    """The agent that made the lowest bid keeps room for the task."""

    heir: Identity


class StoodStill(msgspec.Struct, frozen=True):
    """The answer of its actor to `Freeze`.

    Attributes:
        number: that of the question.
        carried: what it carries; None: it cannot say, and goes on.
        reason: why it cannot.
    """

    number: int
    carried: object = None
    reason: str = ""


class StillOverdue(msgspec.Struct, frozen=True):
    """It should be paused by now."""

    number: int


class Frozen(msgspec.Struct, frozen=True):
    """It is paused and written down.

    Attributes:
        snapshot: the task, encoded.
        sequel: what follows once it has gone, encoded.
    """

    snapshot: bytes
    sequel: bytes = b""


class FreezeFailed(msgspec.Struct, frozen=True):
    """It could not be paused, and why."""

    reason: str


class GiveUpDue(msgspec.Struct, frozen=True):
    """The heir has not asked for the task in time."""

    number: int
    reason: str


class Refused(msgspec.Struct, frozen=True):
    """The heir declines what it was offered, which is taken back."""

    refusal: Refusal


class InDoubt(msgspec.Struct, frozen=True):
    """It is time to tell people that a migration has not ended."""

    standing: Standing
    epoch: Epoch


class Removed(msgspec.Struct, frozen=True):
    """It was removed, and enough members know."""


Event = (
    Came
    | ServiceBegan
    | StartWanted
    | Room
    | PlaceFree
    | NoPlace
    | CameToRest
    | RestOverdue
    | Award
    | StoodStill
    | StillOverdue
    | Frozen
    | FreezeFailed
    | GiveUpDue
    | Refused
    | InDoubt
    | Removed
)
AnyEvent = lifecycle.Event | Event
AnyEffect = lifecycle.Effect | SlotEffect | HostEffect


class Stage(Enum):
    """How far a migration from here is."""

    FREEZING = "freezing"
    """The actor is being paused."""
    OFFERING = "offering"
    """The offer is being written."""
    OFFERED = "offered"


class Moving(msgspec.Struct, frozen=True):
    """A migration from here.

    Attributes:
        heir: the agent that is to have the task.
        stage: how far it is.
        refusal: why it comes to nothing, once that is known.
    """

    heir: Identity
    stage: Stage = Stage.FREEZING
    refusal: Refusal | None = None


class Course(msgspec.Struct, frozen=True):
    """How a task stands with its service, besides its life.

    Attributes:
        record: what is on disk.
        desired: what its actor is to do.
        pending: the writes that are under way.
        asks: the start waits for the writes before it; whether it was running, and failed. None: no start waits.
        granted: the start has leave, and waits until the actor may run.
        starts: whether to start it as soon as its actor may run.
        rests: its life waits until its rest is written, and counts.
        rests_left: how many writes of a rest do not count yet; the last one says how it rests.
        leaving: another agent has it, and its place is cleared once its actor has ended.
        stale: its actor carries what is not to be written any more.
        fresh: it has come from another agent, and has not begun here.
        moving: its migration from here; None: none.
        moves: how many there were; that numbers the last one.
    """

    record: Record
    desired: Desired = Desired.END
    pending: tuple[Write, ...] = ()
    asks: bool | None = None
    granted: bool = False
    starts: bool = False
    rests: bool = False
    rests_left: int = 0
    leaving: bool = False
    stale: bool = False
    fresh: bool = False
    moving: Moving | None = None
    moves: int = 0

    @property
    def settled(self) -> bool:
        """Whether nothing is under way, so that a checkpoint may be written."""
        return not self.pending and self.moving is None and not self.granted and self.asks is None

    @property
    def paused(self) -> bool:
        """Whether the actor is being paused, or is, for a migration."""
        return self.moving is not None


class Now(msgspec.Struct, frozen=True):
    """What a rule may ask besides how the task stands.

    Attributes:
        me: this agent's name.
        now_s: host time.
        draw: draws the length of a pause.
        closing: whether the task's service ends.
        removing: whether it is being removed, which waits for its members.
    """

    me: str
    now_s: float
    draw: Draw
    closing: bool
    removing: bool = False


_LIFE_EVENTS: Final = frozenset(get_args(lifecycle.Event))


class Step:
    """One step: what it has changed so far, and the effects that follow.

    Args:
        life: the life of the task; None: it has no place here.
        course: how it stands besides.
        at: the moment.

    Attributes:
        effects: what the service carries out, in this order.
    """

    def __init__(self, life: Life | None, course: Course, at: Now) -> None:
        self.life = life
        self.course = course
        self.at = at
        self.effects: list[Any] = []
        self._lives: deque[lifecycle.Event] = deque()
        self._living = False
        self.wanted = False

    @property
    def record(self) -> Record:
        """What is on disk."""
        return self.course.record

    def take(self, event: AnyEvent) -> None:
        """Take the event of this step."""
        waited = self.life is not None and self.life.state is State.REFUSED
        if type(event) in _LIFE_EVENTS:
            self.live(event)  # type: ignore[arg-type]
        else:
            RULES[type(event)](self, event)
        _look(self)
        if waited and self.life is not None and self.life.state is State.STOPPED:
            self.unreserve()  # what was kept for it while it waited
        _clear_place(self)

    def do(self, effect: AnyEffect) -> None:
        """Have an effect carried out, after those before it."""
        self.effects.append(effect)

    def change(self, **changes: Any) -> None:
        """Change how the task stands."""
        self.course = replace(self.course, **changes)

    def write(self, write: Write, event: Any, sequel: bytes = b"") -> None:
        """Have the registrar take an event."""
        self.change(pending=(*self.course.pending, write))
        self.do(Tell(write, event, sequel))

    def live(self, event: lifecycle.Event) -> None:
        """Feed an event to the life, which takes it after those before it."""
        self._lives.append(event)
        if self._living:
            return
        self._living = True
        while self._lives:
            assert self.life is not None
            event = self._lives.popleft()
            self.life, effects = lifecycle_table.handle(self.life, event, self.at.now_s, self.at.draw)
            for effect in effects:
                rule = OF_LIFE.get(type(effect))
                if rule is not None:
                    rule(self, effect)
                else:
                    self.do(effect)
        self._living = False

    def refuse(self, reason: str, for_good: bool = True, keeps: bool = False) -> None:
        """Refuse the life the leave that it waits for, unless that is about to happen."""
        if not keeps:
            self.unreserve()
        self.change(granted=False, asks=None)
        waits = self.life is not None and self.life.state in UNDECIDED
        if waits and not any(isinstance(it, lifecycle.LeaveRefused) for it in self._lives):
            self.live(lifecycle.LeaveRefused(reason, for_good=for_good))

    def unreserve(self) -> None:
        """Have no actuators kept for it any longer; those of one that is on its way here stay."""
        if self.record.standing is not Standing.HEIR:
            self.do(Unreserve())


Rule = Callable[[Step, Any], None]


# What a life asks for -----------------------------------------------------------------------------------------------


def _ask_leave(step: Step, effect: lifecycle.AskLeave) -> None:
    life, record = step.life, step.record
    assert life is not None
    step.change(granted=False)  # the leave before this one was used, by a start that failed
    if step.at.closing:
        step.live(lifecycle.LeaveRefused(CLOSES))
    elif record.disputed:
        step.refuse(dispute_of(record))
    elif step.course.pending:
        step.change(asks=effect.again)  # what is being written may have a later state
    elif _may_start(step):
        born = not record.owned and life.asker is None
        # Of two tasks that are to start at once, the second is refused before its record says that it is wanted.
        step.do(AskRoom(keep=not born and not step.wanted, again=effect.again))
    else:
        step.refuse(why_not_here(record))


def _may_start(step: Step) -> bool:
    record = step.record
    if record.owned:
        return True
    is_birthplace = record.task_id.birthplace == step.at.me
    return (record.may_begin and is_birthplace) or record.goes_on


def _settle(step: Step, effect: lifecycle.Settle) -> None:
    step.do(effect)
    life, record = step.life, step.record
    assert life is not None
    if life.state is not State.ASKED and not step.course.leaving:
        step.do(Decided(effect.reason))
    if life.state in ACTOR:
        step.change(granted=False, starts=False, fresh=False, stale=False)
        step.unreserve()
    elif life.state in (State.REFUSED, State.STOPPED) and step.course.granted:
        step.change(granted=False, starts=False)
        step.unreserve()
        wanted = Wanted.RUNNING if life.wanted else Wanted.STOPPED
        if record.owned and not record.disputed and record.wanted is not wanted and not step.course.pending:
            step.write(Write.REST, rules.Want(wanted))


def _write_rest(step: Step, effect: lifecycle.WriteRest) -> None:
    if step.course.leaving:
        step.live(lifecycle.Written())  # what is left of it here is its record
        step.do(Rested())
    else:
        step.do(effect)


OF_LIFE: Final[Mapping[type, Rule]] = {
    lifecycle.AskLeave: _ask_leave,
    lifecycle.Settle: _settle,
    lifecycle.WriteRest: _write_rest,
}
"""What an effect of the life means besides; all others are carried out as they are."""


# Starting -----------------------------------------------------------------------------------------------------------


def _room(step: Step, event: Room) -> None:
    record, life = step.record, step.life
    if life is None or life.state not in UNDECIDED:
        step.unreserve()  # it was decided otherwise since
    elif event.reason:
        step.refuse(event.reason, event.for_good, event.waits)
    elif not _may_start(step) or record.disputed:
        step.refuse(why_not_here(record))
    elif not record.owned:
        step.write(Write.START, rules.Begin(event.floor, event.snapshot or record.snapshot))
    elif record.wanted is Wanted.RUNNING and not event.snapshot and record.register.heir == NOBODY:
        _grant(step)
    else:
        step.write(Write.START, rules.Want(Wanted.RUNNING, event.snapshot or None))


def _grant(step: Step) -> None:
    """The record says that it runs: it starts as soon as its actor may run."""
    step.change(granted=True)
    if step.course.desired is Desired.RUN:
        step.do(Prepare(step.course.fresh))
    else:
        step.live(lifecycle.PutOff(f"{step.record.task_id} waits for its guardians"))


def _service_began(step: Step, event: ServiceBegan) -> None:
    record, has_place = step.record, step.life is not None
    if record.standing is Standing.OFFERED:
        step.write(Write.GIVE_UP, rules.GiveUp())  # the end of the service before has broken it off
    elif record.standing is Standing.RELEASED and record.sequel:
        _handed_over(step)
    elif record.in_doubt:
        step.do(After(TIMES.warn_s, InDoubt(record.standing, record.seen)))
    rests = record.owned or (record.goes_on and record.wanted is not Wanted.RUNNING)
    if has_place and _may_start(step) and (event.fresh or not rests):
        step.live(lifecycle.StartAsked())
        return
    step.change(starts=record.owned and record.wanted is Wanted.RUNNING)
    if has_place and not (record.owned and step.course.desired is Desired.RUN):
        step.do(lifecycle.Settle())


def _start_wanted(step: Step, event: StartWanted) -> None:
    step.wanted = True
    step.live(lifecycle.StartAsked())


def _place_free(step: Step, event: PlaceFree) -> None:
    """It is looked at again."""


def _no_place(step: Step, event: NoPlace) -> None:
    step.change(starts=False)
    step.do(Decided(event.reason))


def _look(step: Step) -> None:
    """Start the task if it is to run and nothing is under way."""
    course, life = step.course, step.life
    if course.asks is not None and not course.pending:
        again = course.asks
        step.change(asks=None)
        if life is not None and life.state in UNDECIDED:
            _ask_leave(step, lifecycle.AskLeave(again))
        return
    if not course.starts or course.desired is not Desired.RUN or step.at.closing or course.pending:
        return
    if life is None:
        step.do(OpenPlace())
    elif life.state in (State.STOPPED, State.FAILED, State.REFUSED, State.RESTARTING) and not course.leaving:
        step.change(starts=False)
        step.live(lifecycle.StartAsked())
    elif life.state not in ACTOR | UNDECIDED:
        pass
    elif not course.leaving:
        step.change(starts=False)


def _clear_place(step: Step) -> None:
    """Clear the place of a task that has left, once its actor has ended.

    A stop that is still to be written is answered before that: the task has left meanwhile.
    """
    if step.course.leaving and step.life is not None and step.life.at_rest and not step.course.rests:
        step.change(leaving=False)
        step.do(Vacate())


# Coming to rest -----------------------------------------------------------------------------------------------------


def _came_to_rest(step: Step, event: CameToRest) -> None:
    life, record = step.life, step.record
    assert life is not None
    wanted = _wanted_at_rest(life)
    snapshot = b"" if step.course.stale else event.snapshot
    alike = snapshot in (b"", record.snapshot)
    if not record.owned and not record.unborn:
        step.live(lifecycle.Written(why_not_here(record) if not record.removed else ""))
    elif record.unborn or (
        alike and (wanted is record.wanted or record.disputed) and not step.course.pending and not step.course.paused
    ):
        step.live(lifecycle.Written())
    else:
        step.change(rests=True, rests_left=step.course.rests_left + 1)
        step.write(Write.REST, rules.Want(wanted, snapshot or None))
    step.do(Rested())


def _wanted_at_rest(life: Life) -> Wanted:
    if life.state is State.FAILED and life.restarts.due_s is None:
        return Wanted.FAILED
    # What is to start again, or ends with its service, is still wanted, also after a reboot.
    return Wanted.RUNNING if life.wanted else Wanted.STOPPED


def _written(step: Step, why_not: str = "") -> None:
    if step.course.rests:
        step.change(rests=False)
        step.live(lifecycle.Written(why_not))


def _rest_overdue(step: Step, event: RestOverdue) -> None:
    _written(step, event.reason)


# How it stands ------------------------------------------------------------------------------------------------------


def _came(step: Step, event: Came) -> None:
    before, was, had_leave = step.record, step.course.desired, step.course.granted
    step.change(record=event.record, desired=event.desired)
    record, life = event.record, step.life
    for write, outcome, why in event.outcomes:
        if outcome not in (Outcome.COUNTS, Outcome.LAPSED, Outcome.DELAYED):
            pending = list(step.course.pending)
            if write in pending:
                pending.remove(write)
            step.change(pending=tuple(pending))
        OUTCOMES[write](step, outcome, why)
    if record.owned and (not before.owned or before.epoch != record.epoch):
        _is_owner(step, before)
    elif (before.owned or before.was_ours) and not (record.owned or record.was_ours):
        if not (record.removed and step.at.removing):  # else it is here until its members know
            _has_left(step, before)
    elif before.here and not record.here:
        _is_elsewhere(step, before)
    elif record.disputed and not before.disputed:
        _give_way(step)
    elif record.standing is Standing.HEIR and before.standing is not Standing.HEIR:
        step.do(After(TIMES.warn_s, InDoubt(record.standing, record.seen)))
    _look_at_offer(step, before)
    runs = life is not None and life.state is State.RUNNING and not step.course.paused
    if runs and was is Desired.RUN and event.desired is Desired.PAUSE and record.owned and not record.disputed:
        step.do(Hold())
    elif runs and was is not Desired.RUN and event.desired is Desired.RUN:
        step.do(LetGoOn())
    if had_leave and step.course.granted and step.life is not None and step.life.state in UNDECIDED:
        if event.desired is Desired.RUN and was is not Desired.RUN:
            step.do(Prepare(step.course.fresh))
        elif not record.owned or record.disputed:
            step.refuse(why_not_here(record))


def _is_owner(step: Step, before: Record) -> None:
    """This agent owns the task from now on, or under another epoch."""
    record, life = step.record, step.life
    came = before.standing is Standing.HEIR
    if life is not None and life.state in ACTOR and before.owned:
        # It has taken the task from its members again, from its own state or a later one.
        if record.snapshot != before.snapshot:
            step.change(stale=True)
            step.live(lifecycle.StopAsked(reason="its guardians have a later state", again=True))
        return
    own_write = Write.START in step.course.pending or step.course.granted
    step.change(fresh=came, starts=record.wanted is Wanted.RUNNING and not own_write)


def _has_left(step: Step, before: Record) -> None:
    """The task was given to another agent, or removed: this agent, or its former self, never runs it again."""
    life, record = step.life, step.record
    ends = life is not None and life.state in ACTOR
    step.do(Drop(ends))
    reason = f"handed over to {record.peer}" if ends else "it is elsewhere"
    step.change(leaving=life is not None, starts=False, granted=False, asks=None)
    if life is not None and life.state in UNDECIDED:
        step.refuse(reason)
    elif life is not None:
        step.live(lifecycle.StopAsked(reason=reason))
    if record.in_doubt:
        step.do(After(TIMES.warn_s, InDoubt(record.standing, record.seen)))
    else:
        _is_elsewhere(step, before)


def _is_elsewhere(step: Step, before: Record) -> None:
    """Another agent owns the task, or nobody."""
    moving, record = step.course.moving, step.record
    step.change(moving=None)
    if before.standing is Standing.HEIR:
        step.do(Drop(False))
        step.change(leaving=step.life is not None)
    elif record.sequel or (moving is not None and moving.stage is Stage.OFFERED):
        _handed_over(step)
    elif moving is not None:
        step.do(AttemptFailed(moving.heir.agent, Refusal("moved", f"{record.peer} owns the task")))


def _handed_over(step: Step) -> None:
    record = step.record
    step.change(leaving=step.life is not None)
    step.do(HandedOver(record.peer, record.seen, record.sequel))


def _give_way(step: Step) -> None:
    life, reason = step.life, dispute_of(step.record)
    step.change(starts=False)
    if life is not None and life.state in UNDECIDED:
        step.refuse(reason)
    elif life is not None:
        step.live(lifecycle.StopAsked(reason=reason))
        if life.state is State.REFUSED:
            step.do(lifecycle.WriteRest())


# Migrating ----------------------------------------------------------------------------------------------------------


def _award(step: Step, event: Award) -> None:
    course, life, task_id = step.course, step.life, step.record.task_id
    runs = life is not None and life.state is State.RUNNING and course.desired is Desired.RUN
    if not runs or course.leaving:
        step.do(AttemptFailed("", Refusal("conflict", f"{task_id} does not run here, so it cannot be given away")))
    elif course.moving is not None:
        step.do(AttemptFailed("", Refusal("conflict", f"{task_id} is being handed over already")))
    elif len(step.record.register.sets) > 1:
        reason = f"the guardians of {task_id} are being changed, which takes as long as its state: try again then"
        step.do(AttemptFailed("", Refusal("busy", reason)))
    else:
        step.change(moves=course.moves + 1, moving=Moving(event.heir))
        step.do(Freeze(step.course.moves))


def _stood_still(step: Step, event: StoodStill) -> None:
    course, life = step.course, step.life
    if event.number != course.moves:
        return  # it was told so again meanwhile, and answers that
    runs = life is not None and life.state is State.RUNNING
    freezing = course.moving is not None and course.moving.stage is Stage.FREEZING
    if event.carried is None or not runs:
        _freeze_failed(step, FreezeFailed(event.reason or "it ends"))
    elif freezing and course.desired is Desired.RUN:
        step.do(TakeDown(event.carried))
    else:
        _freeze_failed(step, FreezeFailed("it may not act now"))
        step.do(LetGoOn())


def _still_overdue(step: Step, event: StillOverdue) -> None:
    """A task that does not come back from what it is doing cannot migrate."""
    if event.number == step.course.moves:
        _freeze_failed(step, FreezeFailed("it is stuck"))


def _frozen(step: Step, event: Frozen) -> None:
    moving = step.course.moving
    if moving is None or moving.stage is not Stage.FREEZING:
        step.do(Resume())
        return
    step.change(moving=replace(moving, stage=Stage.OFFERING))
    step.write(Write.OFFER, rules.Offer(moving.heir, event.snapshot), event.sequel)


def _freeze_failed(step: Step, event: FreezeFailed) -> None:
    moving = step.course.moving
    if moving is not None and moving.stage is Stage.FREEZING:
        step.change(moving=None)
        reason = f"the task could not be stopped for it: {event.reason}"
        step.do(AttemptFailed(moving.heir.agent, Refusal("failed", reason)))


def _give_up_due(step: Step, event: GiveUpDue) -> None:
    moving = step.course.moving
    if moving is not None and step.course.moves == event.number and moving.stage is Stage.OFFERED:
        if step.record.standing is Standing.OFFERED:
            step.change(moving=replace(moving, refusal=Refusal("unable", event.reason)))
            step.write(Write.GIVE_UP, rules.GiveUp())


def _heir_refused(step: Step, event: Refused) -> None:
    moving = step.course.moving
    if moving is not None:
        step.change(moving=replace(moving, refusal=event.refusal))


def _look_at_offer(step: Step, before: Record) -> None:
    """See whether an offer was taken back."""
    moving, record = step.course.moving, step.record
    if moving is None or moving.stage is not Stage.OFFERED or not record.owned or record.register.heir != NOBODY:
        return
    step.change(moving=None)
    ended = step.life is None or step.life.state not in ACTOR
    stopped = Refusal("conflict", "the task was stopped" if record.wanted is not Wanted.RUNNING else "it failed")
    refusal = moving.refusal or stopped
    step.do(Resume())
    if record.epoch.n - before.epoch.n >= MORE_THAN_MIGRATIONS // 2:
        return  # a person has it run here, and who waits for the migration is told so
    if ended and record.wanted is Wanted.RUNNING:
        step.change(starts=True)  # its actor failed while it was paused
    step.do(AttemptFailed(moving.heir.agent, refusal))


def _in_doubt(step: Step, event: InDoubt) -> None:
    record = step.record
    if (record.standing, record.seen) != (event.standing, event.epoch):
        return
    if record.standing is Standing.HEIR:
        story = f"is here, paused, and {record.peer} does not say whether it was given away"
    else:
        story = f"was given to {record.peer}, which does not say that it has it"
    step.do(Warn(f"{record.task_id} {story} (epoch {record.seen}): the migration goes on by itself once it answers"))


# What became of writes ----------------------------------------------------------------------------------------------


def _started(step: Step, outcome: Outcome, why: str) -> None:
    life = step.life
    waits = life is not None and life.state in UNDECIDED
    if outcome is Outcome.WRITTEN and waits:
        _grant(step)
    elif outcome is Outcome.WRITTEN:
        step.change(starts=False)
    elif outcome is Outcome.DELAYED and waits:
        step.live(lifecycle.PutOff(why))
    elif outcome in (Outcome.FAILED, Outcome.DECLINED):
        step.refuse(why or why_not_here(step.record))
        step.do(Decided(why or why_not_here(step.record)))


def _at_rest(step: Step, outcome: Outcome, why: str) -> None:
    life = step.life
    asked = life is not None and life.asker is not None
    if outcome not in (Outcome.WRITTEN, Outcome.DELAYED):
        step.change(rests_left=max(0, step.course.rests_left - 1))
    if Write.REST in step.course.pending:
        return  # a later one says how it rests
    if outcome in (Outcome.COUNTS, Outcome.LAPSED) and step.course.rests_left:
        return  # the same: that one is written, and does not count yet
    waits = step.record.guarded and asked and not step.at.removing
    if (outcome is Outcome.WRITTEN and not waits) or outcome is Outcome.COUNTS:
        _written(step)
    elif outcome is Outcome.LAPSED:
        _written(step, f"{step.record.task_id} was taken over by {step.record.peer} meanwhile")
    elif outcome is Outcome.FAILED:
        _written(step, why)
    elif outcome is Outcome.DECLINED:
        _written(step, why or ("" if step.record.owned else why_not_here(step.record)))


def _offered(step: Step, outcome: Outcome, why: str) -> None:
    moving = step.course.moving
    if moving is None or moving.stage is not Stage.OFFERING:
        return
    if outcome is Outcome.WRITTEN:
        step.change(moving=replace(moving, stage=Stage.OFFERED))
        wait_s = TIMES.prepare_s + TIMES.transfer_s(len(step.record.snapshot))
        step.do(After(wait_s, GiveUpDue(step.course.moves, f"did not ask for the task within {wait_s:.1f} s")))
    elif outcome in (Outcome.FAILED, Outcome.DECLINED):
        step.change(moving=None)
        step.do(Resume())
        refusal = Refusal("failed" if why else "conflict", why or "the task was decided about meanwhile")
        step.do(AttemptFailed(moving.heir.agent, refusal))


def _given_up(step: Step, outcome: Outcome, why: str) -> None:
    """An offer that cannot be taken back is tried again."""
    if outcome is Outcome.FAILED and step.course.moving is not None:
        step.do(After(TIMES.retry_write_s, GiveUpDue(step.course.moves, why)))


OUTCOMES: Final[Mapping[Write, Callable[[Step, Outcome, str], None]]] = {
    Write.START: _started,
    Write.REST: _at_rest,
    Write.OFFER: _offered,
    Write.GIVE_UP: _given_up,
    Write.SAVE: lambda step, outcome, why: None,
}

RULES: Final[Mapping[type, Rule]] = {
    Came: _came,
    ServiceBegan: _service_began,
    StartWanted: _start_wanted,
    Room: _room,
    PlaceFree: _place_free,
    NoPlace: _no_place,
    CameToRest: _came_to_rest,
    RestOverdue: _rest_overdue,
    Award: _award,
    StoodStill: _stood_still,
    StillOverdue: _still_overdue,
    Frozen: _frozen,
    FreezeFailed: _freeze_failed,
    GiveUpDue: _give_up_due,
    Refused: _heir_refused,
    InDoubt: _in_doubt,
    Removed: lambda step, event: _has_left(step, step.record),
}
"""The rule of each event."""


def handle(life: Life | None, course: Course, event: AnyEvent, at: Now) -> tuple[Life | None, Course, list[Any]]:
    """Decide what an event means.

    Args:
        life: the life of the task; None: it has no place here.
        course: how it stands besides.
        event: what has happened.
        at: the moment.

    Returns:
        Its life and course from now on, and the effects, in the order in which they are carried out.
    """
    step = Step(life, course, at)
    step.take(event)
    return step.life, step.course, step.effects
