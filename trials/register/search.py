"""Searches all interleavings of the rules of a durable task's registers, within the bounds of a scenario.

The network is the set of all messages that were sent and may still matter: so they may be lost, doubled, late and out
of order. An agent may crash between any two effects, and comes back. A timer may fire at any time. Time is an order of
lapses: each request for leases takes a number, its beat; beats lapse in that order, at any moment; the permit of an
owner ends no later than that, the lease of a member no earlier; a restarted member waits for all beats.

What must be true in every state:

S1: at most one agent acts. A person's wrong word, and a copy that nobody notices, excuse it until all are linked.
S2: the epoch that acts, and the one that is promised on a disk, never go back.
S3: what was acknowledged is in the state that acts.
S4: no packet has its effect twice.
S5: no two disks hold different writes of one stamp.
S6: a task whose stop was answered does not act until a start is asked for; a removed one not under its old epochs.
S7: a person's wrong word destroys nothing; of two owners the one with the lower epoch rests; no agent rests, or lets
    a state go, because another one lies.

L1: from every configuration of disks, with all messages and memory lost, and any one agent gone for good if the others
are a quorum, a few rounds in which nothing goes wrong lead to exactly one that acts, with all packets acknowledged and
no agent in doubt; or it is right that none acts, for a reason in `_why_none`.
"""

from __future__ import annotations

import itertools
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from types import ModuleType
from typing import Any

from register.healing import Healing
from register.scenarios import Scenario, identities
from register.world import (
    BACKUPS,
    DISPUTED,
    DRAWS,
    JUNK,
    KINDS,
    MAY_HAVE_IT,
    REMOVED,
    RESTORES,
    RUN,
    STOPPED,
    Letter,
    Local,
    Outcome,
    Result,
    State,
    Violation,
    World,
    is_vouched,
    shown,
)

from pancakes.durable import rules as product
from pancakes.durable.register import (
    BLANK,
    MORE_THAN_MIGRATIONS,
    NO_EPOCH,
    NOBODY,
    Epoch,
    Identity,
    Register,
    Standing,
    is_quorum,
    standing_of,
)
from pancakes.durable.rules import (
    Accept,
    Accepted,
    Ask,
    Beat,
    Begin,
    Call,
    Confirmed,
    Counts,
    Desired,
    Force,
    GiveUp,
    Goodbye,
    Grant,
    Known,
    Lease,
    Memory,
    Offer,
    Persist,
    Place,
    Prepare,
    Promise,
    Remember,
    Save,
    Send,
    SetMembers,
    Want,
)


class Search:
    """Search a scenario breadth-first, so that the way to a violation is a shortest one.

    Args:
        scenario: what may happen.
        rules: the rules; a broken variant of the product's module, or the module itself.
        flaws: what is broken outside the rules, for variants: see `register.mutants`.
        limit: after this number of states the search is given up.
        heals: whether L1 is searched as well.
    """

    def __init__(
        self,
        scenario: Scenario,
        rules: ModuleType = product,
        flaws: frozenset[str] = frozenset(),
        limit: int = 2_000_000,
        heals: bool = True,
    ) -> None:
        self.s, self.rules, self.flaws, self.limit = scenario, rules, flaws, limit
        self.is_variant = rules is not product or bool(flaws)
        self.names = scenario.agents.replace(scenario.liar, "") if scenario.liar else scenario.agents
        self.liar = Identity(scenario.liar) if scenario.liar else NOBODY
        # What a lying member takes over by the rules is its own: of its fellows it is asked only that no two act.
        self.is_inside = self.liar in identities(scenario.members) and bool(scenario.liar)
        self.heals = heals and not self.is_inside
        self.lies = scenario.lies.split()
        self.swap = identities(scenario.swap)
        self.guards = identities(scenario.members)
        self.undrawn = max(0, len(DRAWS) - scenario.draws)
        self.pool: list[Local] = []
        self.ids: dict[Local, int] = {}
        self.messages: list[Any] = []
        self.bits: dict[Any, int] = {}
        self.memo: dict[Any, Outcome] = {}
        self.lapsed: dict[int, int] = {}
        self.lapsed_messages: dict[int, int] = {}
        self.pruned: dict[Any, int] = {}
        self.deaf: dict[tuple[int, int], tuple[bool | None, int]] = {}
        self.acting: dict[int, bool] = {}
        self.lies_of: dict[Any, tuple[Any, ...]] = {}
        self.reached: set[str] = set()
        self.waits: Counter[str] = Counter()
        self.transitions = self.healings = 0

    # Numbers for agents and messages --------------------------------------------------------------------------

    def number_of(self, local: Local) -> int:
        """Return the number of an agent's state."""
        number = self.ids.get(local)
        if number is None:
            number = self.ids[local] = len(self.pool)
            self.pool.append(local)
        return number

    def bit_of(self, message: Any) -> int:
        """Return the bit of a message."""
        key = (type(message), message)
        number = self.bits.get(key)
        if number is None:
            number = self.bits[key] = len(self.messages)
            self.messages.append(message)
        return 1 << number

    def each(self, net: int) -> Iterator[tuple[int, Any]]:
        """Yield the messages of a network, with their bits."""
        while net:
            low = net & -net
            net ^= low
            yield low, self.messages[low.bit_length() - 1]

    # One agent ------------------------------------------------------------------------------------------------

    def place_of(self, local: Local) -> Place:
        return Place(local.me, local.register, local.memory, local.lease, local.draw)

    def apply(self, local: Local, effects: Iterable[Any]) -> tuple[Local, int, int, Register | None, bool]:
        """Carry out effects; return the agent, what it sent, acknowledged and answered, and whether it asks."""
        me, register, memory, lease, draws = local
        sent = acked = 0
        told: Register | None = None
        asks = False
        for effect in effects:
            kind = type(effect)
            if kind is Persist:
                if effect.register.promised < register.promised:
                    raise Violation(f"S2: {me} went back on its promise")
                register = effect.register
            elif kind is Remember:
                memory = effect.memory
            elif kind is Grant:
                lease = effect.lease
            elif kind is Send:
                if self.s.known or type(effect.message) is not Known:
                    sent |= self.bit_of(effect.message)
            elif kind is Counts:
                if effect.register.state is not None:
                    acked = max(acked, effect.register.state.upto)
                if effect.register.wanted in (STOPPED, REMOVED):
                    told = effect.register
            elif kind is Ask:
                asks = True
        return Local(me, register, memory, lease, draws), sent, acked, told, asks

    def effects_of(self, local: Local, event: Any) -> list[Any]:
        """Return the effects of an event; a packet is handled as the task and its service do."""
        if type(event) is Letter:
            register = local.register
            if not self.acts_as(local) or event.seq > register.state.upto + 1:
                return []
            if event.seq <= register.state.upto:
                # It had its effect, and that was written; of a guarded task it is acknowledged when that counts.
                return [Counts(register)] if register.unguarded else []
            event = Save(State(register.state.effects + 1, event.seq))
        return list(self.rules.handle(self.place_of(local), event))

    def outcome(self, number: int, event: Any) -> Outcome:
        """Return what comes of an event at an agent."""
        key = (number, type(event), event)
        found = self.memo.get(key)
        if found is None:
            local = self.pool[number]
            found = self.memo[key] = self.carried_out(local, self.effects_of(local, event))
        return found

    def carried_out(self, local: Local, effects: list[Any]) -> Outcome:
        """Return what comes of effects, of a crash after each of them, and of a failure of each write among them."""
        cuts, fails = [], []
        for count, effect in enumerate(effects):
            part, sent, acked, told, _ = self.apply(local, effects[:count])
            if part.register != local.register or sent or acked or told is not None:
                cuts.append(Outcome(self.number_of(part), sent, acked, told))
            if type(effect) is Persist:
                part = part._replace(memory=self.undone(local.memory, part.memory))
                if part != local or sent:
                    fails.append(Outcome(self.number_of(part), sent, acked, told))
        after, sent, acked, told, asks = self.apply(local, effects)
        return Outcome(self.number_of(after), sent, acked, told, tuple(cuts), tuple(fails), asks)

    def undone(self, before: Memory, after: Memory) -> Memory:
        """Return what an agent remembers if it could not write: what it did before the event, but a shorter permit."""
        if "memory stays" in self.flaws:
            return after
        return before._replace(permit=min(before.permit, after.permit))

    def counted(self, number: int, votes: tuple[Any, ...]) -> Outcome:
        """Return what comes of several votes: until they suffice, one that was heard is no more than one that waits."""
        key = (number, "votes", votes)
        found = self.memo.get(key)
        if found is None:
            before = local = self.pool[number]
            sent = acked = 0
            told: Register | None = None
            cuts = []
            for vote in votes:
                effects = self.effects_of(local, vote)
                for count in range(1, len(effects)):
                    part, more, last, said, _ = self.apply(local, effects[:count])
                    if part.register != before.register or sent | more or last or said is not None:
                        cuts.append(Outcome(self.number_of(part), sent | more, max(acked, last), said or told))
                local, more, last, said, _ = self.apply(local, effects)
                sent, acked, told = sent | more, max(acked, last), said or told
            local = local._replace(memory=local.memory._replace(answers=(), promises=()))
            found = self.memo[key] = Outcome(self.number_of(local), sent, acked, told, tuple(cuts))
        return found

    def restarted(self, number: int, top: int) -> Outcome:
        """Return an agent after a crash and a restart."""
        key = (number, "restart", top)
        found = self.memo.get(key)
        if found is None:
            local = self.pool[number].restarted()
            found = self.memo[key] = self.carried_out(local, self.rules.recover(self.place_of(local), top))
        return found

    def said_again(self, number: int) -> Outcome:
        key = (number, "again")
        found = self.memo.get(key)
        if found is None:
            local = self.pool[number]
            found = self.memo[key] = self.carried_out(local, self.rules.resend(self.place_of(local)))
        return found

    def acts_as(self, local: Local) -> bool:
        return self.rules.desired(local.me, local.register, local.memory) is Desired.RUN

    def acts(self, number: int) -> bool:
        """Return whether the task acts on an agent."""
        found = self.acting.get(number)
        if found is None:
            found = self.acting[number] = self.acts_as(self.pool[number])
        return found

    # Time -----------------------------------------------------------------------------------------------------

    def lapse(self, number: int) -> int:
        """Return an agent after the oldest beat has lapsed."""
        found = self.lapsed.get(number)
        if found is None:
            local = self.pool[number]
            permit = local.memory.permit
            if not ("gate" in self.flaws and permit == 1):
                permit = max(0, permit - 1)
            beat = max(0, local.lease.beat - 1)
            if "short lease" in self.flaws and beat == 1:
                beat = 0
            lease = Lease(local.lease.epoch, beat) if beat else Lease()
            after = local._replace(memory=local.memory._replace(permit=permit), lease=lease)
            found = self.lapsed[number] = self.number_of(after)
        return found

    def lapse_net(self, net: int) -> int:
        """Return the messages after the oldest beat has lapsed."""
        after = 0
        for low, message in self.each(net):
            bit = self.lapsed_messages.get(low)
            if bit is None:
                bit = low
                if type(message) in (Accept, Accepted) and message.beat:
                    bit = self.bit_of(message._replace(beat=message.beat - 1))
                self.lapsed_messages[low] = bit
            after |= bit
        return after

    # The network ----------------------------------------------------------------------------------------------

    def prune(self, net: int, numbers: tuple[int, ...], may_go_back: bool) -> int:
        """Drop the messages that can change nothing any more, whatever happens; none if a disk may still go back."""
        if may_go_back:
            return net
        key = (net, numbers)
        found = self.pruned.get(key)
        if found is None:
            if len(self.pruned) > 300_000:
                self.pruned.clear()
            found = self.pruned[key] = self._alive(net, numbers)
        return found

    def _alive(self, net: int, numbers: tuple[int, ...]) -> int:
        agents = [self.pool[number] for number in numbers]
        alive = net
        best: dict[Any, list[tuple[int, Accepted]]] = {}
        for low, message in self.each(net):
            kind = type(message)
            if kind is Accepted:
                owner = next((it for it in agents if it.me == message.epoch.minter), None)
                register = owner.register if owner else BLANK
                if register.epoch != message.epoch or (register.promised > message.epoch and not self.is_variant):
                    alive ^= low
                    continue
                is_old = message.beat == 0 and message.no < register.no and len(register.sets) == 1
                if is_old and message.by != register.heir:
                    alive ^= low
                    continue
                rest = best.setdefault((message.epoch, message.by), [])
                for other_low, other in rest[:]:
                    if other.beat >= message.beat and other.no >= message.no:
                        alive ^= low
                        break
                    if other.beat <= message.beat and other.no <= message.no:
                        alive ^= other_low
                        rest.remove((other_low, other))
                else:
                    rest.append((low, message))
            elif kind is Promise:
                owner = next((it for it in agents if it.me == message.epoch.minter), None)
                if owner is None or owner.memory.taking != message.epoch or owner.register.epoch >= message.epoch:
                    alive ^= low
        for low, message in self.each(alive):
            if type(message) in (Accept, Known, Prepare) and all(
                self.is_deaf(number, low, message, alive) for number in numbers
            ):
                alive ^= low
        return alive

    def is_deaf(self, number: int, low: int, message: Any, net: int) -> bool:
        """Return whether a message can never change anything at an agent."""
        key = (number, low)
        found = self.deaf.get(key)
        if found is None:
            found = self.deaf[key] = self._deafness(number, message, net)
        dead, sent = found
        return not sent & ~net if dead is None else dead

    def _deafness(self, number: int, message: Any, net: int) -> tuple[bool | None, int]:
        """Return whether it is; None: it is, if the messages (second) are in the network already."""
        local, kind = self.pool[number], type(message)
        me, register = local.me, local.register
        if kind is Accept and message.to not in (NOBODY, me):
            return True, 0
        after = self.outcome(number, message)
        if after.asks:
            return False, 0
        changes = after.local != number or bool(after.acked) or after.told is not None
        if kind is Prepare:
            is_member = any(me in one for one in message.sets) or me in register.members or me in self.swap
            if not is_member or register.promised > message.epoch:
                return True, 0
            if register.promised == message.epoch:
                return (True, 0) if register.epoch >= message.epoch else (None, after.sent)
            return False, 0
        new = message.register
        if kind is Known or not (me in new.members or new.heir == me):
            is_mine = me in (register.owner, register.heir) and new.stamp > register.stamp
            return not changes and not is_mine, 0
        if new.owner == me:
            return True, 0
        if new.epoch < register.promised and not self.is_variant:
            return True, 0
        has_lease = local.lease.epoch == new.epoch and local.lease.beat >= message.beat
        is_news = new.stamp > register.stamp or (message.beat > 0 and not has_lease)
        if new.heir == me and new.stamp == register.stamp:
            kept = sum(low for low, it in self.each(net | after.sent) if type(it) is Accepted)
            return None, after.sent & kept
        return (False, 0) if is_news or changes else (None, after.sent)

    # Promises -------------------------------------------------------------------------------------------------

    def step(self, world: World, index: int, outcome: Outcome, **more: Any) -> World:
        """Return the world after an event at an agent."""
        numbers = world.locals[:index] + (outcome.local,) + world.locals[index + 1 :]
        reign = world.reign
        if self.acts(outcome.local):
            reign = max(reign, self.pool[outcome.local].register.epoch)
        stopped, removed = more.pop("stopped", world.stopped), world.removed
        if outcome.told is not None:
            if outcome.told.wanted is STOPPED:
                # A late answer to a stop says nothing if a start has followed it elsewhere.
                stopped = stopped or outcome.told.epoch >= world.started
                self.reached.add("stopped")
            else:
                removed = max(removed, outcome.told.epoch)
                self.reached.add("removed")
        after = world._replace(
            locals=numbers, acked=max(world.acked, outcome.acked), reign=reign, stopped=stopped, removed=removed, **more
        )
        return after._replace(net=self.prune(world.net | outcome.sent, numbers, self.may_go_back(after.left)))

    def may_go_back(self, left: tuple[int, ...]) -> bool:
        """Return whether a disk may still be replaced by an older copy."""
        return bool(self.s.copies) and left[BACKUPS] + left[RESTORES] > 0

    def check(self, world: World) -> None:
        """Check what must be true in every state.

        Raises:
            Violation: it is not.
        """
        acting = [index for index, number in enumerate(world.locals) if self.acts(number)]
        agents = [self.pool[number] for number in world.locals]
        self._note(agents, acting)
        if len(acting) > 1 and not world.excused:
            raise Violation("S1: it acts on " + " and on ".join(agents[it].me.agent for it in acting) + " at once")
        for index in acting:
            self._check_acting(world, agents[index])
        states = [it.register.state for it in agents if it.register.state is not None]
        if self.is_inside:
            return
        is_given = bool(self.s.liar) and self.s.liar in self.s.heirs  # the liar was offered the task
        if (self.s.wrong or (self.s.liar and not is_given)) and world.acked:
            if not any(state.upto >= world.acked and state != JUNK for state in states):
                raise Violation("S7: a wrong word has destroyed what was acknowledged")
        highest = max(it.register.epoch for it in agents)
        if not self.s.wipes and any(it.register.wanted is DISPUTED and it.register.epoch == highest for it in agents):
            raise Violation("S7: the owner of the highest epoch rests for another one")
        if not world.excused:
            held: dict[Any, Register] = {}
            for it in agents:
                if it.register.state is not None:
                    value = it.register.as_written()
                    if held.setdefault(it.register.stamp, value) != value:
                        raise Violation(f"S5: two writes of one stamp, {it.register.epoch}/{it.register.no}")

    def _check_acting(self, world: World, local: Local) -> None:
        register, me = local.register, local.me.agent
        state = register.state
        if self.is_inside:
            return
        if state.effects > state.upto or state.upto > self.s.letters:
            raise Violation(f"S4: {state.effects} effects of {self.s.letters} packets")
        if world.stopped and not world.excused:
            raise Violation(f"S6: {me} acts, and the stop was answered")
        if register.epoch <= world.removed:
            raise Violation(f"S6: {me} acts under {register.epoch}, and it was removed")
        if world.excused:
            return
        is_kept = not world.lost or len(self.guards) > 1  # an unguarded task is lost with its disk
        if state.upto < world.acked and world.removed == NO_EPOCH and is_kept:
            raise Violation(f"S3: {me} acts without what was acknowledged")
        if register.epoch < world.reign:
            raise Violation(f"S2: {me} acts under {register.epoch}, and {world.reign} has acted")

    def _note(self, agents: list[Local], acting: list[int]) -> None:
        """Note what the search has come to."""
        for index in acting:
            self.reached.add(self.names[index])
            if self.swap and agents[index].register.sets == (self.swap,):
                self.reached.add("swapped")
        for it in agents:
            standing = standing_of(it.me, it.register)
            if standing in (Standing.HEIR, Standing.YIELDED, Standing.RELEASED, Standing.DISPUTED):
                self.reached.add(standing.name)
            if it.register.owner == it.me and it.memory.offered:
                self.reached.add("offered")

    # What may happen ------------------------------------------------------------------------------------------

    def moves_of(self, world: World) -> Iterator[tuple[Any, int, Outcome, dict[str, Any]]]:
        """Yield what may happen next: an event, the agent, what comes of it, and what else changes."""
        scenario = self.s
        left = dict(zip(KINDS, world.left, strict=True))

        def less(kind: str) -> dict[str, Any]:
            return {"left": tuple(count - (it == kind) for it, count in zip(KINDS, world.left, strict=True))}

        heard = [message for _, message in self.each(world.net)]
        floors = sorted({self.pool[number].register.promised for number in world.locals})
        for index, name in enumerate(self.names):
            number = world.locals[index]
            local = self.pool[number]
            me, register, memory = local.me, local.register, local.memory
            if register.owner == me:
                yield from self._of_owner(world, index, local, heard, left, less)
            elif register.heir == me and register.state is not None:
                if memory.taking == NO_EPOCH and self._is_within(register.epoch, register.promised):
                    yield "asks again", index, self.said_again(number), {}
            if name in scenario.takers and not self.acts(number):
                sets = register.sets or (self.guards,)
                for floor in floors:
                    if self._is_within(register.epoch, register.promised, floor):
                        yield Call(floor, sets), index, self.outcome(number, Call(floor, sets)), {}
            if memory.taking != NO_EPOCH:
                yield from self._promises(index, local, heard)
            for message in heard:
                if type(message) in (Accept, Prepare, Known):
                    yield from self._message(world, index, message)
            if self.liar != NOBODY:
                yield from self._lies(world, index)
            yield from self._rare(world, index, local, left, less)

    def _message(self, world: World, index: int, message: Any) -> Iterator[tuple[Any, int, Outcome, dict[str, Any]]]:
        number = world.locals[index]
        out = self.outcome(number, message)
        if type(message) is not Known or self._is_within(self.pool[out.local].memory.taking, more=1):
            yield message, index, out, {}
        if out.asks and self.is_confirmed(world, index, message):
            yield Confirmed(message), index, self.outcome(number, Confirmed(message)), {}
        if self.s.lags and type(message) is Accept and message.beat:
            part = message._replace(whole=False)
            late = self.outcome(number, part)
            yield part, index, late, {}
            if late.asks and self.is_confirmed(world, index, message):
                yield Confirmed(part), index, self.outcome(number, Confirmed(part)), {}

    def is_confirmed(self, world: World, index: int, message: Any) -> bool:
        """Return whether others confirm the claim of a message that an honest agent has sent.

        A member asks the members that it knows whether they have promised that epoch. What any other claims is true.
        """
        local = self.pool[world.locals[index]]
        if type(message) is Prepare:
            return message.epoch.minter.agent in self.s.takers
        registers = {it.me: it.register for it in (self.pool[number] for number in world.locals)}
        return is_vouched(local.me, local.register, local.lease, message, registers)

    def _is_within(self, *epochs: Epoch, more: int = 0) -> bool:
        """Return whether an epoch above all of these is within the bounds."""
        return max(epoch.n for epoch in epochs) % MORE_THAN_MIGRATIONS < self.s.numbers + more

    def _of_owner(
        self, world: World, index: int, local: Local, heard: list[Any], left: dict[str, int], less: Any
    ) -> Iterator[tuple[Any, int, Outcome, dict[str, Any]]]:
        scenario, number = self.s, world.locals[index]
        register, memory = local.register, local.memory
        if not register.unguarded:
            if world.top < scenario.window and register.promised <= register.epoch:
                beat = Beat(world.top + 1)
                yield beat, index, self.outcome(number, beat), {"top": world.top + 1}
            yield from self._votes(world, index, local, heard)
        if "gate" in self.flaws and memory.permit == 1 and world.top == 0:
            noticed = self.number_of(local._replace(memory=memory._replace(permit=0)))
            yield "notices that its permit is over", index, Outcome(noticed, 0, 0, None), {}
        late = self._late_states(register)
        if self.acts(number):
            for seq in range(1, scenario.letters + 1):
                yield Letter(seq), index, self.outcome(number, Letter(seq)), {}
            for heir in scenario.heirs if left["moves"] else "":
                is_liar = heir == self.liar.agent
                who = self.liar if is_liar else self.pool[world.locals[self.names.index(heir)]].me
                for offer in (Offer(who), *(Offer(who, state) for state in late)):
                    yield offer, index, self.outcome(number, offer), less("moves")
            if left["swaps"]:
                yield SetMembers(self.swap), index, self.outcome(number, SetMembers(self.swap)), less("swaps")
        if left["goodbyes"]:
            yield Goodbye(), index, self.outcome(number, Goodbye()), less("goodbyes")
        if left["stops"] and register.wanted in (RUN, DISPUTED):
            for stop in (Want(STOPPED), *(Want(STOPPED, state) for state in late)):
                yield stop, index, self.outcome(number, stop), less("stops")
        if left["starts"] and register.wanted is STOPPED:
            started = less("starts") | {"stopped": False, "started": register.epoch}
            yield Want(RUN), index, self.outcome(number, Want(RUN)), started
        if left["removes"] and register.wanted is STOPPED and world.stopped:
            yield Want(REMOVED), index, self.outcome(number, Want(REMOVED)), less("removes")
        if register.heir != NOBODY:
            yield GiveUp(), index, self.outcome(number, GiveUp()), {}

    def _late_states(self, register: Register) -> tuple[State, ...]:
        """Return with what the actor may come to rest: it has handled a packet since its state was written last."""
        state = register.state
        if state is None or register.heir != NOBODY or state.upto >= self.s.letters:
            return ()
        return (State(state.effects + 1, state.upto + 1),)

    def _votes(
        self, world: World, index: int, local: Local, heard: list[Any]
    ) -> Iterator[tuple[Any, int, Outcome, dict[str, Any]]]:
        register, number = local.register, world.locals[index]
        said: dict[Identity, list[Accepted]] = {}
        for message in heard:
            if type(message) is Accepted and message.epoch == register.epoch:
                said.setdefault(message.by, []).append(message)
        if self.liar in register.members and "Accepted" in self.lies:
            said[self.liar] = [Accepted(register.epoch, self.liar, world.top, register.no)]
        if register.heir != NOBODY and not local.memory.offered:
            for message in said.pop(register.heir, ()):
                if message.no == register.no:
                    yield message, index, self.outcome(number, message), {}
        for size in range(1, len(said) + 1):
            for who in itertools.combinations(sorted(said), size):
                is_least = is_quorum(register.sets, set(who)) and not any(
                    is_quorum(register.sets, set(who) - {it}) for it in who
                )
                if not is_least and not (self.is_variant and size == 1 and len(register.sets) == 2):
                    continue
                votes = tuple(message for it in who for message in said[it])
                out = self.counted(number, votes)
                if "late count" in self.flaws and self.acts(out.local) and out.local != number:
                    late = self.pool[out.local]
                    late = late._replace(memory=late.memory._replace(permit=world.top + 1))
                    yield votes, index, out._replace(local=self.number_of(late)), {"top": world.top + 1}
                elif out.local != number or out.acked or out.told is not None:
                    yield votes, index, out, {}

    def _promises(
        self, index: int, local: Local, heard: list[Any]
    ) -> Iterator[tuple[Any, int, Outcome, dict[str, Any]]]:
        number, taking = self.ids[local], local.memory.taking
        votes = {it.by: it for it in heard if type(it) is Promise and it.epoch == taking}
        if self.liar in (local.register.members or self.guards) and "Promise" in self.lies:
            for forged in self._forged(local):
                votes[self.liar] = Promise(taking, self.liar, forged)
                yield from self._counted_promises(index, number, votes)
            return
        yield from self._counted_promises(index, number, votes)

    def _counted_promises(
        self, index: int, number: int, votes: dict[Identity, Promise]
    ) -> Iterator[tuple[Any, int, Outcome, dict[str, Any]]]:
        for size in range(1, len(votes) + 1):
            for who in itertools.combinations(sorted(votes), size):
                said = tuple(votes[it] for it in who)
                out = self.counted(number, said)
                if out.local != number:
                    yield said, index, out, {}

    # Lies -----------------------------------------------------------------------------------------------------

    def _forged(self, local: Local) -> tuple[Register, ...]:
        """Return registers that a lying member shows: an old one, and one that names other members."""
        register = local.register
        old = register._replace(no=0, since=0, heir=NOBODY, state=State(), promised=local.memory.taking)
        other = old._replace(epoch=Epoch(1, self.liar), sets=((local.me, self.liar),))
        return (old, other)

    def _lies(self, world: World, index: int) -> Iterator[tuple[Any, int, Outcome, dict[str, Any]]]:
        number = world.locals[index]
        for lie in self.lies_to(self.pool[number]):
            yield lie, index, self.outcome(number, lie), {}

    def lies_to(self, local: Local) -> tuple[Any, ...]:
        """Return what the liar may say to an agent, in its own name."""
        register, me = local.register, local.me
        key = (me, register.sets, register.promised, register.stamp)
        found = self.lies_of.get(key)
        if found is None:
            lies: list[Any] = []
            sets = register.sets or (self.guards,)
            number = max(register.promised.n, register.epoch.n, 0) + 1
            epochs = [Epoch(n, self.liar) for n in (number, MORE_THAN_MIGRATIONS + 1)]
            if register.promised.minter == self.liar:
                epochs.append(register.promised)
            for epoch in epochs if number <= self.s.numbers + 1 else ():
                written = Register(epoch, 1, sets, state=JUNK)
                if "Accept" in self.lies:
                    lies += [Accept(written, 0), Accept(written, 1)]
                    lies += [Accept(written._replace(heir=me), 0, me), Accept(written._replace(sets=((me,),)), 0)]
                if "Known" in self.lies:
                    lies.append(Known(self.liar, written._replace(state=None, promised=epoch)))
                if "Prepare" in self.lies and epoch.n <= number:
                    lies.append(Prepare(epoch, (epoch, 0), sets))
            if "Known" in self.lies and register.owner != NOBODY:
                # It claims that another agent wrote something later, or owns the task.
                later = register._replace(no=register.no + 5, state=None, heir=NOBODY, promised=NO_EPOCH)
                lies += [Known(self.liar, later), Known(self.liar, later._replace(epoch=Epoch(number, Identity("B"))))]
            found = self.lies_of[key] = tuple(lies)
        return found

    # What happens rarely --------------------------------------------------------------------------------------

    def _rare(
        self, world: World, index: int, local: Local, left: dict[str, int], less: Any
    ) -> Iterator[tuple[Any, int, Outcome, dict[str, Any]]]:
        scenario, name, number = self.s, self.names[index], world.locals[index]
        others = [self.pool[it] for place, it in enumerate(world.locals) if place != index]
        register = local.register
        floor = max(register.promised, register.epoch, *(max(it.register.promised, it.register.epoch) for it in others))
        if left["begins"] and name in scenario.begins and not self.acts(number):
            event = self._begin(world, local, others, floor)
            if event is not None:
                self.reached.add("begun")
                yield event, index, self.outcome(number, event), less("begins") | {"stopped": False}
        if left["wipes"] and name in scenario.wipes:
            self.reached.add("wiped")
            me = local.me if "lost votes" in self.flaws else local.me._replace(journal="1")
            empty = self.number_of(Local(me, BLANK, Memory(), Lease(), self.undrawn))
            yield "loses its disk", index, Outcome(empty, 0, 0, None), less("wipes") | {"lost": True}
        if left["backups"] and name in scenario.copies:
            yield "is backed up", index, Outcome(number, 0, 0, None), less("backups") | {"saved": register}
        if left["restores"] and name in scenario.copies and world.saved is not None:
            self.reached.add("restored")
            is_noticed = scenario.noticed and "copy owns" not in self.flaws
            me = local.me._replace(copy="1") if is_noticed else local.me
            back = self.number_of(Local(me, world.saved, Memory(), Lease(), self.undrawn))
            out = self.restarted(back, world.top)._replace(cuts=())
            more = less("restores") | {"excused": world.excused or not scenario.noticed, "lost": True}
            yield "has an old copy of its disk", index, out, more
        if left["forces"] and name in scenario.forces and not self.acts(number):
            yield from self._force(world, index, local, others, floor, less)

    def _begin(self, world: World, local: Local, others: list[Local], floor: Epoch) -> Begin | None:
        register = local.register
        registers = [register, *(it.register for it in others)]
        newest = max(registers, key=lambda it: (it.stamp, it.wanted is REMOVED))
        is_copy = bool(local.me.copy) and register.owner.agent == local.me.agent and register.state is not None
        asks = "begins unasked" not in self.flaws
        state = State(world.acked, world.acked)
        if newest.wanted is REMOVED and (register.wanted is REMOVED or register.state is None):
            return Begin(floor, State(self.s.letters, self.s.letters))
        if register == BLANK and (not asks or newest == BLANK):
            return Begin(NO_EPOCH, state)  # its state is lost; S3 is not asked for
        is_newest = all(it.register.stamp < register.stamp or it.register == BLANK for it in others)
        return Begin(floor, state) if is_copy and (not asks or is_newest) else None

    def _force(
        self, world: World, index: int, local: Local, others: list[Local], floor: Epoch, less: Any
    ) -> Iterator[tuple[Any, int, Outcome, dict[str, Any]]]:
        register = local.register
        kept = [it.register for it in (local, *others) if it.register.state is not None]
        might = [it for it in others if standing_of(it.me, it.register) in MAY_HAVE_IT]
        present = {local.me, *(it.me for it in others)}
        decide = any(is_quorum(it.sets, present) for it in kept if not it.unguarded)
        if kept and (self.s.wrong or not (might or decide)):
            state = (max(kept, key=lambda it: it.stamp) if register.state is None else register).state
            told = register.promised if self.s.wrong else floor  # who is wrong has not asked all
            self.reached.add("forced")
            event = Force(told, state)
            out = self.outcome(world.locals[index], event)
            started = {"stopped": False, "started": self.pool[out.local].register.epoch}
            more = less("forces") | started | {"excused": world.excused or self.s.wrong, "lost": True}
            yield event, index, out, more

    # The search -----------------------------------------------------------------------------------------------

    def first(self) -> World:
        """Return the world at the beginning: the task runs on its owner."""
        owner = Identity(self.s.owner)
        epoch = Epoch(0, owner)
        register = Register(epoch, 0, (self.guards,), state=State(), promised=epoch)
        numbers = []
        for name in self.names:
            me = Identity(name)
            is_there = me == owner or me in self.guards
            numbers.append(self.number_of(Local(me, register if is_there else BLANK, Memory(), Lease(), self.undrawn)))
        left = tuple(self.s.left.get(kind, 0) for kind in KINDS)
        return World(tuple(numbers), 0, 0, 0, epoch, False, NO_EPOCH, NO_EPOCH, False, False, left, None)

    def run(self) -> Result:
        """Search everything."""
        began_s = time.perf_counter()
        world = self.first()
        parent: dict[World, Any] = {world: None}
        queue = deque([world])
        healed: set[Any] = set()
        label: Any = None

        def add(new: World) -> None:
            if new not in parent:
                parent[new] = (world, label)
                queue.append(new)

        try:
            while queue:
                world, label = queue.popleft(), None
                self.check(world)
                if self.heals:
                    key = (tuple(self.pool[it][:2] for it in world.locals), world.excused, world.lost, world.removed)
                    if key not in healed:
                        healed.add(key)
                        self.heal_all(world)
                if len(parent) > self.limit:
                    return self._result("unfinished", parent, healed, began_s)
                for what, index, out, more in self.moves_of(world):
                    is_same = out.local == world.locals[index] and not out.sent & ~world.net
                    if is_same and out.acked <= world.acked and not more and out.told is None:
                        continue
                    self.transitions += 1
                    label = (index, what, 0)
                    add(self.step(world, index, out, **more))
                    for failed in out.fails:
                        self.transitions += 1
                        label = (index, what, -1)
                        part = self.step(world, index, failed)
                        add(part)
                        if self.heals:
                            self.heal_all(part, restarted=False)
                    if self._may_crash(index):
                        for count, cut in enumerate(out.cuts, 1):
                            self.transitions += 1
                            label = (index, what, count)
                            part = self.step(world, index, cut, **more)
                            if self.acts(cut.local):
                                self.check(part)
                            self._come_back(part, index, add)
                for index in range(len(self.names)):
                    if self._may_crash(index):
                        label = (index, "crashes and comes back", 0)
                        self._come_back(world, index, add)
                if world.top:
                    label = (-1, "the oldest beat lapses", 0)
                    self.transitions += 1
                    numbers = tuple(self.lapse(it) for it in world.locals)
                    net = self.prune(self.lapse_net(world.net), numbers, self.may_go_back(world.left))
                    add(world._replace(locals=numbers, net=net, top=world.top - 1))
        except Violation as violation:
            return self._result(str(violation), parent, healed, began_s, self._trace(parent, world, label))
        missed = set(self.s.must.split()) - self.reached
        verdict = f"never came to {', '.join(sorted(missed))}" if missed and not self.is_variant else "ok"
        return self._result(verdict, parent, healed, began_s)

    def _may_crash(self, index: int) -> bool:
        return self.s.crashes and (not self.s.crash or self.names[index] in self.s.crash)

    def _come_back(self, world: World, index: int, add: Any) -> None:
        self.transitions += 1
        out = self.restarted(world.locals[index], world.top)
        add(self.step(world, index, out))
        for cut in out.cuts:
            self.transitions += 1
            down = self.number_of(self.pool[cut.local].restarted())
            add(self.step(world, index, cut._replace(local=down)))

    def _trace(self, parent: dict[World, Any], world: World, label: Any) -> tuple[str, ...]:
        labels = [] if label is None else [label]
        while parent[world]:
            world, label = parent[world]
            labels.append(label)
        return tuple(self._sentence(*it) for it in reversed(labels))

    def _sentence(self, index: int, what: Any, count: int) -> str:
        who = f"{self.names[index]} " if index >= 0 else ""
        if count < 0:
            return f"{who}{shown(what)}, but cannot write"
        return f"{who}{shown(what)}" + (f", and crashes after {count} of its effects" if count else "")

    def _result(self, verdict: str, parent: Any, healed: Any, began_s: float, trace: tuple[str, ...] = ()) -> Result:
        seconds = round(time.perf_counter() - began_s, 1)
        return Result(
            verdict, len(parent), self.transitions, len(healed), self.healings, dict(self.waits), seconds, trace
        )

    # L1 -------------------------------------------------------------------------------------------------------

    def heal_all(self, world: World, restarted: bool = True) -> None:
        """Heal a configuration of disks, with nobody or any one agent gone for good.

        Args:
            world: the configuration.
            restarted: whether all agents have started again, and remember nothing.

        Raises:
            Violation: nobody acts afterwards, for no reason, or two do.
        """
        agents = [self.pool[number] for number in world.locals]
        for gone in (None, *range(len(agents))):
            here = {it.me for index, it in enumerate(agents) if index != gone}
            if gone is not None:
                # A task whose members are no quorum any more waits, and so does one that was offered to the lost agent.
                if not all(is_quorum(it.register.sets, here) for it in agents if it.register.sets):
                    continue
                if any(it.register.unguarded for it in agents if it.register.state is not None):
                    continue
            self.healings += 1
            Healing(self, world, agents, gone, restarted).run()
