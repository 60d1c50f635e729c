"""Exhaustive search of the hand-off's core, in the product's own types.

The fault model, unbounded unless noted:

* the network is the set of all messages ever sent: delivering one does not remove it, and nothing must ever
  be delivered. That covers loss, doubling, reordering, delay and every partition;
* any agent crashes and restarts between any two effects: what is volatile is gone, the record on disk stays;
* any timer fires at any time, and any packet for the task arrives at any time, any number of times;
* a destination may refuse any reservation and any snapshot, a task may fail to stop;
* bounded: agents, offers, packets, restarts of the task's actor, failed writes (where the disk then holds
  the old record or the new one), lost disks.

Safety, in every state: S1 at most one copy runs; S2 the epoch that runs never goes back; S3 what was
acknowledged is in the state that runs; S4 every packet takes effect once; S5 no two owners under one epoch.
Liveness, from every configuration of the agents: L1 when crashes and loss end, a few rounds of the timers
lead to exactly one copy, nobody in doubt, everything applied and acknowledged.

Agents' local steps are computed once and remembered; the search itself then works on small numbers.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from pancakes.migration import core, snapshot
from pancakes.migration.effect import Ack, Discard, Effect, Freeze, Persist, Remember, Resume, Send, StartTask
from pancakes.migration.event import (
    Award,
    Checkpoint,
    Event,
    FreezeFailed,
    Frozen,
    GiveUp,
    PacketId,
    PersistFailed,
    Received,
    Resend,
    ReservationExpired,
    Start,
)
from pancakes.migration.messages import Reserve, Reserved, Solicit, Transfer
from pancakes.migration.record import NO_EPOCH, Epoch, Phase, Record, TaskId
from pancakes.migration.snapshot import Heard, Snapshot
from pancakes.migration.volatile import Volatile

TASK = TaskId("A", "ScanTarget")
REQUEST = Solicit(TASK, 1, "encirclement.ScanTarget", "1.0")


class Violation(Exception):
    """A promise is broken; the message says which."""


class App(NamedTuple):
    """The state of the task under search: how many packets had an effect, and its duplicate filter."""

    effects: int = 0
    upto: int = 0


class Actor(NamedTuple):
    """The task's object on one agent: at work, or stopped."""

    app: App
    running: bool
    epoch: Epoch
    incarnation: int


class Agent(NamedTuple):
    """One agent: what is on its disk, what it holds for true, what it knows until it crashes, its actor."""

    disk: Record
    memory: Record
    volatile: Volatile
    actor: Actor | None


class World(NamedTuple):
    agents: tuple[int, ...]
    net: int
    acked: int
    top: Epoch
    faults: int
    wiped: int


class Outcome(NamedTuple):
    """What one step of one agent does to the world."""

    label: str
    agent: int
    sends: int = 0
    acked: int = 0
    """The highest packet acknowledged in it."""
    kept: int = 1 << 30
    """The highest packet that a crash left (lazy durability may forget what follows the checkpoint)."""
    started: tuple[Epoch, ...] = ()
    before_crash: int = -1
    """The agent just before it crashed: what it had started counts."""
    fault: bool = False


@dataclass(frozen=True)
class Core:
    """The functions under search; the product's, or a mutant's."""

    handle: Callable[..., list[Effect]] = core.handle
    recover: Callable[..., list[Effect]] = core.recover
    decode: Callable[[bytes], Snapshot] = snapshot.Snapshot.decode


@dataclass(frozen=True)
class Keep:
    """An effect that only a mutant asks for: believe a record without writing it."""

    record: Record


@dataclass
class Result:
    """What a search has found."""

    violation: str
    states: int
    transitions: int
    configurations: int
    trace: list[str] = field(default_factory=list)
    complete: bool = True


class Search:
    """Searches all that can happen within the given bounds.

    Args:
        agents: how many.
        offers: how many hand-offs may be tried.
        packets: how many packets are sent to the task.
        durability: `each` or `lazy`.
        refusals: whether destinations refuse and tasks fail to stop.
        reserve: whether reservations are exchanged; else the answer may appear at any time (more can happen,
            in fewer states).
        restarts: how often a task's actor may fail and be started again.
        faults: how many writes fail.
        wipes: how many disks are lost.
        under_test: the core.
        strict: also asks that `seen` never goes down on a disk, at once.
        most_states: gives up, incomplete, beyond this.
    """

    def __init__(
        self,
        agents: int = 2,
        offers: int = 2,
        packets: int = 1,
        durability: str = "each",
        refusals: bool = True,
        reserve: bool = True,
        restarts: int = 0,
        faults: int = 0,
        wipes: int = 0,
        under_test: Core | None = None,
        strict: bool = True,
        most_states: int = 3_000_000,
    ) -> None:
        self.names = tuple("ABCDE"[:agents])
        self.offers, self.packets, self.restarts = offers, packets, restarts
        self.faults, self.wipes = faults, wipes
        self.lazy = durability == "lazy"
        self.refusals, self.reserve, self.strict = refusals, reserve, strict
        self.core = under_test or Core()
        self.most_states = most_states
        self.transitions = 0
        self._agents: list[Agent] = []
        self._agent_ids: dict[Agent, int] = {}
        self._messages: list[tuple[str, str, Any]] = []
        self._message_ids: dict[tuple[str, str, Any], int] = {}
        self._local: dict[tuple[int, int, Any], tuple[Outcome, ...]] = {}
        self._events: dict[tuple[int, int], tuple[Any, ...]] = {}
        self._written: dict[App, bytes] = {}
        self._read: dict[bytes, App] = {}

    # -- the task ---------------------------------------------------------------------------------------------

    def write(self, app: App) -> bytes:
        """Returns the task's snapshot, the product's own, with its duplicate filter."""
        data = self._written.get(app)
        if data is None:
            heard = {"sender": Heard(app.upto)}
            whole = Snapshot(TASK, REQUEST.type, "1.0", "client", state={"effects": app.effects}, heard=heard)
            data = self._written[app] = whole.encode()
        return data

    def read(self, data: bytes) -> App:
        """Returns what a task that is started from a snapshot begins with."""
        app = self._read.get(data)
        if app is None:
            whole = self.core.decode(data)
            app = self._read[data] = App(whole.state["effects"], whole.heard.get("sender", Heard()).upto)
        return app

    # -- local steps ------------------------------------------------------------------------------------------

    def _agent_id(self, agent: Agent) -> int:
        number = self._agent_ids.setdefault(agent, len(self._agents))
        if number == len(self._agents):
            self._agents.append(agent)
        return number

    def _bit(self, source: str, destination: str, message: Any) -> int:
        key = (source, destination, message)
        number = self._message_ids.setdefault(key, len(self._messages))
        if number == len(self._messages):
            self._messages.append(key)
        return 1 << number

    def _carry_out(self, i: int, agent: Agent, effects: list[Effect]) -> tuple[Agent, int, int, tuple[Epoch, ...]]:
        """Returns the agent after the effects, what it sent and acknowledged, and the epochs it started."""
        disk, memory, volatile, actor = agent
        sends = acked = 0
        started: list[Epoch] = []
        for effect in effects:
            match effect:
                case Persist():
                    if self.strict and effect.record.seen < memory.seen:
                        raise Violation("the highest epoch seen went down on a disk")
                    disk = memory = effect.record
                case Keep():
                    memory = effect.record
                case Remember():
                    volatile = effect.volatile
                case Send():
                    sends |= self._bit(self.names[i], effect.peer, effect.message)
                case StartTask():
                    actor = Actor(self.read(effect.snapshot), True, effect.epoch, effect.incarnation)
                    started.append(effect.epoch)
                case Resume():
                    app = self.read(effect.snapshot) if actor is None else actor.app
                    actor = Actor(app, True, effect.epoch, effect.incarnation)
                    started.append(effect.epoch)
                case Freeze():
                    assert actor is not None
                    actor = actor._replace(running=False)
                case Discard():
                    if actor is not None and actor.running:
                        raise Violation("a running task was thrown away")
                    actor = None
                case Ack():
                    acked = max(acked, effect.packet.seq)
        return Agent(disk, memory, volatile, actor), sends, acked, tuple(started)

    def _crash(self, i: int, agent: Agent) -> tuple[Agent, int, tuple[Epoch, ...], int]:
        """Returns the agent after a crash and restart, what it sent and started, and the packets it kept."""
        record = agent.disk
        kept = 1 << 30
        lost_its_write = record.phase is Phase.FROZEN and agent.memory.phase is Phase.OWNER
        if self.lazy and (record.phase is Phase.OWNER or lost_its_write):
            kept = self.read(record.snapshot).upto
        fresh = Agent(record, record, Volatile(), None)
        after, sends, _, started = self._carry_out(i, fresh, self.core.recover(record))
        return after, sends, started, kept

    def _handle(self, i: int, agent: Agent, event: Event) -> tuple[Agent, list[Effect]]:
        """Returns the agent as it is when the event reaches the core, and the core's decision."""
        if isinstance(event, Start) and event.again:
            agent = agent._replace(actor=None)
        if isinstance(event, FreezeFailed) and agent.actor is not None:
            agent = agent._replace(actor=agent.actor._replace(running=True))
        return agent, self.core.handle(self.names[i], agent.memory, agent.volatile, event)

    def _steps(self, i: int, number: int, event: Any) -> tuple[Outcome, ...]:
        """Returns all outcomes of one event at one agent: whole, cut by a crash, cut by a failed write."""
        key = (i, number, event)
        outcomes = self._local.get(key)
        if outcomes is None:
            outcomes = self._local[key] = tuple(self._make_steps(i, number, event))
        return outcomes

    def _make_steps(self, i: int, number: int, event: Any) -> Iterator[Outcome]:
        agent, who = self._agents[number], self.names[i]
        if event == "crash":
            after, sends, started, kept = self._crash(i, agent)
            yield Outcome(f"{who} crashes and restarts", self._agent_id(after), sends, 0, kept, started)
            return
        if isinstance(event, PacketId):
            yield from self._packet(i, agent, event)
            return
        agent, effects = self._handle(i, agent, event)
        if not effects:
            return
        label = f"{who}: {describe(event)}"
        after, sends, acked, started = self._carry_out(i, agent, effects)
        kept = 1 << 30
        if isinstance(event, Start) and self.lazy and agent.memory.snapshot:
            kept = self.read(agent.memory.snapshot).upto
        yield Outcome(label, self._agent_id(after), sends, acked, kept, started)
        for cut in range(1, len(effects)):
            if not _matters(effects[cut - 1]) and cut > 1:
                continue
            part, sends, acked, started = self._carry_out(i, agent, effects[:cut])
            after, more, restarted, left = self._crash(i, part)
            yield Outcome(
                f"{label}, crashes after {_names(effects[:cut])}",
                self._agent_id(after),
                sends | more,
                acked,
                left,
                started + restarted,
                self._agent_id(part),
            )
        yield from self._failed_writes(i, agent, effects, label, kept)

    def _failed_writes(self, i: int, agent: Agent, effects: list[Effect], label: str, kept: int) -> Iterator[Outcome]:
        for at, effect in enumerate(effects):
            if not isinstance(effect, Persist) or not self.faults:
                continue
            part, sends, acked, started = self._carry_out(i, agent, effects[:at])
            for disk in (part.disk, effect.record):
                failed = part._replace(disk=disk)
                failed, answer = self._handle(i, failed, PersistFailed("disk full", effect.record))
                after, more, more_acked, more_started = self._carry_out(i, failed, answer)
                yield Outcome(
                    f"{label}, the write fails, the disk holds {disk.phase.value}",
                    self._agent_id(after),
                    sends | more,
                    max(acked, more_acked),
                    kept,
                    started + more_started,
                    fault=True,
                )

    def _packet(self, i: int, agent: Agent, packet: PacketId) -> Iterator[Outcome]:
        actor = agent.actor
        if actor is None or not actor.running:
            return
        app = actor.app
        if packet.seq == app.upto + 1:
            app = App(app.effects + 1, packet.seq)
        acked = packet.seq if self.lazy and packet.seq <= app.upto else 0
        after = agent._replace(actor=actor._replace(app=app))
        yield Outcome(f"{self.names[i]}: packet {packet.seq}", self._agent_id(after), acked=acked)

    # -- what can happen --------------------------------------------------------------------------------------

    def _happenings(self, i: int, number: int) -> tuple[Any, ...]:
        events = self._events.get((i, number))
        if events is None:
            events = self._events[i, number] = tuple(self._make_happenings(i, self._agents[number]))
        return events

    def _make_happenings(self, i: int, agent: Agent) -> Iterator[Any]:
        me, (_, record, volatile, actor) = self.names[i], agent
        offer = Epoch(record.seen.n + 1, me)
        if actor is not None and actor.running:
            yield from (PacketId("sender", seq + 1) for seq in range(self.packets))
            yield self._checkpoint(actor)
            if not volatile.asked and record.seen.n < self.offers:
                yield from (Award(peer, REQUEST) for peer in self.names if peer != me)
            if record.incarnation < self.restarts:
                yield Start(again=True)
        elif not volatile.freezing:
            yield Start()
        if volatile.freezing and actor is not None:
            yield Frozen(offer, self.write(actor.app))
            if self.refusals:
                yield FreezeFailed(offer, "stuck")
        elif volatile.asked:
            yield ReservationExpired(volatile.asked, offer)
            if not self.reserve:
                yield Received(volatile.asked, Reserved(TASK, offer))
        if record.offer != NO_EPOCH:
            # Also in the phases where no such timer was set: one that was set before may come late.
            yield GiveUp(record.offer, "time is up")
            yield Resend(record.offer, record.phase, 0)
        yield "crash"

    def _checkpoint(self, actor: Actor) -> Checkpoint:
        consumed = () if self.lazy or not actor.app.upto else (PacketId("sender", actor.app.upto),)
        return Checkpoint(actor.epoch, actor.incarnation, self.write(actor.app), consumed)

    def _deliveries(self, i: int, net: int) -> Iterator[Received]:
        me = self.names[i]
        while net:
            low = net & -net
            net ^= low
            source, destination, message = self._messages[low.bit_length() - 1]
            if destination != me or (isinstance(message, Reserve) and not self.reserve):
                continue
            yield Received(source, message)
            if self.refusals and isinstance(message, Transfer | Reserve):
                yield Received(source, message, "lacks the device types motors")

    # -- the world --------------------------------------------------------------------------------------------

    def _apply(self, world: World, i: int, outcome: Outcome) -> World:
        top = world.top
        for epoch in outcome.started:
            if epoch < top:
                raise Violation(f"S2 {self.names[i]} starts the task under {epoch} after {top} ran")
            top = epoch
        if outcome.before_crash >= 0:
            part = world.agents[:i] + (outcome.before_crash,) + world.agents[i + 1 :]
            self._check(part, min(max(world.acked, outcome.acked), outcome.kept), world.wiped)
        agents = world.agents[:i] + (outcome.agent,) + world.agents[i + 1 :]
        acked = min(max(world.acked, outcome.acked), outcome.kept)
        return World(agents, world.net | outcome.sends, acked, top, world.faults + outcome.fault, world.wiped)

    def _wiped(self, world: World, i: int) -> World:
        """The disk is lost, and the agent set up anew. What was sent to its former self is not believed."""
        net = world.net
        for number, (_, destination, _) in enumerate(self._messages):
            if destination == self.names[i]:
                net &= ~(1 << number)
        blank = self._agent_id(Agent(Record(TASK), Record(TASK), Volatile(), None))
        agents = world.agents[:i] + (blank,) + world.agents[i + 1 :]
        return world._replace(agents=agents, net=net, wiped=world.wiped + 1)

    def _check(self, numbers: tuple[int, ...], acked: int, wiped: int) -> None:
        agents = [self._agents[number] for number in numbers]
        running = [(name, a.actor) for name, a in zip(self.names, agents, strict=True) if a.actor and a.actor.running]
        if len(running) > 1:
            raise Violation(f"S1 the task runs on {' and '.join(name for name, _ in running)}")
        for name, actor in running:
            app = actor.app
            if app.effects != app.upto:
                raise Violation(f"S4 on {name} {app.upto} packets had {app.effects} effects")
            if app.upto < acked and not wiped:
                raise Violation(f"S3 packet {acked} was acknowledged, {name} has only those up to {app.upto}")
        epochs = [a.disk.epoch for a in agents if a.disk.phase in (Phase.OWNER, Phase.FROZEN)]
        if len(epochs) != len(set(epochs)):
            raise Violation("S5 two agents own the task under one epoch")

    def _converge(self, world: World, rounds: int = 14) -> None:
        """Lets all be well from here on, every message so far being lost: exactly one copy must come of it."""
        world = world._replace(net=0, faults=self.faults)

        def feed(world: World, i: int, event: Any) -> World:
            outcomes = self._steps(i, world.agents[i], event)
            return self._apply(world, i, outcomes[0]) if outcomes else world

        for number in range(rounds):
            for i in range(len(self.names)):
                agent = self._agents[world.agents[i]]
                record, volatile, actor = agent.memory, agent.volatile, agent.actor
                offer = Epoch(record.seen.n + 1, self.names[i])
                if volatile.freezing and actor is not None:
                    world = feed(world, i, Frozen(offer, self.write(actor.app)))
                elif volatile.asked:
                    world = feed(world, i, ReservationExpired(volatile.asked, offer))
                elif record.phase is Phase.OWNER and not volatile.running:
                    world = feed(world, i, Start())
                elif number == 5 and record.phase is Phase.FROZEN:
                    world = feed(world, i, GiveUp(record.offer, "time is up"))
                elif record.offer != NO_EPOCH:
                    world = feed(world, i, Resend(record.offer, record.phase, 0))
            for i in range(len(self.names)):
                for seq in range(self.packets):
                    world = feed(world, i, PacketId("sender", seq + 1))
                actor = self._agents[world.agents[i]].actor
                if actor is not None and actor.running:
                    world = feed(world, i, self._checkpoint(actor))
            net, world = world.net, world._replace(net=0)
            while net:
                low = net & -net
                net ^= low
                source, destination, message = self._messages[low.bit_length() - 1]
                world = feed(world, self.names.index(destination), Received(source, message))
            self._check(world.agents, world.acked, world.wiped)
            agents = [self._agents[number] for number in world.agents]
            running = [a.actor for a in agents if a.actor is not None and a.actor.running]
            settled = all(a.memory.phase in (Phase.ABSENT, Phase.OWNER, Phase.RELEASED) for a in agents)
            if settled and len(running) == 1 and running[0].app.upto == self.packets <= world.acked:
                return
        story = ", ".join(
            f"{name} {a.memory.phase.value}{' and runs it' if a.actor and a.actor.running else ''}"
            for name, a in zip(self.names, (self._agents[number] for number in world.agents), strict=True)
        )
        raise Violation(f"L1 nothing comes of it in {rounds} rounds: {story}")

    # -- the search -------------------------------------------------------------------------------------------

    def run(self) -> Result:
        """Searches breadth first, so that the first violation found has a shortest trace."""
        birth = Epoch(0, "A")
        own = Record(TASK, Phase.OWNER, birth, birth, snapshot=self.write(App()))
        first = self._agent_id(Agent(own, own, Volatile(running=True), Actor(App(), True, birth, 0)))
        blank = self._agent_id(Agent(Record(TASK), Record(TASK), Volatile(), None))
        start = World((first,) + (blank,) * (len(self.names) - 1), 0, 0, birth, 0, 0)
        parents: dict[World, tuple[World, str] | None] = {start: None}
        configurations: set[tuple[tuple[int, ...], int]] = set()
        queue = deque([start])
        world, label = start, ""

        def reach(successor: World) -> None:
            self.transitions += 1
            if successor not in parents:
                parents[successor] = (world, label)
                queue.append(successor)

        try:
            while queue and len(parents) <= self.most_states:
                world, label = queue.popleft(), ""
                self._check(world.agents, world.acked, world.wiped)
                configuration = (world.agents, world.acked)
                if configuration not in configurations and not world.wiped:
                    configurations.add(configuration)
                    self._converge(world)
                for i, number in enumerate(world.agents):
                    events: list[Any] = [*self._happenings(i, number), *self._deliveries(i, world.net)]
                    for event in events:
                        label = f"{self.names[i]}: {describe(event)}"
                        for outcome in self._steps(i, number, event):
                            if outcome.fault and world.faults >= self.faults:
                                continue
                            label = outcome.label
                            reach(self._apply(world, i, outcome))
                    if world.wiped < self.wipes:
                        label = f"{self.names[i]} loses its disk and is set up anew"
                        reach(self._wiped(world, i))
        except Violation as violation:
            trace = [label] if label else []
            step = parents[world]
            while step is not None:
                trace.append(step[1])
                step = parents[step[0]]
            return Result(str(violation), len(parents), self.transitions, len(configurations), trace[::-1])
        return Result("", len(parents), self.transitions, len(configurations), complete=not queue)


def describe(event: Any) -> str:
    """Returns an event in words, for a trace."""
    match event:
        case Received(peer, message, refusal):
            what = type(message).__name__.upper()
            return f"{what} {message.offer} from {peer}{', refused' if refusal else ''}"
        case Award(peer):
            return f"gives the task to {peer}"
        case Frozen(offer):
            return f"the task has stopped for {offer}"
        case FreezeFailed(offer):
            return f"the task cannot be stopped for {offer}"
        case GiveUp(offer):
            return f"time is up for {offer}"
        case Resend(offer, phase):
            return f"sends again what {phase.value} says, {offer}"
        case ReservationExpired(peer):
            return f"{peer} has not answered the reservation"
        case Checkpoint():
            return "checkpoint"
        case Start(again):
            return "the task fails and is started again" if again else "somebody starts the task"
        case _:
            return str(event)


def _matters(effect: Effect) -> bool:
    """Returns whether a crash just after this effect differs from one just before it."""
    return isinstance(effect, Persist | Send | StartTask | Resume | Ack | Keep)


def _names(effects: list[Effect]) -> str:
    return ", ".join(type(effect).__name__ for effect in effects if _matters(effect)) or "nothing"
