"""Searches the machine of a life exhaustively: every order of requests, timers, ends and failures, within bounds.

The world is one place with its life, the actor in it, the timers that are set, and the requests that are not answered.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import msgspec
from msgspec.structs import replace

from pancakes.supervision import lifecycle as effect
from pancakes.supervision import lifecycle as event
from pancakes.supervision.lifecycle import Life, Request, State
from pancakes.supervision.lifecycle_table import TABLE, Moment
from pancakes.supervision.restart import Restarts, RestartSpec


class Bounds(msgspec.Struct, frozen=True):
    """How far a search goes.

    Attributes:
        requests: so many requests come in one history.
        spawns: so many actors are made in one history; further leave is refused.
    """

    requests: int = 2
    spawns: int = 2


SUITE = Bounds()
DEEP = Bounds(3, 4)


class World(msgspec.Struct, frozen=True):
    """What there is.

    Attributes:
        life: the life.
        actor: "": none; "made", "runs"; "told": told to end; "told early": that, before it ran.
        leave: how many answers to `AskLeave` are to come.
        written: how many `Written` are to come.
        timers: the events that are to come some time, or never.
        open: the numbers of the requests that are not answered.
        asked: how many requests have come.
        closing: whether the keeper ends.
        settled: whether the last start is decided.
        stopped: whether a stop that was asked for was answered last, and nothing has been asked since.
    """

    life: Life
    actor: str = ""
    leave: int = 0
    written: int = 0
    timers: frozenset[Any] = frozenset()
    open: frozenset[int] = frozenset()
    asked: int = 0
    closing: bool = False
    settled: bool = True
    stopped: bool = False


class Violation(Exception):
    """A promise is broken."""


Rules = Mapping[tuple[State, type], Callable[..., Any]]


def feed(world: World, what: Any, rules: Rules) -> World:
    """Feeds an event, and carries out what follows."""
    rule = rules.get((world.life.state, type(what)))
    if rule is None:
        raise Violation(f"no rule for {type(what).__name__} in {world.life.state.name}")
    life, effects = rule(world.life, what, Moment(0.0, lambda low, high: high))
    world = replace(world, life=life)
    for one in effects:
        world = carry_out(world, one)
    return world


def carry_out(world: World, one: Any) -> World:
    """Carries out one effect."""
    match one:
        case effect.AskLeave():
            if world.leave:
                raise Violation("leave is asked for twice")
            return replace(world, leave=1, settled=False)
        case effect.Spawn():
            if world.actor:
                raise Violation("a second actor is made beside the first")
            return replace(world, actor="made")
        case effect.TellToEnd():
            if world.actor not in ("made", "runs"):
                raise Violation("an actor is told to end that is not there, or was told before")
            told = "told early" if world.actor == "made" else "told"
            return replace(world, actor=told, timers=world.timers | {event.Overdue(world.life.incarnation)})
        case effect.TryAt(due_s):
            return replace(world, timers=world.timers | {event.TryDue(due_s)})
        case effect.LookAgain():
            return replace(world, timers=world.timers | {event.Retry()})
        case effect.WriteRest():
            if world.actor and world.life.state is not State.STUCK:
                raise Violation("it comes to rest while its actor is there")
            return replace(world, written=world.written + 1)
        case effect.Settle():
            return replace(world, settled=True)
        case effect.LetGo():
            if world.actor in ("made", "runs"):
                raise Violation("what it holds is taken back while it runs")
        case effect.Answer(asker, reason):
            if asker.number not in world.open:
                raise Violation(f"request {asker.number} is answered twice")
            stopped = not reason and world.life.state in (State.STOPPED, State.FAILED)
            return replace(world, open=world.open - {asker.number}, stopped=stopped)
    return world


def steps(world: World, rules: Rules, bounds: Bounds) -> Iterator[tuple[str, World]]:
    """Yields what can happen next."""
    life = world.life
    if life.asker is None and world.asked < bounds.requests:
        number = world.asked + 1
        request = Request("b/task", ("b/task", number), number)
        asked = replace(world, asked=number, open=world.open | {number}, stopped=False)
        if life.state in (State.STOPPED, State.REFUSED, State.FAILED, State.RESTARTING):
            yield "a start is asked for", feed(asked, event.StartAsked(request), rules)
        if life.state is not State.STOPPED:
            yield "a stop is asked for", feed(asked, event.StopAsked(request, "asked for"), rules)
        yield "a restart is asked for", feed(asked, event.StopAsked(request, "asked for", again=True), rules)
    if not world.closing:
        if not life.at_rest:
            closing = replace(world, closing=True)
            yield "the keeper ends", feed(closing, event.StopAsked(reason="its keeper ends"), rules)
        by_itself = (State.STOPPED, State.REFUSED, State.FAILED, State.RESTARTING, State.ASKED)
        if life.state in by_itself and life.incarnation < bounds.spawns:
            yield "the keeper starts it", feed(replace(world, stopped=False), event.StartAsked(), rules)
    if world.leave:
        given = replace(world, leave=0)
        if not world.closing and life.incarnation < bounds.spawns:
            yield "leave is given", feed(given, event.Admitted(), rules)
        yield "leave is refused", feed(given, event.LeaveRefused("it lacks something"), rules)
        yield "leave is refused for good", feed(given, event.LeaveRefused("it is elsewhere", for_good=True), rules)
        if life.state in (State.ASKED, State.CALLED_OFF):
            put_off = feed(world, event.PutOff("the disk is full"), rules)
            if not put_off.settled:
                raise Violation("its keeper waits for a start that waits for the disk")
            yield "it is put off", put_off
    if world.actor == "made":
        yield "it runs", feed(replace(world, actor="runs"), event.Began(), rules)
    if world.actor == "told early":
        yield "it runs, late", feed(replace(world, actor="told"), event.Began(), rules)
    if world.actor:
        gone = replace(world, actor="")
        for failed, hopeless in ((False, False), (True, False), (True, True)):
            ended = event.Finished("it ended", failed, hopeless, world.closing)
            yield f"it ends{' by an error' if failed else ''}", feed(gone, ended, rules)
    for timer in sorted(world.timers, key=str):
        yield f"{type(timer).__name__} comes", feed(replace(world, timers=world.timers - {timer}), timer, rules)
    if world.written:
        yield "its rest is written", feed(replace(world, written=world.written - 1), event.Written(), rules)


def check(world: World) -> None:
    """Checks what must hold at each moment, and what must hold where nothing more comes by itself."""
    life = world.life
    if (life.asker.number if life.asker is not None else None) not in {*world.open, None}:
        raise Violation("a request that was answered still keeps others waiting")
    if life.state in (State.STARTING, State.RUNNING, State.STOPPING, State.STUCK) and not world.actor:
        raise Violation(f"it is {life.state.name} without an actor")
    if life.state in (State.STOPPED, State.REFUSED, State.FAILED, State.RESTARTING) and world.actor:
        raise Violation(f"it is {life.state.name}, and its actor is there")
    if life.state in (State.ASKED, State.CALLED_OFF) and not world.leave:
        raise Violation("it waits for leave that nothing gives")
    if life.state is State.REFUSED and not world.closing and event.Retry() not in world.timers:
        raise Violation("it is wanted, and never tried again")
    if life.restarts.due_s is not None and event.TryDue(life.restarts.due_s) not in world.timers:
        raise Violation("its next try never comes")
    if life.state is State.RESTARTING and life.restarts.due_s is None:
        raise Violation("it is to start again, and no try is due")
    if life.state is State.STARTING and world.actor != "made":
        raise Violation("it runs, and its keeper does not know")
    if life.state is State.STOPPING and event.Overdue(life.incarnation) not in world.timers:
        raise Violation("it does not end, and its keeper does not know")
    if world.stopped and (world.actor or world.leave or life.state is State.RESTARTING):
        raise Violation("a stop was answered, and it runs all the same")
    unanswered = world.open - ({life.asker.number} if life.asker is not None else set())
    if unanswered:
        raise Violation(f"request {min(unanswered)} is never answered")
    if life.asker is not None and life.state in (State.STOPPED, State.REFUSED, State.FAILED) and not world.written:
        raise Violation("a request waits for what never comes")
    if not world.settled and life.state not in (
        State.ASKED,
        State.CALLED_OFF,
        State.STARTING,
        State.STOPPING,
        State.STUCK,
    ):
        raise Violation(f"it is {life.state.name}, and its keeper still waits for its start")


def search(spec: RestartSpec, rules: Rules = TABLE, bounds: Bounds = SUITE) -> tuple[int, set[tuple[State, type]], str]:
    """Searches all histories.

    Returns:
        How many worlds there are, the pairs of state and event that were met, and the violation with the history that
        leads to it; empty: there is none.
    """
    met: set[tuple[State, type]] = set()

    class Noting(dict[tuple[State, type], Any]):
        def get(self, key: Any, default: Any = None) -> Any:
            met.add(key)
            return super().get(key, default)

    noting = Noting(rules)
    begin = World(Life("a/client/Task", Restarts(spec)))
    seen: dict[World, tuple[World | None, str]] = {begin: (None, "")}
    waiting = deque([begin])
    while waiting:
        world = waiting.popleft()
        step = "?"
        try:
            for step, following in steps(world, noting, bounds):
                if following not in seen:
                    seen[following] = (world, step)
                    check(following)
                    waiting.append(following)
        except Violation as violation:
            last = "" if step == "?" else step
            return len(seen), met, f"{violation}, after: {', '.join([*history(seen, world), last])}"
    return len(seen), met, ""


def history(seen: Mapping[World, tuple[World | None, str]], world: World | None) -> list[str]:
    """Returns what has led to a world."""
    told: list[str] = []
    while world is not None:
        world, step = seen[world]
        told.append(step)
    return [step for step in reversed(told) if step]
