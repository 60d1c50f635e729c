"""Exhaustive search of the hand-off's core, in the product's own types.

The fault model, unbounded unless noted:

* the network is the set of all messages ever sent: delivering one does not remove it, and nothing must ever
  be delivered. That covers loss, doubling, reordering, delay and every partition;
* any agent crashes and restarts between any two effects: what is volatile is gone, the record on disk stays;
* any timer fires at any time, and any packet for the task arrives at any time, any number of times;
* a destination may refuse any reservation and any snapshot, a task may fail to stop;
* bounded (see `parts.Bounds`): agents, offers, packets, ends and restarts of the task's actor, failed writes
  (where the disk then holds the old record or the new one), lost disks.

Safety, in every state: S1 at most one copy runs; S2 the epoch that runs, and the highest seen, never go back;
S3 what was acknowledged is in the state that runs; S4 every packet takes effect once; S5 no two owners under one
epoch; S6 a task that is to be stopped does not run. Liveness, from every configuration of the agents: L1 when
crashes and loss end, a few rounds of the timers lead to exactly one copy, nobody in doubt, everything applied and
acknowledged. Where a disk was lost, a person may have to have the task adopted for that.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from model.parts import BLANK, STREAM, TASK, Agent, App, Bounds, Core, Outcome, Violation
from model.steps import Steps
from model.words import cause

from pancakes.durable.handoff_events import (
    AdoptionAsked,
    Born,
    Frozen,
    GiveUp,
    PacketId,
    Received,
    Resend,
    ReservationExpired,
    RunAsked,
)
from pancakes.durable.record import NO_EPOCH, Epoch, Phase, Wanted

_SHIFT: Final = 24
"""A state is one number: a configuration's in the low bits, the messages sent above them."""
_MASK: Final = (1 << _SHIFT) - 1


class Configuration(NamedTuple):
    """All of the world but the messages.

    Attributes:
        agents: the number of each agent.
        acked: the highest packet that was acknowledged.
        top: the highest epoch that the task ran under.
        faults: how many writes have failed.
        wiped: the names of the agents that lost their disks.
    """

    agents: tuple[int, ...]
    acked: int
    top: Epoch
    faults: int
    wiped: str


class Row(NamedTuple):
    """One step out of a configuration.

    Attributes:
        needs: the message that it takes, as a bit; 0 where it takes none.
        sends: the messages that it sends, as bits.
        clears: the agent that will not believe what was sent to it before; empty where there is none.
        to: number of the configuration afterwards; -1 where a promise is broken on the way.
        story: the step in a sentence.
        broken: the promise that is broken by it, or by the configuration afterwards.
    """

    needs: int
    sends: int
    clears: str
    to: int
    story: str
    broken: str


@dataclass(frozen=True)
class Result:
    """What a search has found.

    Attributes:
        violation: the promise that is broken; empty where none is.
        trace: a shortest way there, in sentences.
        states: how many states were reached.
        transitions: how many steps were taken between them.
        configurations: how many configurations of the agents there were among them.
        complete: whether all there is was searched.
        reached: what the search came to that it is there for, where that is asked.
    """

    violation: str
    trace: tuple[str, ...]
    states: int
    transitions: int
    configurations: int
    complete: bool = True
    reached: tuple[str, ...] = ()


class Search:
    """Searches all that can happen within bounds.

    Args:
        bounds: how far to go.
        core: the core under search.
        strict: also asks that `seen` never goes down on a disk, at once.
        most_states: gives up, incomplete, beyond this.
    """

    def __init__(
        self, bounds: Bounds, core: Core | None = None, strict: bool = True, most_states: int = 12_000_000
    ) -> None:
        self.bounds = bounds
        self.steps = Steps(bounds, core or Core(), strict)
        self._names = bounds.names
        self._most_states = most_states
        self._configurations: list[Configuration] = []
        self._numbers: dict[Configuration, int] = {}
        self._broken: dict[Configuration, str] = {}
        self._converged: dict[tuple[tuple[int, ...], int, str], str] = {}
        self._vain: dict[str, tuple[str, ...]] = {}
        """What happens in vain where nothing comes of it, in sentences."""
        self._sent_to = self.steps.sent_to
        self._rows: list[list[Row]] = []
        self._looked_at: list[int] = []
        """The messages that the rows of each configuration know, as bits."""

    def run(self) -> Result:
        """Searches breadth first, so that the first broken promise found has a shortest trace."""
        blank = self.steps.number(BLANK)
        birth = Configuration((blank,) * len(self._names), 0, NO_EPOCH, 0, "")
        start, _ = self._enter(birth)
        parents: dict[int, int] = {start: -1}
        queue = deque([start])
        transitions = 0
        while queue and len(parents) <= self._most_states:
            state = queue.popleft()
            net = state >> _SHIFT
            for needs, sends, clears, to, story, broken in self._rows_of(state & _MASK, net):
                if needs & net != needs:
                    continue
                transitions += 1
                if broken:
                    trace = (*self._trace(parents, state), story, *self._vain.get(broken, ()))
                    return self._result(broken, trace, parents, transitions)
                after = (net & ~self._sent_to[clears] | sends if clears else net | sends) << _SHIFT | to
                if after not in parents:
                    parents[after] = state
                    queue.append(after)
        return self._result("", (), parents, transitions, not queue)

    def _result(
        self, violation: str, trace: tuple[str, ...], parents: dict[int, int], transitions: int, complete: bool = True
    ) -> Result:
        return Result(violation, trace, len(parents), transitions, len(self._configurations), complete)

    def _trace(self, parents: dict[int, int], state: int) -> tuple[str, ...]:
        """Returns how a state came about, in sentences."""
        told: list[str] = []
        while (before := parents[state]) >= 0:
            told.append(self._story(before, state))
            state = before
        return tuple(reversed(told))

    def _story(self, before: int, after: int) -> str:
        net = before >> _SHIFT
        for needs, sends, clears, to, story, _ in self._rows_of(before & _MASK, net):
            left = net & ~self._sent_to[clears] | sends if clears else net | sends
            if needs & net == needs and left << _SHIFT | to == after:
                return story
        raise LookupError(f"no step leads from state {before} to state {after}")

    # Steps ---------------------------------------------------------------------------------------------------

    def _enter(self, configuration: Configuration) -> tuple[int, str]:
        """Returns a configuration's number, and the promise that it breaks; empty where it breaks none."""
        number = self._numbers.get(configuration)
        if number is None:
            number = self._numbers[configuration] = len(self._configurations)
            self._configurations.append(configuration)
            self._rows.append([])
            self._looked_at.append(0)
            broken = self._fault_of(configuration) or self._failure_to_converge(configuration)
            if broken:
                self._broken[configuration] = broken
        return number, self._broken.get(configuration, "")

    def _rows_of(self, number: int, net: int) -> list[Row]:
        """Returns all steps out of a configuration that the messages in `net` allow, and perhaps others."""
        rows = self._rows[number]
        if not rows:
            configuration = self._configurations[number]
            for i, agent in enumerate(configuration.agents):
                for event in self.steps.happenings(i, agent):
                    if isinstance(event, Born) and configuration.wiped:
                        # Whoever lost the disk of a birthplace must not let it give birth a second time.
                        continue
                    rows.extend(self._rows_for(configuration, i, event, 0))
                if self._may_adopt(configuration, i):
                    # Whoever adopts sets the other side up anew after that, so that nothing said before is believed.
                    other = self.steps.agents[agent].disk.peer
                    adoptions = self._rows_for(configuration, i, AdoptionAsked(), 0)
                    rows.extend(row._replace(clears=other) for row in adoptions)
                if len(configuration.wiped) < self.bounds.wipes:
                    rows.append(self._loss(configuration, i))
        news = net & ~self._looked_at[number]
        if news:
            self._looked_at[number] |= news
            configuration = self._configurations[number]
            for message in range(news.bit_length()):
                if news >> message & 1:
                    i = self._names.index(self.steps.messages[message][1])
                    for event in self.steps.deliveries(i, message):
                        rows.extend(self._rows_for(configuration, i, event, 1 << message))
        return rows

    def _rows_for(self, before: Configuration, i: int, event: Any, needs: int) -> Iterator[Row]:
        try:
            outcomes = self.steps.outcomes(i, before.agents[i], event)
        except Violation as violation:
            why = cause(self._names[i], event)
            yield Row(needs, 0, "", -1, f"{why[0].upper()}{why[1:]}.", str(violation))
            return
        for outcome in outcomes:
            if outcome.fault and before.faults >= self.bounds.faults:
                continue
            try:
                after = self._apply(before, i, outcome)
            except Violation as violation:
                yield Row(needs, outcome.sends, "", -1, outcome.story, str(violation))
                continue
            if after == before and not outcome.sends:
                # Nothing comes of it.
                continue
            to, broken = self._enter(after)
            yield Row(needs, outcome.sends, "", to, outcome.story, broken)

    def _apply(self, before: Configuration, i: int, outcome: Outcome) -> Configuration:
        """Returns the configuration after a step of agent `i`.

        Raises:
            Violation: a promise is broken on the way.
        """
        top = before.top
        for epoch in outcome.started:
            if epoch < top:
                raise Violation(f"S2: {self._names[i]} starts the task under {epoch} after {top} ran")
            top = epoch
        acked = min(max(before.acked, outcome.acked), outcome.kept)
        if outcome.before_crash >= 0:
            part = before._replace(agents=_with(before.agents, i, outcome.before_crash), acked=acked)
            broken = self._fault_of(part)
            if broken:
                raise Violation(broken)
        agents = _with(before.agents, i, outcome.agent)
        return Configuration(agents, acked, top, before.faults + outcome.fault, before.wiped)

    def _loss(self, before: Configuration, i: int) -> Row:
        """Returns the step in which a disk is lost; the agent does not believe what was sent to its former self."""
        name = self._names[i]
        agents = _with(before.agents, i, self.steps.number(BLANK))
        to, broken = self._enter(before._replace(agents=agents, wiped="".join(sorted(before.wiped + name))))
        return Row(0, 0, name, to, f"Agent {name} loses its disk and is set up anew.", broken)

    def _may_adopt(self, configuration: Configuration, i: int) -> bool:
        """Returns whether a person who makes no mistake may have agent `i` adopt the task."""
        if not self.bounds.adopt or not configuration.wiped:
            return False
        mine = self._agent(configuration, i).disk
        if mine.phase not in (Phase.COMMITTED, Phase.PREPARED) or mine.peer not in configuration.wiped:
            return False
        other = self._agent(configuration, self._names.index(mine.peer)).disk
        if other.seen >= mine.offer:
            # It has not lost this one: its disk went earlier.
            return False
        others = [self._agent(configuration, j).disk for j in range(len(self._names)) if j != i]
        return all(o.seen <= mine.seen and o.phase not in (Phase.OWNER, Phase.FROZEN) for o in others)

    def _agent(self, configuration: Configuration, i: int) -> Agent:
        return self.steps.agents[configuration.agents[i]]

    # Promises ------------------------------------------------------------------------------------------------

    def _fault_of(self, configuration: Configuration) -> str:
        """Returns the promise that a configuration breaks at once; empty where it breaks none."""
        agents = [self.steps.agents[number] for number in configuration.agents]
        running = [(name, a) for name, a in zip(self._names, agents, strict=True) if a.actor and a.actor.running]
        if len(running) > 1:
            return f"S1: the task runs on {' and on '.join(name for name, _ in running)} at the same time"
        for name, agent in running:
            assert agent.actor is not None
            app = agent.actor.app
            if app.effects != app.upto:
                return f"S4: on {name} {app.upto} packets had {app.effects} effects"
            if app.upto < configuration.acked and not configuration.wiped:
                return f"S3: packet {configuration.acked} was acknowledged, {name} has only those up to {app.upto}"
            if agent.memory.phase is Phase.OWNER and agent.memory.wanted is not Wanted.RUNNING:
                return f"S6: the task runs on {name}, which has it written down as {agent.memory.wanted.value}"
        epochs = [a.disk.epoch for a in agents if a.disk.phase in (Phase.OWNER, Phase.FROZEN)]
        if len(epochs) != len(set(epochs)):
            return "S5: two agents own the task under one epoch"
        return ""

    def _failure_to_converge(self, configuration: Configuration) -> str:
        """Returns why, if all is well from here on, it does not come to exactly one copy; empty where it does.

        Every message so far is lost. Where a disk was lost, this is asked only where a person may help, and where
        there is something left to adopt or to run.
        """
        if configuration.wiped and not (self.bounds.adopt and self._something_left(configuration)):
            return ""
        key = (configuration.agents, configuration.acked, configuration.wiped)
        if key not in self._converged:
            try:
                self._converged[key] = self._converge(configuration._replace(faults=self.bounds.faults))
            except Violation:
                # It is a way that the search goes as well: it will find this, and a shortest trace to it.
                self._converged[key] = ""
        return self._converged[key]

    def _something_left(self, configuration: Configuration) -> bool:
        agents = [self.steps.agents[number].disk for number in configuration.agents]
        newest = max(agents, key=lambda record: record.seen)
        return newest.phase not in (Phase.ABSENT, Phase.RELEASED)

    def _converge(self, at: Configuration, rounds: int = 14) -> str:
        net = 0
        told: list[str] = []
        for number in range(rounds):
            for i in range(len(self._names)):
                for look in (self._pending, self._timers, self._packets, self._checkpoints):
                    for event in look(at, i, number):
                        at, net = self._feed(at, i, event, net, told)
            news, net = net, 0
            while news:
                low = news & -news
                news ^= low
                source, destination, message = self.steps.messages[low.bit_length() - 1]
                at, net = self._feed(at, self._names.index(destination), Received(source, message), net, told)
            if self._is_settled(at) or self._fault_of(at):
                return ""
        agents = zip(self._names, (self.steps.agents[number] for number in at.agents), strict=True)
        story = ", ".join(
            f"{name} is {a.memory.phase.name}{' and runs it' if a.actor and a.actor.running else ''}"
            for name, a in agents
        )
        broken = f"L1: however long one waits, it does not come to one copy: {story}"
        self._vain[broken] = ("All that was sent so far is lost; from here on all goes well.", *dict.fromkeys(told))
        return broken

    def _feed(self, at: Configuration, i: int, event: Any, net: int, told: list[str]) -> tuple[Configuration, int]:
        outcomes = self.steps.outcomes(i, at.agents[i], event)
        if not outcomes:
            return at, net
        told.append(outcomes[0].story)
        if isinstance(event, AdoptionAsked):
            net &= ~self._sent_to[self._agent(at, i).disk.peer]
        return self._apply(at, i, outcomes[0]), net | outcomes[0].sends

    def _pending(self, at: Configuration, i: int, _round: int) -> tuple[Any, ...]:
        return self._agent(at, i).pending

    def _timers(self, at: Configuration, i: int, number: int) -> tuple[Any, ...]:
        """Returns what is due on agent `i` in one round."""
        agent, me = self._agent(at, i), self._names[i]
        record, volatile, actor = agent.memory, agent.volatile, agent.actor
        offer = Epoch(record.seen.n + 1, me)
        if volatile.freezing and actor is not None:
            return (Frozen(offer, self.steps.write(actor.app)),)
        if volatile.asked:
            return (ReservationExpired(volatile.asked, offer),)
        if record.phase is Phase.OWNER and not volatile.running:
            return (RunAsked(),)
        if record.phase is Phase.ABSENT and record.seen == NO_EPOCH and me == TASK.birthplace and not at.wiped:
            return (Born(self.steps.write(App())),)
        if number == 5 and record.phase is Phase.FROZEN:
            return (GiveUp(record.offer, "time is up"),)
        if number == 7 and self._may_adopt(at, i):
            return (AdoptionAsked(),)
        return (Resend(record.offer, record.phase, 0),) if record.offer != NO_EPOCH else ()

    def _packets(self, _at: Configuration, _i: int, _round: int) -> tuple[Any, ...]:
        return tuple(PacketId(STREAM, seq + 1) for seq in range(self.bounds.packets))

    def _checkpoints(self, at: Configuration, i: int, _round: int) -> tuple[Any, ...]:
        actor = self._agent(at, i).actor
        return (self.steps.checkpoint(actor),) if actor is not None and actor.running else ()

    def _is_settled(self, at: Configuration) -> bool:
        agents = [self.steps.agents[number] for number in at.agents]
        running = [a.actor for a in agents if a.actor is not None and a.actor.running]
        if at.wiped or len(running) != 1:
            return len(running) == 1
        settled = all(a.memory.phase in (Phase.ABSENT, Phase.OWNER, Phase.RELEASED) for a in agents)
        return settled and running[0].app.upto == self.bounds.packets <= at.acked


def _with(agents: tuple[int, ...], i: int, number: int) -> tuple[int, ...]:
    return (*agents[:i], number, *agents[i + 1 :])
