"""Carries the effects of a hosted task out in its world, and answers them, as the Client Service does."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from itertools import count
from typing import Any, Final, get_args

from model.hosting_world import BIRTH, LATER, ME, SEQUEL, Bounds, Violation, World
from msgspec.structs import replace

from pancakes.durable import handoff_events as handoff_effect
from pancakes.durable import state_machine as effect
from pancakes.durable import state_machine as event
from pancakes.durable.handoff_events import (
    FreezeFailed,
    Frozen,
    GiveUp,
    InDoubt,
    Resend,
    ReservationExpired,
    WriteAgain,
)
from pancakes.durable.messages import Commit, Prepared, Reserve, Transfer
from pancakes.durable.record import Phase, Record, Wanted
from pancakes.durable.state_machine import Now, Standing
from pancakes.supervision import lifecycle
from pancakes.supervision.lifecycle import CLOSES, Admitted, Finished, LeaveRefused, Life, Overdue, Retry, State, TryDue
from pancakes.supervision.restart import Restarts

Step = Callable[..., tuple[Life | None, Standing, list[Any]]]

AT_A_PLACE: Final = (
    *get_args(lifecycle.Effect),
    *get_args(effect.SlotEffect),
)
"""The effects that can be carried out only where the task has a place."""
MOST_EVENTS: Final = 50
"""So many events may follow from one."""
ENDING: Final = ("told", "told early")
"""The states of an actor that was told to end."""
_SENT: Final = {Reserve: "reserve", Transfer: "transfer", Commit: "commit", Prepared: "prepared"}


class Luck:
    """Makes the choices of a turn that are not the machine's, and notes what else could have been chosen.

    Args:
        given: the first choices.
    """

    def __init__(self, given: tuple[int, ...]) -> None:
        self._given = given
        self._made: list[int] = []
        self.others: list[tuple[int, ...]] = []

    def choose(self, options: int) -> int:
        """Chooses one of so many options."""
        at = len(self._made)
        if at < len(self._given):
            choice = self._given[at]
        else:
            choice = 0
            self.others += [(*self._made, other) for other in range(1, options)]
        self._made.append(choice)
        return choice


class Rim:
    """Feeds events to the machine and carries out what follows.

    Args:
        step: the machine.
        bounds: what may happen.
    """

    def __init__(self, step: Step, bounds: Bounds) -> None:
        self._machine = step
        self._bounds = bounds
        self._moments = {
            closing: Now(ME, 0.0, lambda low, high: high, closing, permit=True) for closing in (False, True)
        }
        self._known: dict[Any, tuple[Life | None, Standing, list[Any]]] = {}

    def feed(self, world: World, *events: Any) -> Iterator[World]:
        """Yields the worlds that may follow."""
        givens: list[tuple[int, ...]] = [()]
        while givens:
            luck = Luck(givens.pop())
            yield self._turn(world, deque(events), luck)
            givens += luck.others

    def _turn(self, world: World, events: deque[Any], luck: Luck) -> World:
        for number in count():
            if not events:
                break
            if number > MOST_EVENTS:
                raise Violation("one step leads to the next for ever")
            told = events.popleft()
            life, standing, effects = self._step(world, told)
            placed = world.life is not None
            world = replace(world, life=life, standing=standing)
            for one in effects:
                if not placed and isinstance(one, AT_A_PLACE):
                    raise Violation(f"{type(one).__name__} comes where there is no place")
                world = self._carry_out(world, one, events, luck)
        timers = frozenset(timer for timer in world.timers if not _is_stale(timer, world.standing))
        return world if len(timers) == len(world.timers) else replace(world, timers=timers)

    def _step(self, world: World, told: Any) -> tuple[Life | None, Standing, list[Any]]:
        closing = bool(world.closing)
        key = (world.life, world.standing, told, closing)
        result = self._known.get(key)
        if result is None:
            try:
                result = self._machine(world.life, world.standing, told, self._moments[closing])
            except (AssertionError, AttributeError, KeyError, TypeError, RecursionError) as error:
                state = world.life.state.name if world.life is not None else "no place"
                what = f"{type(error).__name__} {error}"
                raise Violation(f"the machine fails at {type(told).__name__} in {state}: {what}") from None
            self._known[key] = result
        return result

    def arise(self, record: Record, world: World, fresh: bool = False) -> Iterator[World]:
        """Yields the worlds that may follow where the service begins, and finds a record on disk."""
        bounds = self._bounds
        placed = bool(record.snapshot) or not bounds.visitor
        life = Life("a/client/Task", Restarts(bounds.restart)) if placed else None
        world = World(
            Standing(record),
            record,
            life,
            fresh=fresh and record.phase in (Phase.ABSENT, Phase.OWNER),
            reserved=record.phase is Phase.PREPARED,
            settled=not placed,
            blocked=world.blocked and not placed,
            sent=world.sent,
            theirs=world.theirs,
            lost=world.lost,
            unsure=bounds.births and record.unborn,
            spent=world.spent,
        )
        if not placed:
            yield from self.feed(world, event.TakeUp())
        elif record.unborn or record.phase is not Phase.OWNER or record.wanted is Wanted.RUNNING:
            yield from self.feed(world, event.StartConfigured(fresh))
        else:
            yield replace(world, settled=True)

    # The effects -----------------------------------------------------------------------------------------------

    def _carry_out(self, world: World, one: Any, events: deque[Any], luck: Luck) -> World:
        carry = _CARRIERS.get(type(one))
        return carry(self, world, one, events, luck) if carry is not None else world

    def _refused(self, world: World, luck: Luck) -> tuple[World, bool]:
        """Chooses whether something that is asked for is refused."""
        spent = world.spent
        if spent.refusals >= self._bounds.refusals or not luck.choose(2):
            return world, False
        return replace(world, spent=replace(spent, refusals=spent.refusals + 1)), True

    def _full(self, world: World) -> bool:
        return world.spent.spawns >= self._bounds.spawns

    def ask_room(self, world: World, one: effect.AskRoom, events: deque[Any], luck: Luck) -> World:
        record = world.standing.record
        if world.lost and record.phase is Phase.ABSENT:
            events.append(event.Room(one, "it is not decided where it is", for_good=True))
            return replace(world, reserved=False)
        if world.unsure and (record.unborn or record.phase is Phase.OWNER):
            events.append(event.Room(one, "it may be elsewhere"))
            return replace(world, reserved=False)
        world, refused = self._refused(world, luck)
        if refused or self._full(world):
            events.append(event.Room(one, "it lacks something"))
            return world
        if world.fresh:
            world = replace(world, fresh=False, carried=BIRTH)
        events.append(event.Room(one, snapshot=world.carried or (BIRTH if record.may_begin else b"")))
        return replace(world, reserved=world.reserved or one.keep)

    def open_place(self, world: World, one: effect.OpenPlace, events: deque[Any], luck: Luck) -> World:
        if world.life is not None:
            raise Violation("a place is opened beside the one that it has")
        if world.blocked:
            return world
        world, refused = self._refused(world, luck)
        if refused:
            events.append(event.NoPlace("its class is not here"))
            return world
        events.append(event.PlaceFree())
        return replace(world, life=Life("a/client/Task", Restarts(self._bounds.restart)))

    def prepare(self, world: World, one: effect.Prepare, events: deque[Any], luck: Luck) -> World:
        if world.actor:
            raise Violation("its place is prepared while its actor is there")
        start = one.start
        world, refused = self._refused(world, luck)
        refused = refused or self._full(world) or world.unsure
        reason = CLOSES if world.closing else "it lacks something" if refused else ""
        events.append(LeaveRefused(reason) if reason else Admitted(start.incarnation + 1))
        return replace(world, carried=start.snapshot, fence=(start.epoch, start.incarnation))

    def spawn(self, world: World, one: lifecycle.Spawn, events: deque[Any], luck: Luck) -> World:
        disk = world.disk
        if world.actor:
            raise Violation("a second actor is made beside the first")
        if disk.phase is not Phase.OWNER or disk.wanted is not Wanted.RUNNING:
            raise Violation(f"it starts, and its record is {disk.phase.name}, wanted {disk.wanted.name}")
        if world.fence != (disk.epoch, disk.incarnation):
            raise Violation("it starts under another right than its record says")
        if world.closing:
            raise Violation("it starts while its service ends")
        if world.unsure:
            raise Violation("it starts, and its agent does not know whether it is elsewhere")
        spent, asked = world.spent, world.life is not None and world.life.asker is not None
        if world.fresh and (asked or not (world.sent or world.theirs or spent.decisions or spent.requests)):
            raise Violation("it was to begin anew, and goes on from its checkpoint")
        spent = replace(spent, spawns=spent.spawns + 1)
        world = replace(world, actor="made", carried=b"", inbox=(), stood=(), spent=spent)
        if self._bounds.errors and spent.ends < self._bounds.ends and luck.choose(2):
            events.append(Finished("it could not be made", True, True, bool(world.closing)))
            return replace(world, actor="", spent=replace(spent, ends=spent.ends + 1))
        return world

    def tell_to_end(self, world: World, one: Any, events: deque[Any], luck: Luck) -> World:
        if world.actor not in ("made", "runs", "still"):
            raise Violation("an actor is told to end that is not there, or was told before")
        assert world.life is not None
        told = "told early" if world.actor == "made" else "told"
        return replace(world, actor=told, inbox=(), timers=world.timers | {Overdue(world.life.incarnation)})

    def try_at(self, world: World, one: lifecycle.TryAt, events: deque[Any], luck: Luck) -> World:
        return replace(world, timers=world.timers | {TryDue(one.due_s)})

    def look_again(self, world: World, one: Any, events: deque[Any], luck: Luck) -> World:
        going = world.standing.record.phase in (Phase.FROZEN, Phase.COMMITTED, Phase.PREPARED)
        if going and not world.closing:
            raise Violation("its start is tried again and again, and its hand-off is under way")
        return replace(world, timers=world.timers | {Retry()})

    def let_go(self, world: World, one: Any, events: deque[Any], luck: Luck) -> World:
        if world.actor in ("made", "runs", "still"):
            raise Violation("what it holds is taken back while it runs")
        return world

    def settle(self, world: World, one: Any, events: deque[Any], luck: Luck) -> World:
        starts = any(isinstance(later, handoff_effect.StartTask) for later in world.standing.effects)
        if starts and not world.settled and not one.reason:
            raise Violation("its service does not wait for its start")
        return replace(world, settled=True)

    def write_rest(self, world: World, one: Any, events: deque[Any], luck: Luck) -> World:
        if world.actor:
            raise Violation("it comes to rest while its actor is there")
        events.append(event.CameToRest(world.carried))
        return world

    def answer(self, world: World, one: lifecycle.Answer, events: deque[Any], luck: Luck) -> World:
        asked = next((asked for asked in world.open if asked[0] == one.asker.number), None)
        if asked is None:
            raise Violation(f"request {one.asker.number} is answered twice")
        if not one.reason:
            self._check_done(world, asked[1])
        return replace(world, open=world.open - {asked})

    def _check_done(self, world: World, what: str) -> None:
        disk = world.disk
        if what == "stop":
            if world.actor:
                raise Violation("a stop was answered, and its actor is there")
            if disk.phase is Phase.OWNER and disk.wanted is Wanted.RUNNING:
                raise Violation("a stop was answered that is not on disk")
        elif world.actor != "runs":
            raise Violation(f"a {what} was answered, and it does not run")

    def unreserve(self, world: World, one: Any, events: deque[Any], luck: Luck) -> World:
        if world.standing.record.phase is Phase.PREPARED:
            raise Violation("it may start at any moment, and no actuators are kept for it")
        return replace(world, reserved=False)

    def decided(self, world: World, one: effect.Decided, events: deque[Any], luck: Luck) -> World:
        asked_for = world.asked_for
        if "follow" in asked_for and world.life is not None and world.life.state is State.ASKED:
            raise Violation("it is said whether it starts, and it still waits for leave")
        if "adopt" in asked_for:
            if not one.reason and world.actor != "runs":
                raise Violation("its adoption was answered, and it does not run")
            if world.standing.record.phase is Phase.OWNER:
                asked_for -= {"move"}
        return replace(world, asked_for=asked_for - {"adopt", "follow"})

    def lasts(self, world: World, one: effect.Lasts, events: deque[Any], luck: Luck) -> World:
        if "forget" in world.asked_for and not one.why_not:
            raise Violation("it was said that it is forgotten, and that is not on disk")
        if "give up" in world.asked_for and not one.why_not and world.disk.phase is not Phase.RELEASED:
            raise Violation("it was said that it is given up, and that is not on disk")
        if "remove" in world.asked_for and not one.why_not and not world.disk.removed:
            raise Violation("it was said that it is removed, and that is not on disk")
        return replace(world, asked_for=world.asked_for - {"forget", "forgotten", "give up", "remove"})

    def rested(self, world: World, one: Any, events: deque[Any], luck: Luck) -> World:
        if world.actor:
            raise Violation("it has come to rest, and its actor is there")
        return replace(world, closing="over") if world.closing == "told" else world

    def freeze(self, world: World, one: handoff_effect.Freeze, events: deque[Any], luck: Luck) -> World:
        if world.actor not in ("runs", "still"):
            raise Violation("it is to stand still, and does not run")
        timers = world.timers | {event.StillOverdue(one.offer)}
        return replace(world, inbox=(*world.inbox, one.offer), timers=timers)

    def take_down(self, world: World, one: effect.TakeDown, events: deque[Any], luck: Luck) -> World:
        if world.actor != "still" or None in world.inbox:
            raise Violation("it is written down for another agent, and goes on")
        world, refused = self._refused(world, luck)
        if refused:
            events.append(FreezeFailed(one.offer, "its state cannot be written down"))
            return self.let_go_on(world, one, events, luck)
        events.append(Frozen(one.offer, LATER, SEQUEL))
        return world

    def let_go_on(self, world: World, one: Any, events: deque[Any], luck: Luck) -> World:
        told = world.actor in ("runs", "still")
        return replace(world, inbox=(*world.inbox, None)) if told else world

    def drop(self, world: World, one: effect.Drop, events: deque[Any], luck: Luck) -> World:
        if one.ends != bool(world.actor):
            raise Violation("its actuators are taken from an actor that is not there, or left to one that is")
        return replace(world, reserved=False)

    def vacate(self, world: World, one: Any, events: deque[Any], luck: Luck) -> World:
        if world.actor:
            raise Violation("its place is cleared while its actor is there")
        events.append(event.PlaceFree())
        if not self._bounds.visitor:
            return replace(world, carried=b"")
        timers = frozenset(timer for timer in world.timers if not isinstance(timer, (Overdue, TryDue, Retry)))
        return replace(world, life=None, carried=b"", fresh=False, timers=timers)

    def persist(self, world: World, one: handoff_effect.Persist, events: deque[Any], luck: Luck) -> World:
        if world.writing is not None:
            raise Violation("a record is written before the one before it is")
        if world.disk.sequel and one.record.phase is Phase.RELEASED and not one.record.sequel and world.parts:
            raise Violation("what follows its hand-over is forgotten before it is done")
        life, starts = world.life, one.record.phase is Phase.OWNER and one.record.wanted is Wanted.RUNNING
        asked = life is not None and life.state is State.ASKED and life.asker is not None
        known = world.standing.record
        if world.unsure and known.unborn and one.record.phase is Phase.OWNER and "adopt" not in world.asked_for:
            raise Violation("it is born before others have told what they know of it")
        if known.removed and one.record.phase is Phase.OWNER and one.record.epoch.n <= known.seen.n:
            raise Violation("it was removed, and begins anew under an epoch that actuators know of it")
        goes_on = known.phase is Phase.OWNER and known.wanted is Wanted.RUNNING
        if starts and asked and not world.reserved and not goes_on:
            raise Violation("its record says that it runs, and no actuators are kept for it")
        return replace(world, writing=one.record)

    def send(self, world: World, one: handoff_effect.Send, events: deque[Any], luck: Luck) -> World:
        message = one.message
        kind = _SENT.get(type(message))
        if kind is None:
            return world
        given = world.disk.phase in (Phase.COMMITTED, Phase.RELEASED) or world.spent.decisions
        if kind == "commit" and not given:
            raise Violation("it is given away before that is on disk")
        return replace(world, sent=world.sent | {(kind, message.offer)})

    def after(self, world: World, one: handoff_effect.After, events: deque[Any], luck: Luck) -> World:
        later = one.event
        if isinstance(later, InDoubt):
            return world
        if isinstance(later, Resend):
            later = Resend(later.offer, later.phase, 0)
        return replace(world, timers=world.timers | {later})

    def attempt_failed(self, world: World, one: Any, events: deque[Any], luck: Luck) -> World:
        return replace(world, asked_for=world.asked_for - {"move"})

    def handed_over(self, world: World, one: Any, events: deque[Any], luck: Luck) -> World:
        return replace(world, asked_for=world.asked_for - {"move"}, parts=world.parts + 2)


def _is_stale(timer: Any, standing: Standing) -> bool:
    """Returns whether a timer of the hand-off can never mean anything any more."""
    record = standing.record
    match timer:
        case GiveUp() | Resend():
            return timer.offer != record.offer
        case ReservationExpired():
            return timer.offer <= record.seen
        case WriteAgain():
            return timer.old != record
    return False


_CARRIERS: Final[dict[type, Callable[..., World]]] = {
    lifecycle.Spawn: Rim.spawn,
    lifecycle.TellToEnd: Rim.tell_to_end,
    lifecycle.TryAt: Rim.try_at,
    lifecycle.LookAgain: Rim.look_again,
    lifecycle.LetGo: Rim.let_go,
    lifecycle.Settle: Rim.settle,
    lifecycle.WriteRest: Rim.write_rest,
    lifecycle.Answer: Rim.answer,
    effect.AskRoom: Rim.ask_room,
    effect.OpenPlace: Rim.open_place,
    effect.Prepare: Rim.prepare,
    effect.Unreserve: Rim.unreserve,
    effect.Decided: Rim.decided,
    effect.Lasts: Rim.lasts,
    effect.Rested: Rim.rested,
    effect.TakeDown: Rim.take_down,
    effect.LetGoOn: Rim.let_go_on,
    effect.Drop: Rim.drop,
    effect.Vacate: Rim.vacate,
    handoff_effect.Persist: Rim.persist,
    handoff_effect.Send: Rim.send,
    handoff_effect.Freeze: Rim.freeze,
    handoff_effect.Resume: Rim.let_go_on,
    handoff_effect.After: Rim.after,
    handoff_effect.AttemptFailed: Rim.attempt_failed,
    handoff_effect.HandedOver: Rim.handed_over,
}
"""What carries each effect out; the others change nothing in the world."""
