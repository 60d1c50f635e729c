"""What must hold in the world of a hosted task at each moment, and where nothing more comes by itself."""

from __future__ import annotations

from typing import Final

from model.hosting_world import Spent, Violation, World

from pancakes.durable.handoff import is_disputed
from pancakes.durable.handoff_events import GiveUp, Persist, Resend, StartTask, WriteAgain
from pancakes.durable.record import NO_EPOCH, Phase, Wanted
from pancakes.durable.state_machine import StillOverdue, idle, settled
from pancakes.supervision.lifecycle import Overdue, Retry, State, TryDue

ACTOR: Final = (State.STARTING, State.RUNNING, State.STOPPING, State.STUCK)
RESTS: Final = (State.STOPPED, State.REFUSED, State.FAILED)
UNDECIDED: Final = (State.ASKED, State.CALLED_OFF)


def check(world: World) -> None:
    """Checks a world.

    Raises:
        Violation: a promise is broken.
    """
    _check_actor(world)
    _check_waiting(world)
    _check_timers(world)
    _check_requests(world)
    if idle(world.standing):
        _check_idle(world)


def _check_actor(world: World) -> None:
    life, record = world.life, world.standing.record
    lives = life is not None and life.state in ACTOR
    if lives != bool(world.actor):
        raise Violation(f"it has {'an' if world.actor else 'no'} actor, and its life says otherwise")
    if world.actor in ("made", "runs"):
        if record.phase is not Phase.OWNER:
            raise Violation(f"it runs, and its record is {record.phase.name}")
        if world.disk.phase not in (Phase.OWNER, Phase.FROZEN):
            raise Violation(f"it runs, and its record on disk is {world.disk.phase.name}")
    if is_disputed(record) and world.actor in ("made", "runs", "still"):
        raise Violation("another agent owns it too, and it is not told to end")
    if world.actor == "still":
        if record.phase not in (Phase.OWNER, Phase.FROZEN):
            raise Violation("it was given away, and its actor was not told to end")
        goes_on = world.inbox or world.stood or world.standing.volatile.freezing or record.phase is Phase.FROZEN
        if not goes_on and isinstance(world.standing.waits, Persist):
            goes_on = True
        if not goes_on:
            raise Violation("it stands still, and nothing lets it go on")
    if world.closing == "over" and world.actor and life is not None and life.state is not State.STUCK:
        raise Violation("its service ends, and it goes on")


def _check_waiting(world: World) -> None:
    standing, life = world.standing, world.life
    waits = standing.waits
    if isinstance(waits, Persist) != (world.writing is not None):
        raise Violation("it waits for a record that is not being written, or the other way round")
    if isinstance(waits, StartTask) and not world.actor and not world.blocked:
        raise Violation("it waits for a start that does not come")
    if waits is None and (standing.effects or standing.events):
        raise Violation("what is to be done is not done")
    if any(standing.events.count(event) > 2 for event in standing.events):
        raise Violation("the same waits twice, and would pile up")
    if standing.begins and not isinstance(waits, StartTask):
        raise Violation("its life has taken up a start that is not under way")
    if life is not None and life.state in UNDECIDED and idle(standing) and standing.volatile.again is None:
        raise Violation("it waits for leave that nothing gives")
    if standing.rests and settled(standing):
        raise Violation("its rest is on disk, and its life is not told")
    if standing.leaving and life is not None and life.at_rest:
        raise Violation("it has left, and its place is not cleared")


def _check_timers(world: World) -> None:
    life, timers = world.life, world.timers
    if life is None:
        return
    if life.state is State.REFUSED and not world.closing and Retry() not in timers:
        raise Violation("it is wanted, and never tried again")
    if life.restarts.due_s is not None and TryDue(life.restarts.due_s) not in timers:
        raise Violation("its next try never comes")
    if life.state is State.RESTARTING and life.restarts.due_s is None:
        raise Violation("it is to start again, and no try is due")
    if life.state is State.STOPPING and Overdue(life.incarnation) not in timers:
        raise Violation("it does not end, and its keeper does not know")
    if world.actor == "made" and life.state is not State.STARTING:
        raise Violation("it is to begin, and its life does not wait for that")


def _check_requests(world: World) -> None:
    life = world.life
    asker = life.asker.number if life is not None and life.asker is not None else None
    if asker is not None and asker not in {number for number, _ in world.open}:
        raise Violation("a request that was answered still keeps others waiting")
    unanswered = [number for number, _ in world.open if number != asker]
    if unanswered:
        raise Violation(f"request {unanswered[0]} is never answered")
    if life is None:
        return
    if asker is not None and life.state in RESTS and not world.standing.rests:
        raise Violation("a request waits for what never comes")
    if not world.settled and life.state not in (*UNDECIDED, *ACTOR):
        raise Violation(f"it is {life.state.name}, and its service still waits for its start")


def _check_idle(world: World) -> None:
    """Checks what must hold where its hand-off has nothing to do."""
    standing, life, timers = world.standing, world.life, world.timers
    record, volatile = standing.record, standing.volatile
    state = life.state if life is not None else None
    if volatile.again is not None and not world.settled:
        raise Violation("its service waits for a disk that fails")
    if volatile.again is not None and WriteAgain(record, volatile.again) not in timers:
        raise Violation("what could not be written is never tried again")
    if volatile.freezing:
        told = (offer for offer in (*world.inbox, *(offer for offer, _ in world.stood)) if offer is not None)
        if not any(True for _ in told):
            if world.actor in ("runs", "still"):
                raise Violation("it has said whether it stands still, and its hand-off waits")
            if not any(isinstance(timer, StillOverdue) for timer in timers):
                raise Violation("it is to stand still, and nothing says whether it does")
    if record.phase is Phase.FROZEN and not any(isinstance(timer, GiveUp) for timer in timers):
        raise Violation("it is frozen, and nothing takes it back")
    if record.phase in (Phase.COMMITTED, Phase.PREPARED):
        if Resend(record.offer, record.phase, 0) not in timers:
            raise Violation("its hand-off is undecided, and this agent does not ask")
    if world.closing == "told" and (life is None or life.at_rest):
        raise Violation("its service waits for its end, and it has ended")
    if record.phase is Phase.RELEASED and record.sequel and not world.parts and not world.spent.faults:
        raise Violation("what follows its hand-over is done, and that is not written down")
    if world.asked_for & {"adopt", "forget", "forgotten", "give up", "remove"} and settled(standing):
        raise Violation("a decision of a person is never answered")
    if "follow" in world.asked_for and state not in (*UNDECIDED, *ACTOR):
        raise Violation("what it is to follow waits for ever")
    if "move" in world.asked_for and not volatile.asked and record.phase not in (Phase.FROZEN, Phase.COMMITTED):
        raise Violation("the Task Migrator waits for a hand-off that is over")
    if world.reserved and record.phase is not Phase.PREPARED and state not in UNDECIDED:
        raise Violation("actuators are kept for it for ever")
    _check_place(world)


def _check_place(world: World) -> None:
    standing, life = world.standing, world.life
    record, volatile = standing.record, standing.volatile
    visitor = record.task_id.birthplace != "a"
    away = record.phase in (Phase.ABSENT, Phase.RELEASED)
    if visitor and away and life is not None and not standing.leaving:
        raise Violation("it has a place here, and is elsewhere")
    if record.phase is Phase.RELEASED and world.actor and not standing.leaving:
        raise Violation("it is elsewhere, and its actor is not ending")
    if life is None:
        return
    if world.closing == "over" and record.phase is Phase.OWNER and not world.spent.faults:
        if life.state is State.STOPPED and world.carried and record.snapshot != world.carried:
            raise Violation("its service has ended, and what it carried at the end is not on disk")
    if life.state is State.STOPPED and record.unborn and world.spent == Spent() and not (world.lost or world.closing):
        raise Violation("it was to begin, and rests")
    if record.phase is not Phase.OWNER or world.closing:
        return
    if life.state in RESTS and volatile.running:
        raise Violation("it rests, and its hand-off believes that it runs")
    wanted = record.wanted is Wanted.RUNNING and record.epoch != NO_EPOCH and settled(standing)
    if wanted and (life.state is State.STOPPED or (life.state is State.FAILED and life.at_rest)):
        raise Violation(f"it is {life.state.name}, and its record says that it is to run")
    if not settled(standing):
        return
    if life.state is State.FAILED and life.at_rest and record.wanted not in (Wanted.FAILED, Wanted.DISPUTED):
        raise Violation("it is given up, and its record says otherwise")
    tried = life.state in (State.REFUSED, State.RESTARTING) or life.restarts.due_s is not None
    if tried and record.wanted is not Wanted.RUNNING:
        raise Violation("it is tried again, and would not be after a crash")
