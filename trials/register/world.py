"""The worlds of a search: agents, messages, and what came of an event."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from pancakes.durable.register import (
    MORE_THAN_MIGRATIONS,
    NOBODY,
    Epoch,
    Identity,
    Register,
    Standing,
    Wanted,
    is_quorum,
)
from pancakes.durable.rules import (
    Accept,
    Beat,
    Confirmed,
    Known,
    Lease,
    Memory,
    Prepare,
)

KINDS: Final = (
    *("moves", "stops", "starts", "removes", "begins", "swaps"),
    *("wipes", "backups", "restores", "forces", "goodbyes"),
)
"""The rare events, each of which may happen as often as a scenario says."""
BACKUPS, RESTORES = KINDS.index("backups"), KINDS.index("restores")
DRAWS: Final = (1, 2, 0)
"""What an agent draws for its epochs: the next may be higher than the last, or lower."""
ROUNDS: Final = 15
"""How many rounds a healing may take."""
MAY_HAVE_IT: Final = (Standing.OWNER, Standing.OFFERED, Standing.YIELDED, Standing.DISPUTED, Standing.HEIR)
"""An agent that stands so with a task has its state, and may act, or may have given it to one that does."""
RUN, STOPPED, REMOVED, DISPUTED = Wanted.RUNNING, Wanted.STOPPED, Wanted.REMOVED, Wanted.DISPUTED


class State(NamedTuple):
    """The state of the task: how many packets have had an effect, and the filter against doubles."""

    effects: int = 0
    upto: int = 0


JUNK: Final = State(99, 99)
"""The state that a liar makes up."""


class Letter(NamedTuple):
    """A packet to the task, the how-manieth of the only sender."""

    seq: int


class Local(NamedTuple):
    """One agent.

    Attributes:
        draws: how many of `DRAWS` it has used: it draws anew once it has forgotten what it asked for.
    """

    me: Identity
    register: Register
    memory: Memory
    lease: Lease
    draws: int = 0

    @property
    def draw(self) -> int:
        """The random number of an epoch that it mints now."""
        return DRAWS[min(self.draws, len(DRAWS) - 1)]

    def restarted(self) -> Local:
        """Return it as it is after a crash."""
        return Local(self.me, self.register, Memory(), Lease(), self.redrawn())

    def redrawn(self) -> int:
        """Return its `draws` once it forgets what it asks for now."""
        taking = self.memory.taking
        is_used = taking.minter == self.me and taking.draw == self.draw
        return min(self.draws + is_used, len(DRAWS) - 1)


class World(NamedTuple):
    """One state of the search.

    Attributes:
        locals: the agents, as numbers in a pool.
        net: the messages, as bits.
        top: how many beats have not lapsed.
        acked: the last packet that was acknowledged.
        reign: the highest epoch that has acted.
        stopped: whether a stop was answered that no start has followed.
        removed: the highest epoch whose removal was answered.
        started: the epoch under which a start was asked for last.
        excused: whether two may act until all are linked.
        lost: whether a disk was lost.
        left: how often each of `KINDS` may still happen.
        saved: the register on the copy of a disk.
    """

    locals: tuple[int, ...]
    net: int
    top: int
    acked: int
    reign: Epoch
    stopped: bool
    removed: Epoch
    started: Epoch
    excused: bool
    lost: bool
    left: tuple[int, ...]
    saved: Register | None


class Outcome(NamedTuple):
    """What came of an event at an agent.

    Attributes:
        local: the agent afterwards.
        sent: the messages that it sent, as bits.
        acked: the last packet that it acknowledged.
        told: the write whose stop or removal was answered.
        cuts: the same, if the agent crashed after some of the effects.
        fails: the same, if a write among the effects failed, and the agent went on.
        asks: whether it asked that a claim be confirmed.
    """

    local: int
    sent: int
    acked: int
    told: Register | None
    cuts: tuple[Outcome, ...] = ()
    fails: tuple[Outcome, ...] = ()
    asks: bool = False


class Violation(Exception):
    """A promise is broken."""


@dataclass(frozen=True)
class Result:
    """What a search found.

    Attributes:
        verdict: `ok`; `unfinished`; or the promise that is broken.
        states, transitions, configurations, healings: how much was searched.
        waits: why nobody acted after a healing, and how often.
        seconds: how long it took.
        trace: a shortest way to the violation, in sentences.
    """

    verdict: str
    states: int
    transitions: int
    configurations: int
    healings: int
    waits: dict[str, int]
    seconds: float
    trace: tuple[str, ...] = ()


def is_vouched(
    me: Identity, register: Register, lease: Lease, message: Any, registers: Mapping[Identity, Register]
) -> bool:
    """Return whether others confirm the claim of an honest agent; `registers`: what each agent has."""
    new = message.register
    is_by_person = new.epoch.n - register.epoch.n >= MORE_THAN_MIGRATIONS // 2
    is_owner = register.owner == me in register.members and not register.unguarded
    if type(message) is Known and is_owner and not is_by_person:
        # It lets go once its former members and the present ones need it no more.
        passed = {it for it, has in registers.items() if max(has.epoch, has.promised) >= new.epoch} - {me}
        without = {it for it, has in registers.items() if has.epoch >= new.epoch and me not in has.members}
        return is_quorum(register.sets, passed) and is_quorum(new.sets, without)
    promised = {it for it, has in registers.items() if has.promised == new.epoch}
    is_for_member = type(message) is Accept and me in message.register.members
    if not is_for_member or me not in register.members or register.unguarded:
        return True
    if lease.beat:
        return is_quorum(register.sets, promised)
    return bool(promised & register.members - {me})


def shown(what: Any) -> str:
    """Return an event as a sentence without its subject."""
    if isinstance(what, str):
        return what
    kind = type(what)
    if kind is tuple:
        return f"has {type(what[0]).__name__} {what[0].epoch} of {', '.join(str(it.by) for it in what)}"
    if kind is Accept:
        it = what.register
        members = "+".join("".join(map(str, one)) for one in it.sets)
        heir = f", heir {it.heir}" if it.heir != NOBODY else ""
        late = "" if what.whole else ", without its state,"
        return f"gets Accept{late} {it.epoch}/{it.no}, beat {what.beat}, members {members}{heir}, {it.wanted.value}"
    if kind is Prepare:
        return f"gets Prepare {what.epoch}, held {what.held[0]}/{what.held[1]}"
    if kind is Known:
        return f"hears from {what.by} of {what.register.epoch}/{what.register.no}"
    if kind is Confirmed:
        return f"has it confirmed, and {shown(what.message)}"
    if kind is Beat:
        return f"asks for leases (beat {what.beat})"
    return f"{kind.__name__} {', '.join(map(str, what))}".strip()
