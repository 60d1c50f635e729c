"""Searches the join of a task's register with the life of its actor: all that can happen to it on one agent.

The registrar, the service's rim, the actor and the other agents are a small world around the product's own rules
(`rules`), join (`reconcile`) and life (`lifecycle_table`). Of the messages of other agents there is what they mean for
the rules: the heir asks, owns the task, or offers it back.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

from pancakes.control import Refusal
from pancakes.durable import reconcile, rules
from pancakes.durable.reconcile import Course, Now, Write, handle
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import BLANK, NO_EPOCH, NOBODY, Epoch, Identity, Register, Standing, Wanted
from pancakes.durable.register_messages import Outcome
from pancakes.durable.rules import Desired, Lease, Memory, Place, desired
from pancakes.supervision import lifecycle
from pancakes.supervision.lifecycle import ACTOR, UNDECIDED, Life, Request, State
from pancakes.supervision.restart import Restarts, RestartSpec

A, B, C = Identity("a"), Identity("b"), Identity("c")
TASK: Final = TaskId("a", "Task")
BIRTH, LATER = b"birth", b"later"
SEQUEL: Final = b"what follows"
MEMBERS: Final = (A, B, C)


class Bounds(NamedTuple):
    """How often each thing may happen in one history.

    Attributes:
        requests: a start, a stop or a restart is asked for.
        moves: another agent is chosen as the heir.
        visits: the other agent offers the task.
        spawns: an actor is made; after that its start is refused.
        ends: the actor ends by itself.
        errors: whether it may do so by an error, and cannot stand still.
        faults: a write fails.
        crashes: the agent crashes, and comes back.
        closes: whether the service ends, and begins again.
        disputes: another agent owns the task too.
        removals: it is removed.
        guarded: whether other agents decide with its owner.
        lapses: the permit of a guarded task lapses.
        restart: its policy.
        configured: whether its configuration names it, so that its place stays when it leaves.
    """

    requests: int = 0
    moves: int = 0
    visits: int = 0
    spawns: int = 2
    ends: int = 0
    errors: bool = False
    faults: int = 0
    crashes: int = 0
    closes: bool = False
    disputes: int = 0
    removals: int = 0
    guarded: bool = False
    lapses: int = 1
    restart: RestartSpec = RestartSpec("no", at_most=1)
    configured: bool = True


class World(NamedTuple):
    """What there is.

    Attributes:
        life: the life of the task; None: it has no place.
        course: how it stands besides.
        register: what is on disk.
        memory: what the registrar remembers.
        sequel: what follows, on disk.
        queue: what the service has told the registrar: what for, the event, the sequel.
        again: a write that failed, and is tried again.
        waits: writes that do not count yet.
        actor: empty: none; "made", "runs", "still"; "told": told to end; "told early": that, before it ran.
        inbox: what the actor has still to read: the number of a migration, or None: it may go on.
        stood: what it has answered.
        timers: the events that are to come some time.
        carried: with what it came to rest; empty: what is on disk.
        open: the requests that are not answered.
        parts: how much of what follows a migration is still to be done.
        closing: how far the service is with its end: empty, "told", "over".
        settled: whether the last start is decided.
        spent: how often each of the things in `Bounds` has happened.
    """

    life: Life | None
    course: Course
    register: Register
    memory: Memory = Memory()
    sequel: bytes = b""
    queue: tuple[tuple[Write | None, Any, bytes], ...] = ()
    again: tuple[Write | None, Any, bytes] | None = None
    waits: tuple[Write, ...] = ()
    actor: str = ""
    inbox: tuple[int | None, ...] = ()
    stood: tuple[tuple[int, bool], ...] = ()
    timers: frozenset[Any] = frozenset()
    carried: bytes = b""
    open: frozenset[tuple[int, str]] = frozenset()
    parts: int = 0
    closing: str = ""
    settled: bool = True
    spent: tuple[tuple[str, int], ...] = ()

    @property
    def place(self) -> Place:
        return Place(A, self.register, self.memory, Lease())

    @property
    def record(self) -> Record:
        return Record(TASK, self.register, A, "client", "test.Task", sequel=self.sequel)

    @property
    def desired(self) -> Desired:
        return desired(A, self.register, self.memory)

    def has(self, what: str) -> int:
        return dict(self.spent).get(what, 0)

    def spend(self, what: str) -> World:
        spent = dict(self.spent)
        spent[what] = spent.get(what, 0) + 1
        return self._replace(spent=tuple(sorted(spent.items())))


class Violation(Exception):
    """A promise is broken."""


class Result(NamedTuple):
    """What a search found: how many worlds, which pairs of a life's state and a standing, and a violation."""

    worlds: int
    met: Counter[tuple[State | None, Standing]]
    violation: str
    history: tuple[str, ...]


class Joined:
    """Searches all histories within bounds."""

    def __init__(self, bounds: Bounds, limit: int = 400_000) -> None:
        self._bounds = bounds
        self._limit = limit

    # The service -----------------------------------------------------------------------------------------------

    def feed(self, world: World, *events: Any) -> World:
        """Feed events to the task, and carry out what follows."""
        waiting = deque(events)
        while waiting:
            at = Now("a", 0.0, lambda low, high: high, bool(world.closing))
            event = waiting.popleft()
            try:
                life, course, effects = handle(world.life, world.course, event, at)
            except (KeyError, AssertionError, ValueError) as error:
                state = world.life.state.name if world.life is not None else "no life"
                raise Violation(f"{type(event).__name__} in {state}: {error!r}") from None
            world = world._replace(life=life, course=course)
            for effect in effects:
                world = self.carry_out(world, effect, waiting)
        return world

    def carry_out(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        """Carry out one effect."""
        carry = getattr(self, f"_{type(effect).__module__.rpartition('.')[2]}_{type(effect).__name__}", None)
        return carry(world, effect, waiting) if carry is not None else world

    def _reconcile_Tell(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        return world._replace(queue=(*world.queue, (effect.write, effect.event, effect.sequel)))

    def _reconcile_AskRoom(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        if world.has("spawns") >= self._bounds.spawns:
            waiting.append(reconcile.Room("it lacks something"))
        else:
            may_begin = world.course.record.may_begin
            waiting.append(reconcile.Room(snapshot=world.carried or (BIRTH if may_begin else b"")))
        return world

    def _reconcile_OpenPlace(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        if world.life is not None:
            raise Violation("a place is opened beside the one that it has")
        waiting.append(reconcile.PlaceFree())
        return world._replace(life=self._life())

    def _reconcile_Prepare(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        if world.actor:
            raise Violation("its place is prepared while its actor is there")
        full = world.has("spawns") >= self._bounds.spawns
        reason = lifecycle.CLOSES if world.closing else "it lacks something" if full else ""
        waiting.append(lifecycle.LeaveRefused(reason) if reason else lifecycle.Admitted())
        return world._replace(carried=b"")

    def _lifecycle_Spawn(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        register = world.register
        if world.actor:
            raise Violation("a second actor is made beside the first")
        if register.owner != A or register.wanted is not Wanted.RUNNING or register.promised > register.epoch:
            raise Violation(f"it starts, and its record is {world.record.standing.name}, {register.wanted.name}")
        if register.heir != NOBODY:
            raise Violation("it starts while it is offered")
        if world.closing:
            raise Violation("it starts while its service ends")
        return world.spend("spawns")._replace(actor="made", carried=b"", inbox=(), stood=())

    def _lifecycle_TellToEnd(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        if world.actor not in ("made", "runs", "still"):
            raise Violation("an actor is told to end that is not there, or was told before")
        return world._replace(actor="told early" if world.actor == "made" else "told", inbox=())

    def _lifecycle_TryAt(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        return world._replace(timers=world.timers | {lifecycle.TryDue(effect.due_s)})

    def _lifecycle_LookAgain(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        return world._replace(timers=world.timers | {lifecycle.Retry()})

    def _lifecycle_LetGo(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        if world.actor in ("made", "runs", "still"):
            raise Violation("what it holds is taken back while it runs")
        return world

    def _lifecycle_Settle(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        return world._replace(settled=True)

    def _lifecycle_AskLeave(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        raise Violation("the join does not take AskLeave")

    def _lifecycle_WriteRest(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        if world.actor:
            raise Violation("it comes to rest while its actor is there")
        waiting.append(reconcile.CameToRest(world.carried))
        return world

    def _lifecycle_Answer(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        asked = next((it for it in world.open if it[0] == effect.asker.number), None)
        if asked is None:
            raise Violation(f"request {effect.asker.number} is answered twice")
        register = world.register
        if not effect.reason and asked[1] == "stop":
            if world.actor:
                raise Violation("a stop was answered, and its actor is there")
            is_ours = register.owner == A and register.promised <= register.epoch
            if is_ours and register.wanted is Wanted.RUNNING:
                raise Violation("a stop was answered that is not on disk")
            if is_ours and Write.REST in world.waits and register.sets != ((A,),):
                raise Violation("a stop was answered that does not count yet")
        elif not effect.reason and world.actor != "runs":
            raise Violation(f"a {asked[1]} was answered, and it does not run")
        return world._replace(open=world.open - {asked})

    def _reconcile_Rested(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        if world.actor:
            raise Violation("it has come to rest, and its actor is there")
        return world._replace(closing="over") if world.closing == "told" else world

    def _reconcile_Freeze(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        if world.actor not in ("runs", "still"):
            raise Violation("it is to stand still, and does not run")
        timers = world.timers | {reconcile.StillOverdue(effect.number)}
        return world._replace(inbox=(*world.inbox, effect.number), timers=timers)

    def _reconcile_TakeDown(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        if world.actor != "still" or None in world.inbox:
            raise Violation("it is written down for another agent, and goes on")
        waiting.append(reconcile.Frozen(LATER, SEQUEL))
        return world

    def _reconcile_LetGoOn(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        return world._replace(inbox=(*world.inbox, None)) if world.actor in ("runs", "still") else world

    _reconcile_Resume = _reconcile_LetGoOn

    def _reconcile_Drop(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        if effect.ends != bool(world.actor):
            raise Violation("its actuators are taken from an actor that is not there, or left to one that is")
        return world

    def _reconcile_Vacate(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        if world.actor:
            raise Violation("its place is cleared while its actor is there")
        if self._bounds.configured:
            return world._replace(carried=b"")
        timers = frozenset(it for it in world.timers if not isinstance(it, lifecycle.TryDue | lifecycle.Retry))
        return world._replace(carried=b"", life=None, timers=timers)

    def _reconcile_After(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        if isinstance(effect.event, reconcile.InDoubt):
            return world
        return world._replace(timers=world.timers | {effect.event})

    def _reconcile_HandedOver(self, world: World, effect: Any, waiting: deque[Any]) -> World:
        return world._replace(parts=world.parts + 2)

    # The registrar ---------------------------------------------------------------------------------------------

    def came(self, world: World, *outcomes: Any) -> World:
        """Tell the service how the task stands."""
        return self.feed(world, reconcile.Came(world.record, world.desired, outcomes))

    def rule(self, world: World, event: Any) -> tuple[World, bool]:
        """Have a rule applied, which writes without a fault; return whether it has written."""
        has_written = False
        for effect in rules.handle(world.place, event):
            match effect:
                case rules.Persist():
                    has_written = True
                    world = world._replace(register=effect.register)
                case rules.Remember():
                    world = world._replace(memory=effect.memory)
        return world, has_written

    def outside(self, before: World, event: Any) -> World:
        """Another agent, or a person, has a rule applied."""
        world, has_written = self.rule(before, event)
        if not has_written:
            return world if world.desired is before.desired else self.came(world)
        return self.came(*self._lapsed(before, world))

    def _lapsed(self, before: World, world: World) -> tuple[Any, ...]:
        register = world.register
        if register.owner == A and register.promised <= register.epoch:
            world = world._replace(sequel=b"" if register.heir == NOBODY else world.sequel)
        if (before.register.epoch, before.record.owned) == (register.epoch, world.record.owned):
            return (world,)
        lapsed = tuple((write, Outcome.LAPSED, "") for write in world.waits)
        return (world._replace(waits=()), *lapsed)

    def _of_the_registrar(self, world: World) -> Iterator[tuple[str, World]]:
        bounds = self._bounds
        if world.again is not None:
            yield "the write is tried again", world._replace(queue=(world.again, *world.queue), again=None)
        if not world.queue:
            return
        (write, event, sequel), *rest = world.queue
        taken = world._replace(queue=tuple(rest))
        late: tuple[Any, ...] = ()
        if world.again is not None:
            late = ((world.again[0], Outcome.FAILED, "something else was decided since"),)
            taken = taken._replace(again=None)
        done, has_written = self.rule(taken, event)
        if write is None:
            done, *lapsed = self._lapsed(taken, done)
            yield "the registrar takes it", self.came(done, *late, *lapsed)
            return
        if not has_written:
            yield "the registrar declines it", self.came(done, *late, (write, Outcome.DECLINED, ""))
            return
        if isinstance(event, rules.Offer):
            done = done._replace(sequel=sequel)
        done, *lapsed = self._lapsed(taken, done)
        outcomes = [*late, *lapsed, (write, Outcome.WRITTEN, "")]
        if done.register.unguarded:
            outcomes.append((write, Outcome.COUNTS, ""))
        else:
            done = done._replace(waits=(*done.waits, write))
        yield f"{write.name} is written", self.came(done, *outcomes)
        if world.has("faults") < bounds.faults:
            failed = taken.spend("faults")
            if isinstance(event, rules.Begin | rules.Want):
                failed = failed._replace(again=(write, event, sequel))
                yield f"{write.name} is put off", self.came(failed, *late, (write, Outcome.DELAYED, "the disk is full"))
            else:
                yield f"{write.name} fails", self.came(failed, *late, (write, Outcome.FAILED, "the disk is full"))

    def _of_the_members(self, world: World) -> Iterator[tuple[str, World]]:
        register = world.register
        writes = register.owner == A and register.promised <= register.epoch
        if not writes or register.unguarded:
            return
        if world.waits and not world.memory.offered:
            counted = tuple((write, Outcome.COUNTS, "") for write in world.waits)
            yield "enough members have it", self.came(world._replace(waits=()), *counted)
        if not world.memory.permit and register.heir == NOBODY:
            yield "its members let it act", self.came(world._replace(memory=world.memory._replace(permit=1)))
        if world.memory.permit and world.has("lapses") < self._bounds.lapses:
            lapsed = world.spend("lapses")._replace(memory=world.memory._replace(permit=0))
            yield "its permit lapses", self.came(lapsed)
        if not world.memory.permit and world.has("takings") < 1:
            taken = register._replace(epoch=Epoch(register.epoch.n + 1, B), no=0, heir=NOBODY, promised=NO_EPOCH)
            message = rules.Confirmed(rules.Accept(taken, 0))
            yield "another member has taken it over", self.outside(world.spend("takings"), message)

    # Other agents and people -----------------------------------------------------------------------------------

    def _of_others(self, world: World) -> Iterator[tuple[str, World]]:
        register, bounds, standing = world.register, self._bounds, world.record.standing
        if standing is Standing.OFFERED and register.heir == B:
            epoch = Epoch(register.epoch.n + 1, B, register.no)
            if register.unguarded:
                asks = rules.Prepare(epoch, register.stamp, register.sets)
                yield "the heir asks for it", self.outside(world, asks)
            else:
                owned = register._replace(epoch=epoch, no=0, heir=NOBODY, promised=NO_EPOCH)
                accept = rules.Confirmed(rules.Accept(owned, 0))
                yield "the members have given it to the heir", self.outside(world, accept)
            refused = self.feed(world, reconcile.Refused(Refusal("unable", "it lacks something")))
            yield "the heir declines it", self.outside(refused, rules.GiveUp())
        if standing is Standing.YIELDED:
            owned = Register(register.promised, 0, ((B,),))
            yield "the heir has it", self.outside(world, rules.Known(B, owned))
        is_away = standing in (Standing.RELEASED, Standing.MEMBER) and not world.record.removed
        # It bids only once it knows that the task has left, and has written all that came before.
        may_bid = not world.course.leaving and not world.queue and world.again is None
        if is_away and may_bid and world.has("visits") < bounds.visits:
            sets = register.sets if len(register.sets[0]) > 1 else ((B,),)
            offered = Register(register.epoch, max(register.no, 0) + 1, sets, 0, A, Wanted.RUNNING, LATER)
            accept = rules.Confirmed(rules.Accept(offered, 0, A))
            yield "the other agent offers it", self.outside(world.spend("visits"), accept)
        if standing is Standing.HEIR and world.memory.taking != NO_EPOCH:
            last = register._replace(promised=world.memory.taking)
            heard = world
            for by in (B, C) if len(register.sets[0]) > 1 else (B,):
                heard, _ = self.rule(heard, rules.Promise(world.memory.taking, by, last))
            if heard.register != world.register:
                yield "it is given away to this agent", self.came(heard)
            later = register._replace(no=register.no + 1, heir=NOBODY, state=None, promised=NO_EPOCH)
            yield "the other agent takes its offer back", self.outside(world, rules.Known(B, later))
        if standing is Standing.OWNER and register.unguarded and world.has("disputes") < bounds.disputes:
            owned = Register(Epoch(register.epoch.n + 3, B), 0, ((B,),))
            claim = rules.Confirmed(rules.Known(B, owned))
            yield "another agent owns it too", self.outside(world.spend("disputes"), claim)
        if standing is Standing.DISPUTED and not world.actor and not world.closing:
            force = rules.Force(register.epoch, register.state)
            yield "a person says that it is here", self._told(world, force)
            leave = rules.Leave(Register(Epoch(register.epoch.n + 3, B), 0, ((B,),)))
            yield "a person says that it is not here", self._told(world, leave)
        rests = world.life is not None and world.life.at_rest and register.wanted is not Wanted.RUNNING
        if standing is Standing.OWNER and rests and not world.closing and world.has("removals") < bounds.removals:
            yield "it is removed", self._told(world.spend("removals"), rules.Want(Wanted.REMOVED))

    def _told(self, world: World, event: Any) -> World:
        """A person has the service tell the registrar something, once."""
        is_told = any(it[0] is None for it in world.queue)
        return world if is_told else world._replace(queue=(*world.queue, (None, event, b"")))

    def _of_requests(self, world: World) -> Iterator[tuple[str, World]]:
        life, course = world.life, world.course
        if life is None or life.asker is not None or world.closing:
            return
        if course.leaving or course.record.in_doubt:
            return
        if world.has("requests") < self._bounds.requests:
            number = world.has("requests") + 1
            request = Request("b/task", ("b/task", number), number)
            for what in ("start", "stop", "restart"):
                if what != "stop" and course.paused:
                    continue
                asked = world.spend("requests")._replace(open=world.open | {(number, what)})
                rests = (State.STOPPED, State.REFUSED, State.FAILED, State.RESTARTING)
                if what == "start" and life.state in rests:
                    yield "a start is asked for", self.feed(asked, lifecycle.StartAsked(request))
                elif what == "stop" and life.state is not State.STOPPED and course.record.owned:
                    yield "a stop is asked for", self.feed(asked, lifecycle.StopAsked(request, "asked for"))
                elif what == "restart":
                    yield "a restart is asked for", self.feed(asked, lifecycle.StopAsked(request, "asked", again=True))
        may_move = course.record.owned and course.record.wanted is Wanted.RUNNING
        if may_move and world.has("moves") < self._bounds.moves:
            yield "the other agent is chosen", self.feed(world.spend("moves"), reconcile.Award(B))

    # The actor, timers, and the end of the service -------------------------------------------------------------

    def _of_the_actor(self, world: World) -> Iterator[tuple[str, World]]:
        actor, bounds = world.actor, self._bounds
        if world.stood:
            (number, is_still), *later = world.stood
            told = reconcile.StoodStill(number, "carried" if is_still else None, "" if is_still else "it cannot")
            yield "it answers whether it stands still", self.feed(world._replace(stood=tuple(later)), told)
            return
        if world.inbox:
            asked, *unread = world.inbox
            read = world._replace(inbox=tuple(unread))
            if asked is None:
                yield "it goes on", read._replace(actor="runs" if actor == "still" else actor)
            else:
                yield "it stands still", read._replace(actor="still", stood=((asked, True),))
                if bounds.errors:
                    yield "it cannot stand still", read._replace(actor="runs", stood=((asked, False),))
        if actor == "made":
            yield "it runs", self.feed(world._replace(actor="runs"), lifecycle.Began())
        elif actor == "told early":
            yield "it runs, late", self.feed(world._replace(actor="told"), lifecycle.Began())
        ends = actor in ("told", "told early")
        if actor and (ends or world.has("ends") < bounds.ends):
            gone = (world if ends else world.spend("ends"))._replace(actor="", inbox=())
            closing = bool(world.closing)
            carried = LATER if actor not in ("made", "told early") else b""
            yield "it ends", self.feed(gone._replace(carried=carried), lifecycle.Finished("it ended", closing=closing))
            if bounds.errors and not ends:
                yield "it fails", self.feed(gone, lifecycle.Finished("it failed", True, closing=closing))

    def _of_time(self, world: World) -> Iterator[tuple[str, World]]:
        for timer in sorted(world.timers, key=str):
            yield f"{type(timer).__name__} comes", self.feed(world._replace(timers=world.timers - {timer}), timer)
        if world.parts:
            rest = world._replace(parts=world.parts - 1)
            yield "a part of what follows is done", rest if rest.parts else rest._replace(sequel=b"")
        if any(write is Write.REST for write in world.waits):
            yield "its members do not confirm its rest", self.feed(world, reconcile.RestOverdue("too few confirm it"))

    def _of_the_service(self, world: World) -> Iterator[tuple[str, World]]:
        life, bounds = world.life, self._bounds
        if bounds.closes and not world.closing and life is not None:
            if life.at_rest:
                yield "its service ends", world._replace(closing="over")
            else:
                told = world._replace(closing="told")
                yield "its service ends", self.feed(told, lifecycle.StopAsked(reason=lifecycle.CLOSES))
        is_over = world.closing == "over" and not world.queue and world.again is None
        if is_over and world.has("restarts") < 1:
            again = world.spend("restarts")
            yield "its service begins again", self.begin(again.register, again.sequel, again.memory, again.spent)
        if world.has("crashes") < bounds.crashes:
            down = world.spend("crashes")._replace(memory=Memory())
            register, sequel = down.register, down.sequel
            for effect in rules.recover(down.place, 0):
                if isinstance(effect, rules.Persist):
                    register = effect.register  # the service begins after the registrar
            yield "the agent crashes, and comes back", self.begin(register, sequel, Memory(), down.spent)

    # The search ------------------------------------------------------------------------------------------------

    def _life(self) -> Life:
        return Life("a/client/Task", Restarts(self._bounds.restart))

    def begin(self, register: Register, sequel: bytes, memory: Memory, spent: Any) -> World:
        """Begin the service, with what is on disk."""
        record = Record(TASK, register, A, "client", "test.Task", sequel=sequel)
        course = Course(record, desired(A, register, Memory()))
        life = self._life() if self._bounds.configured or record.owned else None
        world = World(life, course, register, memory, sequel, spent=spent, settled=False)
        wanted = record.may_begin or not record.owned or record.wanted is Wanted.RUNNING
        world = self.feed(world, reconcile.ServiceBegan()) if wanted else world
        return self.came(world)

    def first(self) -> Iterator[tuple[str, World]]:
        """Yield the worlds in which a history begins."""
        yield "its service begins, and it is new", self.begin(BLANK, b"", Memory(), ())
        epoch = Epoch(0, A)
        sets = (MEMBERS,) if self._bounds.guarded else ((A,),)
        owned = Register(epoch, 0, sets, state=BIRTH, promised=epoch)
        yield "its service begins, and it is here", self.begin(owned, b"", Memory(), ())
        if self._bounds.visits:
            away = Register(Epoch(1, B), 1, sets if self._bounds.guarded else ((B,),), promised=Epoch(1, B))
            yield "its service begins, and it is elsewhere", self.begin(away, b"", Memory(), ())

    def after(self, world: World) -> Iterator[tuple[str, World]]:
        """Yield what can happen next."""
        if world.closing != "over":
            yield from self._of_the_registrar(world)
            yield from self._of_the_actor(world)
            yield from self._of_time(world)
            yield from self._of_requests(world)
        elif world.queue:
            yield from self._of_the_registrar(world)
        yield from self._of_the_members(world)
        yield from self._of_others(world)
        yield from self._of_the_service(world)

    def check(self, world: World) -> None:
        """Check what must hold at each moment.

        Raises:
            Violation: it does not.
        """
        life, course, register = world.life, world.course, world.register
        if course.record.register != register:
            raise Violation("its service does not know how it stands")
        gone = register.owner != A or register.promised > register.epoch or register.heir != NOBODY
        if world.actor == "runs" and gone and None not in world.inbox and not self._bounds.guarded:
            raise Violation(f"it acts, and its record is {world.record.standing.name}")
        if life is None:
            return
        if life.state in ACTOR and not world.actor:
            raise Violation(f"it is {life.state.name} without an actor")
        if life.state not in ACTOR and world.actor:
            raise Violation(f"it is {life.state.name}, and its actor is there")
        if Counter(course.pending) != _under_way(world):
            raise Violation("it waits for a write that is not under way, or does not know of one")
        if world.closing or world.queue or world.again or world.inbox or world.stood:
            return
        if course.leaving and world.actor in ("made", "runs", "still"):
            raise Violation("it has left, and nothing ends its actor")
        if world.actor == "runs" and register.owner == A and register.wanted is not Wanted.RUNNING:
            raise Violation(f"it runs, and is wanted {register.wanted.name}")
        if life.state in UNDECIDED and not (course.granted and world.desired is not Desired.RUN):
            raise Violation("it waits for leave that nothing gives")
        if course.rests and not world.waits:
            raise Violation("its rest waits for what never comes")
        if life.asker is not None and life.state in (State.STOPPED, State.FAILED) and not course.rests:
            raise Violation("a request waits for what never comes")
        is_timed = any(isinstance(it, reconcile.GiveUpDue | reconcile.StillOverdue) for it in world.timers)
        if course.moving is not None and not is_timed and register.promised <= register.epoch:
            raise Violation("its migration never ends")
        if register.owner == A and register.heir != NOBODY and register.promised <= register.epoch:
            if course.moving is None:
                raise Violation("it is offered, and nothing takes that back")
        if world.desired is Desired.RUN and life.state is State.STOPPED and not course.leaving:
            raise Violation("it is to run, and nothing starts it")
        if world.actor == "still" and world.desired is Desired.RUN and course.moving is None:
            raise Violation("it stands still for ever")

    def run(self) -> Result:
        """Search everything."""
        seen: dict[World, tuple[World | None, str]] = {}
        met: Counter[tuple[State | None, Standing]] = Counter()
        waiting: deque[World] = deque()
        world: World | None = None
        what = ""

        def told(last: str) -> tuple[str, ...]:
            steps, at = [last], world
            while at is not None:
                at, step = seen[at]
                steps.append(step)
            return tuple(reversed(steps))

        try:
            following = self.first()
            while True:
                for what, then in following:
                    if then not in seen:
                        seen[then] = (world, what)
                        met[then.life.state if then.life is not None else None, then.record.standing] += 1
                        self.check(then)
                        waiting.append(then)
                if not waiting:
                    return Result(len(seen), met, "", ())
                if len(seen) > self._limit:
                    return Result(len(seen), met, "unfinished", ())
                world, what = waiting.popleft(), "?"
                following = self.after(world)
        except Violation as violation:
            return Result(len(seen), met, str(violation), told(what))


def _under_way(world: World) -> Counter[Write]:
    items = (*world.queue, *((world.again,) if world.again is not None else ()))
    return Counter(it[0] for it in items if it[0] is not None)
