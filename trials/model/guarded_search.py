"""Exhaustive search of the cores of guarded tasks, joined: agents that own a task, or take it, and their guardians.

The fault model, unbounded unless a scenario says otherwise:

* the network is the set of all messages ever sent: loss, doubling, overtaking, delay and every cut. A message leaves
  the set only once it can change nothing more;
* any agent crashes between any two effects, and comes back. One that is gone for good, or paused, takes no step;
* guardians call any agent to take the task at any time, with whatever they may know; an owner hears at any time what
  guardians have promised, and what other agents own;
* time is an order of lapses. Askings for leases (KEEP) lapse in the order in which they were sent, at any moment. A
  permit is over when its asking lapses; a guardian's lease by that asking is over no earlier, and a guardian that has
  restarted waits for all that were sent before. That is all that is assumed of clocks: a permit, by the owner's clock
  from the sending, ends before a lease, by the guardian's clock from the arrival;
* bounded are: agents, the number in an epoch, askings that have not lapsed, packets, hand-offs, replacements of
  guardians, lost disks, and what people ask for.

In every state: S1 at most one agent acts; S2 the epoch that acts, the highest seen, and what a guardian has promised
never go back; S3 what was acknowledged (held by a quorum) is in the state that acts; S5 no two agents own the task
under one epoch; S6 a task does not act once it was answered that it is stopped: once a quorum knows so. S4, that no
packet takes effect twice, is the duplicate filter's, which is part of each checkpoint (`model.search`). From every
configuration of the disks L1, see `model.guarded_healing`.

Left out: failed writes (`model.search` has them), the bids, and how guardians are chosen: no safety hangs on these. A
hand-off begins with its reservation granted and the task stopped. Votes are counted in one go, for each can be heard
again.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

from model.guarded_healing import Healing
from model.guarded_parts import (
    OWNED,
    STOPPED,
    TASK,
    TYPE,
    Budget,
    Farewell,
    GuardedWorld,
    Message,
    Party,
    Rules,
    Scenario,
    Violation,
    Word,
    guardians,
    short,
)
from model.guarded_pruning import Pruning
from model.guarded_steps import STREAM, GuardedSteps, Outcome
from model.guarded_words import told
from model.search import Result

from pancakes.durable.guarding import GuardRegister, LeaseOver
from pancakes.durable.handoff_events import (
    AdoptionAsked,
    Checkpoint,
    ClaimHeard,
    Ended,
    GiveUp,
    GuardsChosen,
    PacketId,
    Received,
    RunAsked,
)
from pancakes.durable.messages import CheckpointBody, CheckpointId, DenyLease, KeepLease, LeaseKept, Pledge, SeizeTask
from pancakes.durable.record import Epoch, Guards, Phase, Record, Wanted


class Happening(NamedTuple):
    """One thing that can happen to one agent.

    Attributes:
        what: what it is, for people; a message, an event or a word.
        i: the agent.
        outcome: what comes of it.
        top: how many askings have not lapsed afterwards; -1: as many as before.
        left: what may still happen afterwards; None: as before.
        forgets: what is taken back of what was acknowledged, as bits.
    """

    what: Any
    i: int
    outcome: Outcome
    top: int = -1
    left: Budget | None = None
    forgets: int = 0


class GuardedSearch:
    """Searches one scenario breadth first, so that the way to a broken promise is a shortest one.

    Args:
        scenario: what may happen.
        rules: the functions under search.
        most_states: gives up, incomplete, beyond this.
    """

    def __init__(self, scenario: Scenario, rules: Rules | None = None, most_states: int = 3_000_000) -> None:
        self.scenario, self.rules = scenario, rules or Rules()
        self.names = scenario.agents
        self.steps = GuardedSteps(scenario, self.rules)
        self.pruning = Pruning(self.steps)
        self.healing = Healing(scenario, self.rules)
        self.reached: set[str] = set()
        self._most_states = most_states
        self._swap = guardians(scenario.swap)
        self._first = Guards(Epoch(0, scenario.owner), 0, (guardians(scenario.guards),))
        self._checked: dict[tuple[tuple[int, ...], int, Epoch], str] = {}
        self._healed: dict[tuple[Any, ...], str] = {}
        self._rows: dict[Any, list[Happening]] = {}
        self._transitions = 0

    def first(self) -> GuardedWorld:
        """Returns the world at the beginning: a task that is guarded, and that no agent runs yet."""
        s, epoch = self.scenario, self._first.epoch
        start = bytes([0])
        both = Guards(epoch, 1, (self._first.sets[0], self._swap))
        new = Guards(epoch, 2, (self._swap,))
        parties, net = [], 0
        for name in self.names:
            record, register = Record(TASK), GuardRegister(TASK)
            if name == s.owner:
                guards = new if s.swapped else self._first
                record = Record(TASK, Phase.OWNER, epoch, epoch, snapshot=start, guards=guards)
            old = name in {member.agent for member in self._first.members()}
            stays = s.swapped and name in s.swap
            if old or stays:
                guards = self._first if not stays else both if old and name != s.owner else new
                body = CheckpointBody(start)
                register = GuardRegister(TASK, TYPE, epoch, CheckpointId(epoch, 0), body, guards, 1.0)
            parties.append(self.steps.number(Party(record, register=register)))
        if s.swapped:
            net = self.steps.bit(KeepLease(TASK, TYPE, epoch, 0, 1.0, CheckpointId(epoch, 0), self._first))
        swaps = int(bool(s.swap) and not s.swapped)
        left = Budget(int(bool(s.moves)), swaps, s.wipes, s.copies, int(s.stops), int(s.adopts), s.goodbyes)
        return GuardedWorld(tuple(parties), net, 0, 0, epoch, left)

    def run(self) -> Result:
        """Searches all there is."""
        start = self.first()
        parents: dict[GuardedWorld, tuple[GuardedWorld, Any] | None] = {start: None}
        queue = deque([start])
        world, label = start, None
        try:
            while queue:
                world, label = queue.popleft(), None
                self._check(world)
                if len(parents) > self._most_states:
                    return self._result("", (), parents, complete=False)
                for label, new in self._following(world):
                    self._transitions += 1
                    if new not in parents:
                        parents[new] = (world, label)
                        queue.append(new)
        except Violation as violation:
            story = [label] if label is not None else []
            at: GuardedWorld | None = world
            while at is not None and (before := parents[at]) is not None:
                at, step = before
                story.append(step)
            return self._result(str(violation), tuple(told(self.names, it) for it in reversed(story)), parents)
        return self._result("", (), parents)

    def missed(self) -> list[str]:
        """Returns what the scenario is there for, and was not reached."""
        s = self.scenario
        wanted = {f"{name} acts" for name in (s.owner, *s.takers, *s.moves)}
        if s.moves:
            wanted |= {"COMMITTED", "PREPARED", "RELEASED"}
        wanted |= {f"{name} loses its disk" for name in s.wipes}
        wanted |= {f"{name} comes back with an older disk" for name in s.copies}
        wanted |= {"the new guardians are in use"} if s.swap else set()
        wanted |= {"a stop is answered"} if s.stops else set()
        wanted |= {"a lease ends at a goodbye"} if s.goodbyes else set()
        wanted |= {"adopted"} if s.adopts else set()
        wanted |= {"an offer is overtaken"} if s.moves and s.takers else set()
        wanted |= {"a packet is acknowledged"} if s.packets else set()
        return sorted(wanted - self.reached)

    def _result(self, violation: str, trace: tuple[str, ...], parents: dict[Any, Any], complete: bool = True) -> Result:
        return Result(violation, trace, len(parents), self._transitions, len(self._healed), complete)

    # Promises --------------------------------------------------------------------------------------------------

    def _check(self, world: GuardedWorld) -> None:
        key = (world.parties, world.acked, world.reign)
        broken = self._checked.get(key)
        if broken is None:
            broken = self._checked[key] = self._fault_of(world)
        if broken:
            raise Violation(broken)

    def _fault_of(self, world: GuardedWorld) -> str:
        parties = [self.steps.parties[number] for number in world.parties]
        acting = [(name, it) for name, it in zip(self.names, parties, strict=True) if it.acts]
        self.reached |= {it.record.phase.name for it in parties}
        self.reached |= {f"{name} acts" for name, _ in acting}
        if any(it.record.epoch.minter != self.scenario.owner for _, it in acting):
            self.reached.add("taken over")
        if self._swap and any(it.record.guards.sets == (self._swap,) for _, it in acting):
            self.reached.add("the new guardians are in use")
        if world.acked & STOPPED:
            self.reached.add("a stop is answered")
        if world.acked & ~STOPPED:
            self.reached.add("a packet is acknowledged")
        if len(acting) > 1:
            return f"S1: the task acts on {' and on '.join(name for name, _ in acting)} at the same time"
        adopted = self.scenario.adopts and not world.left.adopts
        for name, it in acting:
            if world.acked & ~STOPPED & ~it.actor and not adopted:
                return f"S3: the task acts on {name} without what was acknowledged"
            if world.acked & STOPPED:
                return f"S6: the task acts on {name}, and it was answered that it is stopped"
            if it.record.epoch < world.reign:
                return f"S2: {name} acts under {it.record.epoch}, and {world.reign} has acted"
        owned = [it.record.epoch for it in parties if it.record.phase in OWNED]
        if len(owned) != len(set(owned)):
            return "S5: two agents own the task under one epoch"
        if self.scenario.adopts:
            return ""
        disks = tuple((it.record, it.register, it.journal, it.original) for it in parties)
        broken = self._healed.get(disks)
        if broken is None:
            broken = self._healed[disks] = self.healing.fault_of(parties)
        return broken

    # Steps -----------------------------------------------------------------------------------------------------

    def _following(self, world: GuardedWorld) -> Iterator[tuple[Any, GuardedWorld]]:
        net, nothing_new = world.net, ~world.net
        for it in self._happenings(world):
            outcome, i = it.outcome, it.i
            same = outcome.party == world.parties[i] and it.left is None and it.top < 0
            if same and not outcome.sent & nothing_new and not outcome.acked & ~world.acked:
                continue
            if outcome.ended:
                self.reached.add("a lease ends at a goodbye")
            yield (i, it.what, 0), self._after(world, it, outcome.party, outcome.sent, outcome.acked)
            if self.names[i] not in self.scenario.crashes:
                continue
            for cut, (party, sent, acked) in enumerate(outcome.cuts, 1):
                top = world.top if it.top < 0 else it.top
                back, more = self.steps.crash(i, party, top)
                new = self._after(world, it, back, sent | more, acked)
                yield (i, it.what, cut), self._deafened(new, i)
        for i, number in enumerate(world.parties):
            if self.names[i] in self.scenario.crashes:
                back, sent = self.steps.crash(i, number, world.top)
                if back != number or sent & ~net:
                    new = self._with(world, i, back, sent)
                    yield (i, "crashes, and comes back", 0), self._deafened(new, i)
            if self.names[i] in world.left.wipes:
                yield (i, "loses its disk", 0), self._wiped(world, i)
            if self.names[i] in world.left.copies:
                yield self._copied(world, i, number)
        if world.top:
            yield (-1, "The oldest asking lapses", 0), self._lapsed(world)

    def _after(self, world: GuardedWorld, it: Happening, party: int, sent: int, acked: int) -> GuardedWorld:
        acked |= world.acked & ~it.forgets
        top = world.top if it.top < 0 else it.top
        world = world._replace(acked=acked, top=top, left=it.left or world.left)
        return self._with(world, it.i, party, sent)

    def _with(self, world: GuardedWorld, i: int, party: int, sent: int) -> GuardedWorld:
        parties = (*world.parties[:i], party, *world.parties[i + 1 :])
        reign = world.reign
        now = self.steps.parties[party]
        if now.acts:
            reign = max(reign, now.record.epoch)
        net = self.pruning.pruned(world.net | sent, parties)
        return world._replace(parties=parties, net=net, reign=reign)

    def _lapsed(self, world: GuardedWorld) -> GuardedWorld:
        parties = tuple(self.steps.lapsed(number) for number in world.parties)
        net = self.pruning.pruned(self.pruning.lapsed(world.net), parties)
        return world._replace(parties=parties, net=net, top=world.top - 1)

    def _deafened(self, world: GuardedWorld, i: int) -> GuardedWorld:
        """Returns the world once a guardian has begun a new life: what was said to the former one is known as such."""
        if not self.scenario.goodbyes:
            return world
        net = self.pruning.of_former_life(world.net, self.names[i])
        return world._replace(net=self.pruning.pruned(net, world.parties)) if net != world.net else world

    def _copied(self, world: GuardedWorld, i: int, number: int) -> tuple[Any, GuardedWorld]:
        name, party = self.names[i], self.steps.parties[number]
        if party.backup is None:
            return (i, "has its disk copied", 0), self._with(world, i, self.steps.backed_up(number), 0)
        if party.backup.record != party.record or party.register.promised > self._first.epoch:
            self.reached.add(f"{name} comes back with an older disk")
        back, sent = self.steps.restored(i, number, world.top)
        left = world.left._replace(copies=world.left.copies.replace(name, ""))
        new = self._deafened(self._with(world._replace(left=left), i, back, sent), i)
        return (i, "comes back with the copy of its disk", 0), new

    def _wiped(self, world: GuardedWorld, i: int) -> GuardedWorld:
        name = self.names[i]
        self.reached.add(f"{name} loses its disk")
        old = self.steps.parties[world.parties[i]]
        blank = self.steps.number(Party(Record(TASK), journal=old.journal + 1))
        net = sum(
            low
            for low, message in self.pruning.each(world.net)
            if not (isinstance(message, Word) and message.to == name)
        )
        left = world.left._replace(wipes=world.left.wipes.replace(name, ""))
        return self._with(world._replace(net=net, left=left), i, blank, 0)

    # What may happen -------------------------------------------------------------------------------------------

    def _happenings(self, world: GuardedWorld) -> Iterator[Happening]:
        news: Any = None
        for i, number in enumerate(world.parties):
            concern: Any = None
            if self.steps.is_concerned(i, number):
                news = news or tuple(map(self.steps.news, world.parties))
                concern = news, world.acked & STOPPED
            net = world.net & self.steps.heard_by(i, number)
            key = i, number, net, world.top, world.left, concern
            found = self._rows.get(key)
            if found is None:
                found = self._rows[key] = list(self._of_agent(world, i, number, net))
            yield from found

    def _of_agent(self, world: GuardedWorld, i: int, number: int, net: int) -> Iterator[Happening]:
        heard = [message for _, message in self.pruning.each(net)]
        parties = [self.steps.parties[other] for other in world.parties]
        party = parties[i]
        if party.owns:
            yield from self._of_owner(world, i, number, party, heard)
            yield from self._of_others(world, i, number, party, parties)
        elif party.record.phase is Phase.COMMITTED:
            yield from self._of_others(world, i, number, party, parties)
            late = GiveUp(party.record.offer, "late")
            yield Happening("gives the hand-off up, too late", i, self.steps.decide(i, number, late))
        elif party.record.phase is Phase.PREPARED and party.taking is None:
            yield from self._of_offer(i, number, party, parties)
        yield from self._of_taker(world, i, number, party, parties, heard)
        yield from self._of_people(world, i, number, party, parties)
        if party.lease.epoch is not None and not party.until:
            yield Happening("finds its lease over", i, self.steps.guard(i, number, LeaseOver(0)))
        for message in heard:
            match message:
                case KeepLease() | SeizeTask() | Farewell():
                    yield Happening(message, i, self.steps.guard(i, number, message))
                case Word(source, _, word):
                    yield Happening(message, i, self.steps.decide(i, number, Received(source, word)))

    def _of_owner(
        self, world: GuardedWorld, i: int, number: int, party: Party, heard: list[Message]
    ) -> Iterator[Happening]:
        s, record, steps = self.scenario, party.record, self.steps
        if world.top < s.window and len(party.asked) < s.own:
            for with_body in (True, False) if s.bare else (True,):
                yield Happening("asks for leases", i, steps.renew(i, number, world.top, with_body), world.top + 1)
        votes: dict[Any, list[LeaseKept]] = {}
        for message in heard:
            if isinstance(message, LeaseKept) and message.epoch == record.epoch:
                votes.setdefault(message.guardian, []).append(message)
        for size in range(1, len(votes) + 1):
            for chosen in itertools.combinations(sorted(votes), size):
                if size > 1 and not self._is_least(record.guards, chosen):
                    continue
                answers = tuple(answer for guardian in chosen for answer in votes[guardian])
                yield Happening(answers, i, steps.votes(i, number, answers))
        if record.phase is Phase.FROZEN:
            yield Happening("gives the hand-off up", i, steps.decide(i, number, GiveUp(record.offer, "late")))
            return
        if party.acts:
            for seq in range(s.packets):
                if not party.actor >> seq & 1:
                    snapshot = bytes([party.actor | 1 << seq])
                    event = Checkpoint(record.epoch, record.incarnation, snapshot, (PacketId(STREAM, seq),))
                    yield Happening(f"takes packet {seq} in", i, self._taken_in(i, number, event))
            if world.left.moves and record.seen.n < s.numbers:
                for peer in s.moves:
                    if peer != self.names[i]:
                        left = world.left._replace(moves=0)
                        yield Happening(f"hands it over to {peer}", i, steps.hand_over(i, number, peer), -1, left)
        if world.left.swaps and len(record.guards.sets) == 1:
            both = GuardsChosen((record.guards.sets[0], self._swap))
            yield Happening("replaces guardians", i, steps.decide(i, number, both), -1, world.left._replace(swaps=0))

    def _taken_in(self, i: int, number: int, event: Checkpoint) -> Outcome:
        """The task takes a packet in, and is written down."""
        party = self.steps.parties[number]
        taken = self.steps.number(party._replace(actor=event.snapshot[0]))
        return self.steps.decide(i, taken, event)

    def _is_least(self, guards: Guards, chosen: tuple[Any, ...]) -> bool:
        """Returns whether these are a quorum, and without any of them none: more say no more, one by one."""
        return guards.has_quorum(chosen) and not any(
            guards.has_quorum([it for it in chosen if it != one]) for one in chosen
        )

    def _of_others(
        self, world: GuardedWorld, i: int, number: int, party: Party, parties: list[Party]
    ) -> Iterator[Happening]:
        """What an owner hears of what guardians have promised, and of what other agents own."""
        record = party.record
        denied = tuple(
            DenyLease(TASK, record.epoch, me, other.register.promised, "")
            for at, other in enumerate(parties)
            if other.register.promised > record.epoch and (me := self.steps.me(at, other)) in record.guards.members()
        )
        if denied and party.owns:
            yield Happening(denied, i, self.steps.votes(i, number, denied))
        for at, other in enumerate(parties):
            if at != i and other.owns and other.record.epoch > record.epoch:
                claim = ClaimHeard(self.names[at], other.record.epoch)
                yield Happening(claim, i, self.steps.decide(i, number, claim))

    def _of_offer(self, i: int, number: int, party: Party, parties: list[Party]) -> Iterator[Happening]:
        """What the destination of a hand-off hears of what other agents own."""
        for at, other in enumerate(parties):
            if at != i and other.owns:
                claim = ClaimHeard(self.names[at], other.record.epoch)
                outcome = self.steps.decide(i, number, claim)
                if self.steps.parties[outcome.party].record.phase is Phase.ABSENT:
                    self.reached.add("an offer is overtaken")
                yield Happening(claim, i, outcome)

    def _of_taker(
        self, world: GuardedWorld, i: int, number: int, party: Party, parties: list[Party], heard: list[Message]
    ) -> Iterator[Happening]:
        s, steps, taking = self.scenario, self.steps, party.taking
        promised = sorted({self._first.epoch, *(it.register.promised for it in parties)})
        if self.names[i] in s.takers and (taking is None or not taking.source):
            guards = max(party.register.guards, party.record.guards, self._first, key=lambda it: it.stamp)
            seen = max(party.record.seen.n, taking.epoch.n if taking is not None else 0)
            for floor in {it.n: it for it in promised}.values():
                if seen < max(party.record.seen.n, floor.n) + 1 <= s.called:
                    yield Happening(f"is called (above {short(floor)})", i, steps.called(i, number, floor, guards))
        if taking is None:
            return
        if taking.source and promised[-1] > taking.epoch and promised[-1].n < s.numbers + 1:
            yield Happening("asks anew", i, steps.asked_anew(i, number, promised[-1]))
        votes = {it.guardian: it for it in heard if isinstance(it, Pledge) and it.epoch == taking.epoch}
        for size in range(1, len(votes) + 1):
            for chosen in itertools.combinations(sorted(votes), size):
                pledges = tuple(votes[guardian] for guardian in chosen)
                yield Happening(pledges, i, steps.pledges(i, number, pledges))

    def _of_people(
        self, world: GuardedWorld, i: int, number: int, party: Party, parties: list[Party]
    ) -> Iterator[Happening]:
        left, steps, record = world.left, self.steps, party.record
        if self.scenario.stops and record.phase is Phase.OWNER:
            if left.stops and record.wanted is Wanted.RUNNING:
                event = Ended(Wanted.STOPPED, bytes([party.actor]) if party.actor >= 0 else b"")
                yield Happening(
                    "is told to stop the task", i, steps.decide(i, number, event), -1, left._replace(stops=0)
                )
            if record.wanted is Wanted.STOPPED and world.acked & STOPPED:
                yield Happening("is told to start it", i, steps.decide(i, number, RunAsked()), -1, None, STOPPED)
        if left.goodbyes and record.phase is Phase.OWNER and party.owns:
            said = steps.goodbye(i, number, world.top)
            back, sent = steps.crash(i, said.party, world.top)
            outcome = Outcome(back, said.sent | sent, 0)
            yield Happening("is shut down, and comes back", i, outcome, -1, left._replace(goodbyes=left.goodbyes - 1))
        if left.adopts and record.phase in (Phase.COMMITTED, Phase.PREPARED) and self._may_adopt(world, i, parties):
            self.reached.add("adopted")
            adopt = AdoptionAsked(guardian=steps.me(i, party))
            yield Happening("is told to adopt it", i, steps.decide(i, number, adopt), -1, left._replace(adopts=0))

    def _may_adopt(self, world: GuardedWorld, i: int, parties: list[Party]) -> bool:
        """Returns whether a person who makes no mistake may do so: most guardians are gone, and every other owner."""
        there = {self.steps.me(at, it) for at, it in enumerate(parties)}
        lost = [one for one in self._first.sets[0] if one not in there]
        others = [it.record.phase for at, it in enumerate(parties) if at != i]
        return self._first.has_quorum(lost) and not any(phase in OWNED for phase in others)
