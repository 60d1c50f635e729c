"""All that can happen to one agent, and what it then does: whole, cut by a crash, cut by a failed write.

An agent's steps do not depend on the others. So each is worked out once and remembered, and the search itself
works on small numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from model.parts import ALL, REQUEST, STREAM, TASK, Actor, Agent, App, Bounds, Core, Keep, Outcome, Violation, heard_of
from model.words import cause, deeds, shows

from pancakes.control import Refusal
from pancakes.durable.handoff_events import (
    Ack,
    After,
    Award,
    Born,
    Checkpoint,
    Discard,
    Effect,
    Ended,
    Event,
    Freeze,
    FreezeFailed,
    Frozen,
    GiveUp,
    InDoubt,
    PacketId,
    Persist,
    PersistFailed,
    Received,
    Remember,
    Resend,
    ReservationExpired,
    Resume,
    RunAsked,
    Send,
    StartTask,
)
from pancakes.durable.messages import Reserve, Reserved, Transfer
from pancakes.durable.record import NO_EPOCH, Epoch, Phase, Volatile, Wanted
from pancakes.durable.snapshot import Snapshot

CRASH = "crash"
TAKE = "take a checkpoint"
TIMERS = (GiveUp, InDoubt, Resend, ReservationExpired)
"""What fires at any time, whether it was put off or not; anything else that is put off comes once."""

LACKS: Final = Refusal("unsupported", "lacks the device types motors")


class Steps:
    """The steps of single agents, each with a number for every agent and a bit for every message that came up.

    Args:
        bounds: how far to go.
        core: the functions under search.
        strict: also asks that `seen` never goes down on a disk, at once.
    """

    def __init__(self, bounds: Bounds, core: Core, strict: bool) -> None:
        self.bounds, self.core, self.strict = bounds, core, strict
        self.names = bounds.names
        self.agents: list[Agent] = []
        self.messages: list[tuple[str, str, Any]] = []
        self.sent_to = dict.fromkeys(self.names, 0)
        """The bits of all messages to each agent."""
        self._agent_ids: dict[Agent, int] = {}
        self._message_bits: dict[tuple[str, str, Any], int] = {}
        self._outcomes: dict[tuple[int, int, Any], tuple[Outcome, ...]] = {}
        self._events: dict[tuple[int, int], tuple[Any, ...]] = {}
        self._written: dict[App, bytes] = {}
        self._read: dict[bytes, App] = {}

    def number(self, agent: Agent) -> int:
        """Returns the number of an agent in this state."""
        number = self._agent_ids.setdefault(agent, len(self.agents))
        if number == len(self.agents):
            self.agents.append(agent)
        return number

    def bit(self, source: str, destination: str, message: Any) -> int:
        """Returns the bit of a message."""
        key = (source, destination, message)
        bit = self._message_bits.get(key)
        if bit is None:
            bit = self._message_bits[key] = 1 << len(self.messages)
            self.messages.append(key)
            self.sent_to[destination] |= bit
        return bit

    def write(self, app: App) -> bytes:
        """Returns the task's snapshot, the product's own, with its duplicate filter."""
        data = self._written.get(app)
        if data is None:
            heard = {STREAM: app.upto}
            whole = Snapshot(TASK, REQUEST.type, "1.0", "client", state={"effects": app.effects}, heard=heard)
            data = self._written[app] = whole.encode()
        return data

    def read(self, data: bytes) -> App:
        """Returns what a task that is started from a snapshot begins with."""
        app = self._read.get(data)
        if app is None:
            whole = self.core.decode(data)
            app = self._read[data] = App(whole.state["effects"], heard_of(whole))
        return app

    # What can happen -----------------------------------------------------------------------------------------

    def happenings(self, i: int, number: int) -> tuple[Any, ...]:
        """Returns all that can happen to agent `i`, but for messages and a lost disk."""
        events = self._events.get((i, number))
        if events is None:
            events = self._events[i, number] = tuple(self._happenings(i, self.agents[number]))
        return events

    def _happenings(self, i: int, agent: Agent) -> Iterator[Any]:
        bounds, me = self.bounds, self.names[i]
        record, volatile, actor = agent.memory, agent.volatile, agent.actor
        offer = Epoch(record.seen.n + 1, me)
        if actor is not None and actor.running:
            yield from (PacketId(STREAM, seq + 1) for seq in range(bounds.packets))
            if not any(isinstance(event, Checkpoint) for event in agent.pending):
                yield self.checkpoint(actor)
                if bounds.late:
                    yield TAKE
            if not volatile.asked and record.seen.n < bounds.offers:
                yield from (Award(peer, REQUEST) for peer in self.names if peer != me)
        elif record.phase is Phase.ABSENT and record.seen == NO_EPOCH and me == TASK.birthplace:
            yield Born(self.write(App()))
        elif not volatile.freezing:
            yield RunAsked()
        yield from agent.pending
        if actor is not None and record.incarnation < bounds.restarts:
            yield RunAsked(again=True)
            if bounds.stops:
                yield Ended(Wanted.STOPPED, self.write(actor.app))
                yield Ended(Wanted.FAILED)
        if volatile.freezing and actor is not None:
            yield Frozen(offer, self.write(actor.app))
            if bounds.refusals:
                yield FreezeFailed(offer, "stuck")
        elif volatile.asked:
            yield ReservationExpired(volatile.asked, offer)
            if not bounds.reserve:
                yield Received(volatile.asked, Reserved(TASK, offer))
        if record.offer != NO_EPOCH:
            # Also in the phases where no such timer was set: one that was set before may come late.
            yield GiveUp(record.offer, "time is up")
            yield Resend(record.offer, record.phase, 0)
        yield CRASH

    def deliveries(self, i: int, number: int) -> list[Received]:
        """Returns what the message with this number can mean to agent `i`."""
        source, destination, message = self.messages[number]
        if destination != self.names[i] or (isinstance(message, Reserve) and not self.bounds.reserve):
            return []
        if self.bounds.refusals and isinstance(message, Transfer | Reserve):
            return [Received(source, message), Received(source, message, LACKS)]
        return [Received(source, message)]

    def checkpoint(self, actor: Actor) -> Checkpoint:
        """Returns a checkpoint of the task as it stands."""
        consumed = () if self.bounds.lazy or not actor.app.upto else (PacketId(STREAM, actor.app.upto),)
        return Checkpoint(actor.epoch, actor.incarnation, self.write(actor.app), consumed)

    # What comes of it ----------------------------------------------------------------------------------------

    def outcomes(self, i: int, number: int, event: Any) -> tuple[Outcome, ...]:
        """Returns all outcomes of one event at agent `i`; the first is the whole one.

        Raises:
            Violation: a promise is broken that concerns one agent alone.
        """
        key = (i, number, event)
        outcomes = self._outcomes.get(key)
        if outcomes is None:
            outcomes = self._outcomes[key] = tuple(self._make(i, self.agents[number], event))
        return outcomes

    def _make(self, i: int, agent: Agent, event: Any) -> Iterator[Outcome]:
        me = self.names[i]
        if event == CRASH:
            after, sends, started, kept, deed = self._crash(i, agent)
            yield Outcome(_sentence(f"agent {me} crashes", me, deed), self.number(after), sends, 0, kept, started)
        elif event == TAKE:
            assert agent.actor is not None
            after = agent._replace(pending=(*agent.pending, self.checkpoint(agent.actor)))
            yield Outcome(f"A checkpoint of the task on agent {me} is taken, and gets stuck.", self.number(after))
        elif isinstance(event, PacketId):
            yield from self._packet(i, agent, event)
        else:
            yield from self._decide(i, agent, event)

    def _decide(self, i: int, agent: Agent, event: Event) -> Iterator[Outcome]:
        before = agent
        agent, effects = self._handle(i, before, event)
        if not effects and agent == before:
            return
        why = cause(self.names[i], event, late=event in before.pending)
        after, sends, acked, started = self._carry_out(i, agent, effects)
        kept = self._kept(event, agent)
        yield Outcome(_sentence(why, self.names[i], deeds(effects)), self.number(after), sends, acked, kept, started)
        for cut in range(1, len(effects)):
            if not shows(effects[cut - 1]) and cut > 1:
                continue
            part, sends, acked, started = self._carry_out(i, agent, effects[:cut])
            after, more, restarted, left, recovery = self._crash(i, part)
            first = deeds(effects[:cut])
            deed = f"{first}, crashes{recovery}" if first else f"crashes{recovery}"
            yield Outcome(
                _sentence(why, self.names[i], deed),
                self.number(after),
                sends | more,
                acked,
                min(kept, left),
                started + restarted,
                self.number(part),
            )
        yield from self._failed_writes(i, agent, effects, why, kept)

    def _failed_writes(self, i: int, agent: Agent, effects: list[Effect], why: str, kept: int) -> Iterator[Outcome]:
        for at, effect in enumerate(effects):
            if not isinstance(effect, Persist) or not self.bounds.faults:
                continue
            part, sends, acked, started = self._carry_out(i, agent, effects[:at])
            for disk in (part.disk, effect.record):
                failed, answer = self._handle(i, part._replace(disk=disk), PersistFailed("disk full", effect.record))
                after, more, more_acked, more_started = self._carry_out(i, failed, answer)
                first = "".join(f"{deed}, " for deed in [deeds(effects[:at])] if deed)
                holds = f"cannot write {effect.record.phase.name} (the disk holds {disk.phase.name})"
                yield Outcome(
                    _sentence(why, self.names[i], ", ".join(filter(None, [f"{first}{holds}", deeds(answer)]))),
                    self.number(after),
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
        app, what = actor.app, "has had its effect before"
        if packet.seq == app.upto + 1:
            app, what = App(app.effects + 1, packet.seq), "takes effect"
        elif packet.seq > app.upto:
            return
        acked = packet.seq if self.bounds.lazy else 0
        story = f"Packet {packet.seq} reaches the task on agent {self.names[i]} and {what}"
        after = agent._replace(actor=actor._replace(app=app))
        yield Outcome(f"{story}{', and is acknowledged' if acked else ''}.", self.number(after), acked=acked)

    def _handle(self, i: int, agent: Agent, event: Event) -> tuple[Agent, list[Effect]]:
        """Returns the agent as it is when the event reaches the core, and the core's decision."""
        retried = event in agent.pending
        if not retried and (isinstance(event, Ended) or (isinstance(event, RunAsked) and event.again)):
            agent = agent._replace(actor=None)
        if isinstance(event, FreezeFailed) and agent.actor is not None:
            agent = agent._replace(actor=agent.actor._replace(running=True))
        if retried:
            agent = agent._replace(pending=tuple(other for other in agent.pending if other != event))
        return agent, self.core.handle(self.names[i], agent.memory, agent.volatile, event)

    def _kept(self, event: Event, agent: Agent) -> int:
        """Returns the highest packet that an event leaves: with an actor, what it had not yet written down goes."""
        gone = isinstance(event, RunAsked) or (isinstance(event, Ended) and not event.snapshot)
        if gone and self.bounds.lazy and agent.memory.snapshot:
            return self.read(agent.memory.snapshot).upto
        return ALL

    def _carry_out(self, i: int, agent: Agent, effects: list[Effect]) -> tuple[Agent, int, int, tuple[Epoch, ...]]:
        """Returns the agent after the effects, what it sent and acknowledged, and the epochs it started."""
        disk, memory, volatile, actor, pending = agent
        sends = acked = 0
        started: list[Epoch] = []
        for effect in effects:
            match effect:
                case Persist():
                    if self.strict and effect.record.seen < memory.seen:
                        raise Violation("S2: the highest epoch seen went down on a disk")
                    disk = memory = effect.record
                case Keep():
                    memory = effect.record
                case Remember():
                    volatile = effect.volatile
                case After(event=again) if not isinstance(again, TIMERS) and again not in pending:
                    pending = (*pending, again)
                case Send():
                    sends |= self.bit(self.names[i], effect.peer, effect.message)
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
                        raise Violation(
                            f"S1: {self.names[i]} lets go of the task while it runs: it has changed since it was sent"
                        )
                    actor = None
                case Ack():
                    acked = max(acked, effect.packet.seq)
        return Agent(disk, memory, volatile, actor, pending), sends, acked, tuple(started)

    def _crash(self, i: int, agent: Agent) -> tuple[Agent, int, tuple[Epoch, ...], int, str]:
        """Returns the agent after crash and restart, what it sent and started, what it kept, and the restart's tale."""
        record = agent.disk
        kept = ALL
        lost_its_write = record.phase is Phase.FROZEN and agent.memory.phase is Phase.OWNER
        if self.bounds.lazy and (record.phase is Phase.OWNER or lost_its_write):
            kept = self.read(record.snapshot).upto
        effects = self.core.recover(record)
        after, sends, _, started = self._carry_out(i, Agent(record, record, Volatile()), effects)
        tale = f", comes back as {record.phase.name}"
        return after, sends, started, kept, ", ".join(filter(None, [tale, deeds(effects)]))


def _sentence(why: str, me: str, deed: str) -> str:
    text = f"{why[0].upper()}{why[1:]}"
    if deed.startswith(", "):
        return f"{text}{deed}."
    return f"{text}: {me} {deed}." if deed else f"{text}."
