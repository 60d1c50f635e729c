"""The state machine of a life, as a table: what each event means in each state. Pure.

What is not in `TABLE` cannot happen. The tests search all sequences of events for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import msgspec
from msgspec.structs import replace

from pancakes.supervision.lifecycle import (
    Admitted,
    Answer,
    AskLeave,
    Began,
    Effect,
    Event,
    Finished,
    LeaveRefused,
    LetGo,
    Life,
    LookAgain,
    News,
    Overdue,
    PutOff,
    Request,
    Retry,
    Revoke,
    Settle,
    Spawn,
    StartAsked,
    State,
    StopAsked,
    Tell,
    TellToEnd,
    TryAt,
    TryDue,
    WriteRest,
    Written,
)
from pancakes.supervision.restart import Draw, Next


class Moment(msgspec.Struct, frozen=True):
    """What a rule may ask besides the life and the event.

    Attributes:
        now_s: host time.
        draw: draws the length of a pause.
    """

    now_s: float
    draw: Draw


Outcome = tuple[Life, list[Effect]]
Rule = Callable[[Life, Any, Moment], Outcome]


def handle(life: Life, event: Event, now_s: float, draw: Draw) -> Outcome:
    """Decide what an event means.

    Args:
        life: the life so far.
        event: what has happened.
        now_s: host time.
        draw: draws a number between two, for the pauses of restarts.

    Returns:
        The life from now on, and what to do, in this order.
    """
    return TABLE[life.state, type(event)](life, event, Moment(now_s, draw))


def _nothing(life: Life, event: Event, at: Moment) -> Outcome:
    """It comes late, or says nothing new."""
    return life, []


# Starting ------------------------------------------------------------------------------------------------------


def _ask(life: Life, asker: Request | None) -> Outcome:
    effects: list[Effect] = []
    if life.asker is not None and life.asker != asker:
        late = f"{life.address} was started again before its stop was written down"
        effects.append(Answer(life.asker, late))
    restarts = life.restarts.tried() if asker is None else life.restarts.forgotten()
    effects.append(AskLeave(again=life.state is State.RESTARTING))
    wanted = life.wanted or asker is None
    return replace(life, state=State.ASKED, restarts=restarts, wanted=wanted, asker=asker, again=False), effects


def _start(life: Life, event: StartAsked, at: Moment) -> Outcome:
    return _ask(life, event.asker)


def _try_again(life: Life, event: TryDue, at: Moment) -> Outcome:
    return _ask(life, None) if event.due_s == life.restarts.due_s else (life, [])


def _retry(life: Life, event: Retry, at: Moment) -> Outcome:
    return _ask(life, None)


def _admitted(life: Life, event: Admitted, at: Moment) -> Outcome:
    incarnation = event.incarnation or life.incarnation + 1
    restarts = life.restarts.tried()
    life = replace(life, state=State.STARTING, restarts=restarts, incarnation=incarnation, wanted=True, reason="")
    return life, [Spawn()]


def _refused(life: Life, event: LeaveRefused, at: Moment) -> Outcome:
    news = not life.asker and life.reason != event.reason
    waits = life.wanted and not event.for_good
    effects: list[Effect] = [LetGo()]  # its predecessor may have left subscriptions and actuators to it
    if life.asker is not None:
        effects.append(Answer(life.asker, event.reason))
    elif news and not event.for_good:
        effects.append(Tell(News.REFUSED, event.reason))
    if waits:
        effects.append(LookAgain())
    effects.append(Settle(event.reason))
    state = State.REFUSED if waits else State.STOPPED
    return replace(life, state=state, wanted=waits, reason=event.reason, asker=None), effects


def _put_off(life: Life, event: PutOff, at: Moment) -> Outcome:
    """Its keeper goes on without it: it starts, or rests, once that can be written down."""
    return replace(life, reason=event.reason), [Settle(event.reason)]


def _began(life: Life, event: Began, at: Moment) -> Outcome:
    answer = [Answer(life.asker)] if life.asker is not None else []
    life = replace(life, state=State.RUNNING, restarts=life.restarts.began(at.now_s), asker=None)
    return life, [Tell(News.STARTED), Settle(), *answer]


# Ending by itself ----------------------------------------------------------------------------------------------


def _ended(life: Life, event: Finished, at: Moment) -> Outcome:
    """It ended unasked: it is started again, rests, or is given up."""
    following, restarts = life.restarts.ended(event.failed, at.now_s, at.draw, event.hopeless, event.blameless)
    if event.closing:
        restarts = restarts.forgotten()
    effects: list[Effect] = []
    if event.failed:
        effects.append(Tell(News.FAILED, event.text, following))
    not_started = f"{life.address} failed to start: {event.text}"
    if life.asker is not None:
        effects.append(Answer(life.asker, not_started))
    life = replace(life, restarts=restarts, reason=event.text, asker=None)
    if restarts.due_s is not None:
        effects.append(TryAt(restarts.due_s))
    if following is Next.RESTART and not event.closing:
        # Its keeper is ready without it, and goes on to what can start.
        effects += [Tell(News.RESTARTS, event.text), Settle(not_started)]
        return replace(life, state=State.RESTARTING), effects
    if following is Next.GIVE_UP:
        given_up = Tell(News.GIVEN_UP, event.text, hopeless=event.hopeless)
        return replace(life, state=State.FAILED), [*effects, given_up, LetGo(), Settle(not_started), WriteRest()]
    if event.failed:
        effects.append(Tell(News.FAILED_AT_THE_END, event.text))
    elif not event.closing:
        life = replace(life, wanted=False)
    return _rest(life, effects)


# Stopping ------------------------------------------------------------------------------------------------------


def _before_it_ran(life: Life, reason: str) -> str:
    return f"{life.address} was stopped before it ran" + (f": {reason}" if reason else "")


def _rest(life: Life, before: list[Effect]) -> Outcome:
    reason = _before_it_ran(life, life.reason)
    effects = [*before, LetGo(), Tell(News.STOPPED, life.reason), Settle(reason), WriteRest()]
    life = replace(life, state=State.STOPPED)
    if not life.again:
        return life, effects
    life, asking = _ask(life, life.asker)
    return life, [*effects, *asking]


def _ended_as_told(life: Life, event: Finished, at: Moment) -> Outcome:
    return _rest(life, [Tell(News.FAILED_WHILE_STOPPING, event.text)] if event.failed else [])


def _never_began(life: Life, event: Admitted | LeaveRefused, at: Moment) -> Outcome:
    return _rest(life, [])


def _meant(life: Life, event: StopAsked) -> Life:
    """Return a life that is to end, or to end and begin again; an earlier asker for a start is answered elsewhere."""
    wanted = life.wanted if event.asker is None or event.again else False
    return replace(life, reason=event.reason, asker=event.asker or life.asker, again=event.again, wanted=wanted)


def _stop(life: Life, event: StopAsked, at: Moment) -> Outcome:
    """It runs, or is about to."""
    answer: list[Effect] = []
    if life.asker is not None:
        answer.append(Answer(life.asker, _before_it_ran(life, event.reason)))
        life = replace(life, asker=None)
    life = _meant(life, event)
    if life.state is State.ASKED:
        return replace(life, state=State.CALLED_OFF), answer
    return replace(life, state=State.STOPPING), [*answer, TellToEnd()]


def _stop_at_rest(life: Life, event: StopAsked, at: Moment) -> Outcome:
    if event.again:
        return _ask(life, event.asker)
    if event.asker is None:
        return life, [LetGo()]
    # What is written down of it may still say that it was given up.
    return _meant(life, event), [LetGo(), WriteRest()]


def _stop_refused(life: Life, event: StopAsked, at: Moment) -> Outcome:
    """It would be tried again."""
    if event.again:
        return _ask(life, event.asker)
    if event.asker is None:
        return replace(life, state=State.STOPPED, reason=event.reason), [LetGo()]
    return replace(_meant(life, event), state=State.STOPPED), [LetGo(), WriteRest()]


def _stop_due(life: Life, event: StopAsked, at: Moment) -> Outcome:
    """It has failed: its next try, if one is due, is called off."""
    if event.again:
        return _ask(life, event.asker)
    if life.restarts.due_s is None and event.asker is None:
        return life, [LetGo()]
    stopped = replace(_meant(life, event), restarts=life.restarts.forgotten())
    if life.restarts.due_s is None:  # it came to rest when it was given up, and was told of then
        return replace(stopped, state=State.STOPPED), [LetGo(), WriteRest()]
    return _rest(stopped, [])


def _stop_stopping(life: Life, event: StopAsked, at: Moment) -> Outcome:
    """The last word counts."""
    if life.again and not event.again and life.asker is not None:
        late = Answer(life.asker, _before_it_ran(life, event.reason))
        return _meant(replace(life, asker=None), event), [late]
    return _meant(life, event), []


def _stop_stuck(life: Life, event: StopAsked, at: Moment) -> Outcome:
    answer = [Answer(event.asker, f"{life.address} is stuck")] if event.asker is not None else []
    return replace(_meant(life, event), asker=None), [*answer]


def _overdue(life: Life, event: Overdue, at: Moment) -> Outcome:
    if event.incarnation != life.incarnation:
        return life, []
    stuck = f"{life.address} is stuck: it was asked to stop and is still busy"
    answer = [Answer(life.asker, stuck)] if life.asker is not None else []
    return replace(life, state=State.STUCK, asker=None), [Revoke(), Tell(News.STUCK, stuck), *answer]


def _written(life: Life, event: Written, at: Moment) -> Outcome:
    answer = [Answer(life.asker, event.why_not)] if life.asker is not None else []
    return replace(life, asker=None), [*answer]


_LATE: Final[Mapping[type, Rule]] = {Overdue: _nothing, TryDue: _nothing, Retry: _nothing, Written: _nothing}
"""What may come late in each state, after something else has happened."""

_RULES: Final[Mapping[State, Mapping[type, Rule]]] = {
    State.STOPPED: {StartAsked: _start, StopAsked: _stop_at_rest, Written: _written},
    State.REFUSED: {StartAsked: _start, StopAsked: _stop_refused, Retry: _retry},
    State.FAILED: {StartAsked: _start, StopAsked: _stop_due, TryDue: _try_again},
    State.RESTARTING: {StartAsked: _start, StopAsked: _stop_due, TryDue: _try_again},
    State.ASKED: {
        StartAsked: _nothing,
        StopAsked: _stop,
        Admitted: _admitted,
        LeaveRefused: _refused,
        PutOff: _put_off,
    },
    State.CALLED_OFF: {
        StopAsked: _stop_stopping,
        Admitted: _never_began,
        LeaveRefused: _never_began,
        PutOff: _put_off,
    },
    State.STARTING: {StopAsked: _stop, Began: _began, Finished: _ended},
    State.RUNNING: {StopAsked: _stop, Finished: _ended},
    State.STOPPING: {StopAsked: _stop_stopping, Began: _nothing, Finished: _ended_as_told, Overdue: _overdue},
    State.STUCK: {StopAsked: _stop_stuck, Began: _nothing, Finished: _ended_as_told},
}

TABLE: Final[Mapping[tuple[State, type], Rule]] = {
    (state, event): rule for state, rules in _RULES.items() for event, rule in {**_LATE, **rules}.items()
}
"""All that can happen. What is not here cannot, and is a defect if it does: the tests search for it."""
