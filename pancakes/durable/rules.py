"""The rules by which the registers of a durable task change. Pure: no clock, no disk, no network, no randomness.

`handle` takes where an agent stands with a task and an event, and returns effects. They must be carried out strictly
in order, and a crash may come between any two. `desired` says what the task's actor is to do; the agent that carries
out the effects compares it with the actor after each of them. `recover` says what follows a restart, `resend` what is
said again from time to time. `RULES` lists the events with their rules.

In short:

* The owner's next write decides everything. It counts once a quorum of the members has it (`Counts`).
* A new owner mints a higher epoch, asks the members (`Prepare`), and continues from the newest register among the
  promises of a quorum. A member refuses while the lease that it granted runs. The owner of an unguarded task grants no
  lease, and always refuses.
* A migration is a take-over with consent: the owner's write names an heir, whom members do not refuse. Each later write
  of the owner takes the offer back.
* The word of one agent is never enough to destroy a state, or to pause an owner. A member follows an epoch that it has
  not promised only if a quorum of the members has; an owner that gave its task away believes only the agent that got
  it. `Confirmed` marks a message whose claim others have confirmed, and `Ask` asks for that.

Time is outside: a *beat* numbers the owner's requests for leases. A permit lapses no later than its beat, a lease of a
member no earlier.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, Final, NamedTuple

from pancakes.durable.register import (
    ANYONE,
    BLANK,
    MORE_THAN_MIGRATIONS,
    NO_EPOCH,
    NOBODY,
    Epoch,
    Identity,
    Members,
    Register,
    Stamp,
    Wanted,
    is_quorum,
)

MOST_STEP: Final = 10 * MORE_THAN_MIGRATIONS
"""No task comes further at once, from the highest epoch that is known to another one: what claims so is ignored."""
NO_WRITE: Final = -1
"""The sequence number of a tombstone, which is lower than that of each write under its epoch."""


class Memory(NamedTuple):
    """What an agent knows of a task until its next crash.

    Attributes:
        permit: the newest beat for which a quorum granted the lease; 0: none. It lapses with that beat.
        offered: members were told of the heir, so they may have ended the lease.
        taking: the epoch for which promises are asked; `NO_EPOCH`: none.
        asked: the members that are asked.
        behind: a member has a later write: of our epoch, as our disk is an old copy, or of another owner.
        answers: for each member its newest beat, and the newest write that it has.
        promises: the promises that came.
    """

    permit: int = 0
    offered: bool = False
    taking: Epoch = NO_EPOCH
    asked: tuple[Members, ...] = ()
    behind: bool = False
    answers: tuple[tuple[Identity, int, int], ...] = ()
    promises: tuple[Promise, ...] = ()


class Lease(NamedTuple):
    """What a member has granted until its next crash. `beat` 0: no lease runs."""

    epoch: Epoch = NO_EPOCH
    beat: int = 0


class Place(NamedTuple):
    """Where an agent stands with a task.

    Attributes:
        me: the agent.
        register: its register, which is on disk.
        memory: what it knows until its next crash.
        lease: what it has granted.
        draw: the random number of an epoch that is minted now.
    """

    me: Identity
    register: Register = BLANK
    memory: Memory = Memory()
    lease: Lease = Lease()
    draw: int = 0

    @property
    def writes(self) -> bool:
        """Whether it may write: it owns the task, and has promised it to nobody."""
        return self.register.owner == self.me and self.register.promised <= self.register.epoch


# Messages ---------------------------------------------------------------------------------------------------------


class Accept(NamedTuple):
    """The owner's write, for its members, its heir, and the former owner.

    Attributes:
        register: the write.
        beat: the request for the lease that it goes with; 0: it asks for none.
        to: the heir that is told alone so far; `NOBODY`: all are told.
        whole: whether the receiver has the state that belongs to it.
    """

    register: Register
    beat: int
    to: Identity = NOBODY
    whole: bool = True


class Accepted(NamedTuple):
    """A member or heir has the owner's write `no` on disk, and grants the lease for `beat`."""

    epoch: Epoch
    by: Identity
    beat: int
    no: int


class Prepare(NamedTuple):
    """An agent asks for promises.

    Attributes:
        epoch: the epoch that it minted.
        held: the newest write that it has.
        sets: the members, as far as it knows.
    """

    epoch: Epoch
    held: Stamp
    sets: tuple[Members, ...]


class Promise(NamedTuple):
    """A member follows no epoch lower than this one any more, and holds this register."""

    epoch: Epoch
    by: Identity
    register: Register


class Known(NamedTuple):
    """What an agent knows of a task, without the state: an answer, a refusal, or news at a new link."""

    by: Identity
    register: Register


class Confirmed(NamedTuple):
    """A message whose claim was confirmed.

    An `Accept` for a member: other members that it knows have promised that epoch, as they said themselves. While the
    lease runs that it granted, they must be a quorum; else one is enough.
    A `Prepare`: a member says that it called the agent. Any other: another agent than the claimant says who owns the
    task.
    """

    message: Accept | Prepare | Known


# Other events -----------------------------------------------------------------------------------------------------


class Beat(NamedTuple):
    """It is time to ask for leases; the numbers rise."""

    beat: int


class Save(NamedTuple):
    """The task has a new state to be written, which has the effect of packets that are not acknowledged yet."""

    state: Any


class Want(NamedTuple):
    """A person or a task wants the task to run, to be stopped, or to be removed; or its service gave it up.

    Attributes:
        wanted: what is wanted.
        state: its state at the end, or with which it begins; None: that does not change.
    """

    wanted: Wanted
    state: Any = None


class SetMembers(NamedTuple):
    """The owner wants other members."""

    members: Members


class Offer(NamedTuple):
    """The heir keeps room for the task: it can be offered.

    Attributes:
        heir: the heir.
        state: the state of the task, which is paused for this; None: that does not change.
    """

    heir: Identity
    state: Any = None


class GiveUp(NamedTuple):
    """The migration takes too long, or was refused."""


class Goodbye(NamedTuple):
    """The agent of a guarded task ends."""


class Call(NamedTuple):
    """This agent made the lowest bid, and is to take the task.

    Attributes:
        floor: the highest epoch that the caller knows.
        sets: the members that the caller knows.
    """

    floor: Epoch
    sets: tuple[Members, ...]


class Begin(NamedTuple):
    """The task may begin here: all that had to be asked know nothing of it, or know that it was removed.

    Attributes:
        floor: the highest epoch that any of them knows.
        state: where it begins.
    """

    floor: Epoch
    state: Any


class Force(NamedTuple):
    """A person decides that the task lives here, from a state; `floor`: the highest epoch that anybody named."""

    floor: Epoch
    state: Any


class Leave(NamedTuple):
    """A person decides that the task does not live here, but with the owner that a register names."""

    register: Register


# Effects ----------------------------------------------------------------------------------------------------------


class Persist(NamedTuple):
    """The register is on disk before the next effect. If it cannot be written, no later effect happens."""

    register: Register


class Remember(NamedTuple):
    """The memory is this from now on."""

    memory: Memory


class Grant(NamedTuple):
    """The lease is this from now on; with a beat, it runs for its whole time again."""

    lease: Lease


class Send(NamedTuple):
    """A message goes to all that it concerns."""

    message: Accept | Accepted | Prepare | Promise | Known


class Counts(NamedTuple):
    """A write is on enough disks: its packets are acknowledged, and a stop or removal in it is answered."""

    register: Register


class Ask(NamedTuple):
    """The claim of a message must be confirmed; see `Confirmed`."""

    message: Accept | Prepare | Known


Effect = Persist | Remember | Grant | Send | Counts | Ask
Effects = list[Effect]


class Desired(Enum):
    """What the actor of a task is to do."""

    RUN = "run"
    PAUSE = "pause"
    END = "end"


def desired(me: Identity, register: Register, memory: Memory) -> Desired:
    """Return what the actor of the task is to do on this agent."""
    if register.owner != me or register.wanted is Wanted.REMOVED:
        return Desired.END
    if register.promised > register.epoch:
        return Desired.PAUSE  # given away, or outvoted; its state is kept until another agent owns it
    if register.heir != NOBODY or register.wanted is not Wanted.RUNNING:
        return Desired.PAUSE
    if memory.behind or memory.taking != NO_EPOCH:
        return Desired.PAUSE
    return Desired.RUN if register.clockless or memory.permit > 0 else Desired.PAUSE


def handle(place: Place, event: Any) -> Effects:
    """Return what an event means for a task on an agent."""
    return RULES[type(event)](place, event)


def recover(place: Place, all_beats: int) -> Effects:
    """Return what follows a restart.

    Args:
        place: where the agent stands; its memory is empty.
        all_beats: a beat that stands for all leases that it may have granted before.
    """
    register = place.register
    effects: Effects = []
    if place.writes and register.heir != NOBODY:
        # The offer is taken back. Members may know of it, so they may have ended their leases.
        effects += _write(place._replace(memory=Memory(offered=True)), heir=NOBODY)
    if place.me in register.members and not register.unguarded:
        effects.append(Grant(Lease(register.promised, all_beats)))
    return effects


def resend(place: Place) -> Effects:
    """Return what is said again from time to time, because it may have been lost."""
    register, memory = place.register, place.memory
    if place.writes and register.heir != NOBODY:
        return [Send(Accept(register.as_written(), 0, NOBODY if memory.offered else register.heir))]
    if register.owner == place.me and register.promised > register.epoch and register.unguarded:
        return [Send(Promise(register.promised, place.me, register))]
    if register.heir == place.me and register.state is not None:
        return _ask_for_promises(place, register, NO_EPOCH, register.sets)
    if memory.taking != NO_EPOCH:
        return [Send(Prepare(memory.taking, register.stamp, memory.asked))]
    return []


# The owner --------------------------------------------------------------------------------------------------------


def _write(place: Place, **changes: Any) -> Effects:
    """Return the owner's next write; that of an unguarded task counts at once."""
    register, memory = place.register, place.memory
    no = register.no + 1
    takes_back = memory.offered and changes.get("heir", register.heir) == NOBODY
    if takes_back:
        # Members may have ended their leases for the heir: only those that know of this write count again.
        changes["since"] = no
        memory = memory._replace(permit=0, offered=False)
    new = register._replace(no=no, **changes)
    return [Remember(memory), Persist(new), *([Counts(new)] if new.unguarded else [])]


def _beat(place: Place, event: Beat) -> Effects:
    """Rule 9: ask the members for leases. While only the heir knows of an offer, the members hear nothing."""
    register, memory = place.register, place.memory
    if not place.writes or register.unguarded or memory.behind:
        return []
    if register.heir != NOBODY and not memory.offered:
        return []
    effects: Effects = []
    if place.me in register.members:
        effects += [
            Grant(Lease(register.epoch, event.beat)),
            Send(Accepted(register.epoch, place.me, event.beat, register.no)),
        ]
    return [*effects, Send(Accept(register.as_written(), event.beat))]


def _accepted(place: Place, event: Accepted) -> Effects:
    """Rules 6 and 10: count what members have, and tell them of an heir that has its write."""
    register, memory = place.register, place.memory
    if not place.writes or event.epoch != register.epoch or register.unguarded:
        return []
    if event.by not in register.members and event.by != register.heir:
        return []
    if event.no > register.no:
        return [Remember(memory._replace(behind=True, permit=0))]
    if event.by == register.heir and event.no == register.no and not memory.offered:
        return [Remember(memory._replace(offered=True, permit=0)), Send(Accept(register.as_written(), 0))]
    best = {member: (beat, no) for member, beat, no in memory.answers}
    beat, no = best.get(event.by, (0, NO_WRITE))
    best[event.by] = max(beat, event.beat), max(no, event.no)
    answers = tuple((member, *best[member]) for member in sorted(best))
    memory = memory._replace(answers=answers)
    # A member with a write older than `since` may have ended its lease for an heir, or know other members.
    beats = {member: beat for member, beat, no in answers if no >= register.since}
    permit = 0 if memory.offered else max(memory.permit, _reached(register.sets, beats))
    effects: Effects = [Remember(memory._replace(permit=permit))]
    written = _reached(register.sets, {member: no for member, _, no in answers})
    if written >= register.no:
        effects.append(Counts(register))
    if len(register.sets) == 2 and written >= register.since:
        # A quorum of both sets knows of the new members: from the next write on they are the only ones.
        no = register.no + 1
        effects.append(Persist(register._replace(no=no, since=no, sets=register.sets[1:])))
    return effects


def _reached(sets: tuple[Members, ...], values: Mapping[Identity, int]) -> int:
    """Return the highest number that a quorum has reached; `NO_WRITE` if there is none."""
    for value in sorted(set(values.values()), reverse=True):
        if is_quorum(sets, {member for member, own in values.items() if own >= value}):
            return value
    return NO_WRITE


def _save(place: Place, event: Save) -> Effects:
    """Rule 1."""
    if desired(place.me, place.register, place.memory) is not Desired.RUN:
        return []
    return _write(place, state=event.state)


def _want(place: Place, event: Want) -> Effects:
    """Rules 2 and 3. A stop while the task is offered takes the offer back: it is a later write."""
    register = place.register
    if not place.writes or register.wanted is Wanted.REMOVED:
        return []
    if register.wanted is Wanted.DISPUTED:
        # It stays paused. What its actor carried at its end is kept all the same.
        return _write(place, state=event.state) if event.state is not None else []
    if event.wanted is not Wanted.REMOVED:
        state = event.state if event.state is not None else register.state
        return _write(place, wanted=event.wanted, heir=NOBODY, state=state)
    if register.wanted is Wanted.RUNNING or register.heir != NOBODY:
        return []  # it must be stopped first
    return _write(place, wanted=Wanted.REMOVED, state=None)


def _set_members(place: Place, event: SetMembers) -> Effects:
    """Rule 4: write both sets; `_accepted` drops the old one once a quorum of both knows."""
    register = place.register
    if not place.writes or len(register.sets) != 1 or register.heir != NOBODY or register.wanted is Wanted.REMOVED:
        return []
    if register.sets == (event.members,) or place.me not in event.members:
        return []  # an owner outside would be let go of by the news of a taker, while the old members still need it
    no = register.no + 1
    return [Persist(register._replace(no=no, since=no, sets=(register.sets[0], event.members)))]


def _offer(place: Place, event: Offer) -> Effects:
    """Rule 5: offer the task. It is paused from here on, until a later write takes the offer back."""
    register, memory = place.register, place.memory
    if desired(place.me, register, memory) is not Desired.RUN or event.heir == place.me or len(register.sets) != 1:
        return []
    state = event.state if event.state is not None else register.state
    new = register._replace(no=register.no + 1, heir=event.heir, state=state)
    if register.unguarded or event.heir in register.members:
        # An heir that is a member ends its lease as soon as it hears of the offer, so all may hear of it.
        memory = memory._replace(offered=True, permit=0)
    to = NOBODY if memory.offered else event.heir
    return [Remember(memory), Persist(new), Send(Accept(new.as_written(), 0, to))]


def _goodbye(place: Place, event: Goodbye) -> Effects:
    """Rule 8: offer the task to anyone, so that who is called need not wait for the lease."""
    register = place.register
    if not place.writes or register.unguarded or register.heir != NOBODY or register.wanted is not Wanted.RUNNING:
        return []
    new = register._replace(no=register.no + 1, heir=ANYONE)
    memory = place.memory._replace(offered=True, permit=0)
    return [Remember(memory), Persist(new), Send(Accept(new.as_written(), 0))]


def _give_up(place: Place, event: GiveUp) -> Effects:
    """Rule 7: take the offer back."""
    return _write(place, heir=NOBODY) if place.writes and place.register.heir != NOBODY else []


# A member or an heir ----------------------------------------------------------------------------------------------


def _accept(place: Place, event: Accept, confirmed: bool = False) -> Effects:
    """Rule 11: follow the owner's write, and grant the lease that it asks for."""
    me, register, lease = place.me, place.register, place.lease
    new, beat = event.register, event.beat
    if event.to not in (NOBODY, me) or new.owner == me or _is_out_of_reach(place, new.epoch):
        return []
    is_member, is_heir = me in new.members, new.heir == me
    if not (is_member or is_heir):
        return _news(place, event, new.owner, new, confirmed)
    if new.epoch < register.promised:
        return [Send(Known(me, register.summary()))]
    is_by_person = new.epoch.n - register.epoch.n >= MORE_THAN_MIGRATIONS // 2
    if place.writes and new.epoch > register.epoch and (register.unguarded or is_by_person):
        return _news(place, event, new.owner, new, confirmed)  # no migration led to this: two owners
    # With its lease over, a member would promise the task to another member as well.
    # So would an owner that may not act: its own lease keeps nobody else out.
    no_lease = not lease.beat or (register.owner == me and not place.memory.permit)
    is_free = me in register.members and not register.unguarded and no_lease and new.owner in register.members
    if new.epoch > register.promised and not (confirmed or is_free):
        return [Ask(event)]  # the word of one agent is not enough
    if not event.whole and new.stamp > register.stamp:
        # Its state is still on its way: the lease is granted, the write is not accepted yet.
        no = register.no if register.epoch == new.epoch else NO_WRITE
        if not is_member or not beat:
            return []
        return [Grant(_renewed(lease, new.epoch, beat)), Send(Accepted(new.epoch, me, beat, no))]
    effects: Effects = []
    held = register
    if new.stamp > register.stamp:
        held = new._replace(promised=new.epoch)
        effects = [Persist(held), Remember(Memory())]
    elif new.epoch > register.promised:
        held = register._replace(promised=new.epoch)
        effects = [Persist(held)]
    if is_member and beat and not new.unguarded:
        effects.append(Grant(_renewed(lease, new.epoch, beat)))
    elif is_member and held.heir == ANYONE and lease.beat:
        effects.append(Grant(Lease()))  # its owner has said goodbye: it keeps nobody out any more
    effects.append(Send(Accepted(new.epoch, me, beat, held.no if held.epoch == new.epoch else NO_WRITE)))
    if is_heir and held.heir == me:
        effects += _ask_for_promises(place, held, NO_EPOCH, held.sets)
    return effects


def _renewed(lease: Lease, epoch: Epoch, beat: int) -> Lease:
    return Lease(epoch, max(beat, lease.beat) if lease.epoch == epoch else beat)


def _ask_for_promises(place: Place, register: Register, floor: Epoch, sets: tuple[Members, ...]) -> Effects:
    """Mint an epoch and ask for it. Nothing is written: nothing is proposed under it yet."""
    n = max(register.epoch.n, register.promised.n, floor.n)
    promised, taking = register.promised, place.memory.taking
    if taking.n > n:
        epoch = taking  # never a lower one again: a member may have promised this one
    elif promised.minter == place.me and promised > register.epoch and promised.n == n:
        epoch = promised
    else:
        # After a crash the heir asks under the same epoch, so its owner has promised no other one of its epochs.
        epoch = Epoch(n + 1, place.me, register.no if register.heir == place.me else place.draw)
    promises = place.memory.promises if epoch == taking else ()
    return [Remember(Memory(taking=epoch, asked=sets, promises=promises)), Send(Prepare(epoch, register.stamp, sets))]


def _prepare(place: Place, event: Prepare, confirmed: bool = False) -> Effects:
    """Rule 12: promise the task, unless a lease runs that this member has granted.

    It promises it to a member, to the heir, or to an agent that a member says to have called.
    """
    me, register, memory = place.me, place.register, place.memory
    if not any(me in one for one in event.sets) and me not in register.members:
        return [Send(Known(me, register.summary()))] if register != BLANK else []
    if event.epoch == register.promised and register.epoch < event.epoch:
        return [Send(Promise(event.epoch, me, register))]  # as it has said before
    taker = event.epoch.minter
    has_offer = event.held[0] == register.epoch and event.held >= register.stamp
    is_heir = register.heir == ANYONE or (register.heir == taker and has_offer)
    is_owner = not register.unguarded and register.owner == taker  # its own lease is in nobody's way
    needs_no_lease = register.owner == me and register.clockless
    is_free = is_heir or is_owner or (not needs_no_lease and not place.lease.beat)
    if event.epoch <= register.promised or not is_free or _is_out_of_reach(place, event.epoch):
        return [Send(Known(me, register.summary()))]
    if not (confirmed or is_heir or taker in register.members or register.state is None):
        return [Ask(event)]
    new = register._replace(promised=event.epoch)
    effects: Effects = [Persist(new), Grant(Lease())]
    if register.owner == me:
        effects.append(Remember(memory._replace(permit=0)))
    return [*effects, Send(Promise(event.epoch, me, new))]


# Who takes the task -----------------------------------------------------------------------------------------------


def _call(place: Place, event: Call) -> Effects:
    """Rule 13: mint an epoch above all known, and ask for promises."""
    me, register, memory = place.me, place.register, place.memory
    if desired(me, register, memory) is Desired.RUN or register.wanted is Wanted.REMOVED:
        return []
    if place.writes and register.heir != NOBODY:
        return []
    if register.owner == me and (register.unguarded or register.wanted is Wanted.DISPUTED):
        return []
    is_offered = register.heir == me and register.unguarded
    sets = register.sets if register.sets and not is_offered else event.sets
    return _ask_for_promises(place, register, event.floor, sets)


def _promise(place: Place, event: Promise) -> Effects:
    """Rule 14: with the promises of a quorum, own the task from the newest register among them."""
    me, register, memory = place.me, place.register, place.memory
    if event.epoch.minter == me and register.epoch >= event.epoch:
        return [Send(Known(me, register.summary()))]
    if memory.taking != event.epoch or register.promised > memory.taking:
        return []
    if not any(event.by in one for one in memory.asked):
        return []  # it was not asked
    promises = (*(it for it in memory.promises if it.by != event.by), event)
    memory = memory._replace(promises=promises)
    newest = max((it.register for it in promises), key=lambda it: (it.stamp, it.state is not None))
    if register.stamp >= newest.stamp and register.state is not None:
        newest = register
    # One member may lie about the others, so a member needs a quorum of those too that it knows itself.
    known = register.sets if me in register.members else ()
    needed = tuple(dict.fromkeys((*newest.sets, *known)))
    if not is_quorum(needed, {it.by for it in promises}):
        if needed == memory.asked:
            return [Remember(memory)]
        memory = memory._replace(asked=needed)  # members that this agent did not know
        return [Remember(memory), Send(Prepare(memory.taking, register.stamp, needed))]
    if newest.state is None or newest.wanted is Wanted.REMOVED:
        return [Remember(Memory())]  # there is nothing to take
    sets = ((me,),) if newest.unguarded else newest.sets
    own = Register(memory.taking, 0, sets, 0, NOBODY, newest.wanted, newest.state, memory.taking)
    return [Persist(own), Remember(Memory()), Send(Accept(own.as_written(), 0))]


# What others know -------------------------------------------------------------------------------------------------


def _known(place: Place, event: Known, confirmed: bool = False) -> Effects:
    """Rules 15 to 19."""
    me, register, memory, new = place.me, place.register, place.memory, event.register
    if event.by == me or _is_out_of_reach(place, max(new.epoch, new.promised)):
        return []
    if news := _news(place, event, event.by, new, confirmed):
        return news
    asks: Effects = []
    if _was_replaced(place, new):
        if confirmed:
            return _tombstone(register, new)
        asks = [Ask(event)]
    is_passed = event.by in register.members and new.promised > max(register.epoch, memory.taking)
    is_heir = register.heir == me and register.state is not None
    if is_passed and is_heir and not register.unguarded and new.promised.minter == me:
        # Before it crashed, it asked under an epoch that it does not know any more.
        return _ask_for_promises(place, register, new.promised, register.sets)
    waits = register.unguarded or register.heir != NOBODY or memory.permit > 0
    if not is_passed or not place.writes or waits:
        return asks
    if new.epoch > register.epoch and not register.clockless:
        # The members have decided. It asks for no more leases: those that run under its epoch keep others out.
        return [Remember(memory._replace(behind=True)), *asks]
    # A member has promised a later epoch, and nobody owns the task under it: the owner asks for a later one itself.
    return _ask_for_promises(place, register, new.promised, register.sets)


def _was_replaced(place: Place, new: Register) -> bool:
    """Return whether others took the task over from this owner, which is no member any more.

    It lets go once a quorum of its former members has promised that, and a quorum of the present ones knows them: a
    taker that knows only the former ones still needs its promise, above all if the new owner is lost.
    """
    me, register = place.me, place.register
    if register.owner != me or me not in register.members or register.unguarded or place.memory.permit > 0:
        return False
    if register.wanted is Wanted.DISPUTED or me in new.members or not new.sets or new.unguarded:
        return False
    return 0 < new.epoch.n - register.epoch.n < MORE_THAN_MIGRATIONS // 2


def _news(place: Place, message: Accept | Known, by: Identity, new: Register, confirmed: bool) -> Effects:
    """Return what follows if an agent has a register of this stamp: it matters only to an owner and to an heir."""
    me, register, memory = place.me, place.register, place.memory
    if new.owner == me or new == BLANK:
        return []
    is_by_person = new.epoch.n - register.epoch.n >= MORE_THAN_MIGRATIONS // 2
    if me in register.members and not register.unguarded and not (is_by_person and register.owner == me):
        return []  # what a member holds may be the newest that a quorum has: only an Accept changes it
    if register.owner == me and register.promised > register.epoch:
        if new.epoch < register.promised:
            return []
        # Once the agent that got the task owns it, or gave it away in turn, nothing is left to keep.
        return _tombstone(register, new) if confirmed or by == register.promised.minter else [Ask(message)]
    if register.owner == me:
        if new.epoch <= register.epoch or register.wanted is Wanted.DISPUTED:
            return []
        if not register.unguarded and not is_by_person and memory.permit:
            return []
        if register.wanted is Wanted.REMOVED:
            return _tombstone(register, new)
        if not confirmed:
            return [Ask(message)]
        if not register.unguarded and not is_by_person:
            return _tombstone(register, new)  # the members have decided
        # No migration makes two owners: it is paused, with its state, until a person decides.
        paused = register._replace(no=register.no + 1, heir=NOBODY, wanted=Wanted.DISPUTED)
        return [Remember(memory._replace(permit=0)), Persist(paused)]
    if register.heir == me and register.state is not None and new.stamp > register.stamp:
        if not confirmed and by != register.owner:
            return [Ask(message)]
        # The offer is dead: its owner has written since, or another agent owns the task.
        if new.epoch > register.epoch:
            return _tombstone(register, new)
        return [Persist(register._replace(heir=NOBODY, state=None)), Remember(Memory())]
    return []


def _tombstone(register: Register, new: Register) -> Effects:
    # It has no write of that epoch: a later offer of the new owner is news, whatever its number.
    promised = max(register.promised, new.epoch)
    gone = new._replace(no=NO_WRITE, since=0, heir=NOBODY, state=None, promised=promised)
    return [Persist(gone), Remember(Memory())]


def _confirmed(place: Place, event: Confirmed) -> Effects:
    message = event.message
    if isinstance(message, Accept):
        return _accept(place, message, confirmed=True)
    if isinstance(message, Prepare):
        return _prepare(place, message, confirmed=True)
    return _known(place, message, confirmed=True)


def _is_out_of_reach(place: Place, epoch: Epoch) -> bool:
    known = max(place.register.epoch.n, place.register.promised.n)
    return epoch.n > max(known, 0) + MOST_STEP


# Births, and a person's word --------------------------------------------------------------------------------------


def _begin(place: Place, event: Begin) -> Effects:
    """Rule 21: begin, above all epochs that anybody knows."""
    register = place.register
    if register.state is not None and place.me in (register.owner, register.heir):
        return []
    n = max(event.floor.n, register.epoch.n, register.promised.n)
    on_copy = register.owner.agent == place.me.agent and register.owner != place.me
    if on_copy and Epoch(n, place.me, place.draw) > max(event.floor, register.epoch, register.promised):
        return _own_alone(place, n, event.state)  # each owner since the copy was made is above it
    return _own_alone(place, n + 1, event.state)


def _force(place: Place, event: Force) -> Effects:
    """Rule 22: a person decides that the task lives here."""
    register = place.register
    n = max(event.floor.n, register.epoch.n, register.promised.n) + MORE_THAN_MIGRATIONS
    return _own_alone(place, n, event.state)


def _own_alone(place: Place, n: int, state: Any) -> Effects:
    epoch = Epoch(n, place.me, place.draw)
    own = Register(epoch, 0, ((place.me,),), state=state, promised=epoch)
    return [Persist(own), Remember(Memory())]


def _leave(place: Place, event: Leave) -> Effects:
    """Rule 23: a person decides that it lives elsewhere."""
    if desired(place.me, place.register, place.memory) is Desired.RUN:
        return []
    return _tombstone(place.register, event.register)


RULES: Final[Mapping[type, Callable[[Place, Any], Effects]]] = {
    Beat: _beat,
    Save: _save,
    Want: _want,
    SetMembers: _set_members,
    Offer: _offer,
    GiveUp: _give_up,
    Goodbye: _goodbye,
    Accepted: _accepted,
    Accept: _accept,
    Prepare: _prepare,
    Call: _call,
    Promise: _promise,
    Known: _known,
    Confirmed: _confirmed,
    Begin: _begin,
    Force: _force,
    Leave: _leave,
}
"""The rule of each event."""
