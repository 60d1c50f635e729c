"""The register of a durable task: all that one agent knows of it, in one small record. Pure.

Each agent that knows a task has one `Register` for it on disk. Only the owner writes it. Whatever the owner decides (a
checkpoint, a stop, other members, an offer of the task to another agent) is its next write. A write counts once a
quorum of the members has it. An unguarded task is the case that its owner is the only member: then its own disk is
the quorum, no lease is needed, and no clock is read.

`pancakes.durable.rules` has the rules by which a register changes.
"""

from __future__ import annotations

from collections.abc import Collection
from enum import Enum
from functools import lru_cache
from typing import Annotated, Any, Final, NamedTuple

import msgspec

from pancakes.util.text import NAME

AgentName = Annotated[str, msgspec.Meta(pattern=rf"\A(?:{NAME}|\*)?\Z", max_length=64)]
_Id = Annotated[str, msgspec.Meta(max_length=64)]


class Identity(NamedTuple):
    """An agent as an owner, member or heir of a task.

    An agent whose disk was lost, or is a copy, has forgotten what it promised. So it has another identity, and is no
    owner, member or heir of what its former self was.

    Attributes:
        agent: the name of the agent.
        journal: the id of its journal.
        copy: which copy of that journal it has; empty: the original.
    """

    agent: AgentName
    journal: _Id = ""
    copy: _Id = ""

    def __str__(self) -> str:
        return self.agent


NOBODY: Final = Identity("")
ANYONE: Final = Identity("*")
"""The heir named by an owner that says goodbye: the agent that is called need not wait for its lease."""


class Epoch(NamedTuple):
    """The right to write a register and to run its task; the fencing token of commands to actuators.

    Epochs are ordered as tuples. An agent owns a task under the epochs that it minted, so no two agents own it under
    the same epoch.

    Attributes:
        n: the number; 0 at the birth of the task.
        minter: the agent that minted it: the owner.
        draw: a random number. Two living copies of one agent have one identity, and still mint different epochs.
    """

    n: Annotated[int, msgspec.Meta(ge=-1, le=2**53)]
    minter: Identity
    draw: Annotated[int, msgspec.Meta(ge=0, lt=2**53)] = 0

    def __str__(self) -> str:
        return f"{self.n}@{self.minter}" if self.minter != NOBODY else "none"


NO_EPOCH: Final = Epoch(-1, NOBODY)
"""Lower than every epoch that was minted."""
MORE_THAN_MIGRATIONS: Final = 1_000_000
"""How much a person's decision raises the number of an epoch: more than migrations and take-overs can."""

MOST_MEMBERS: Final = 5
"""A task has at most this many members: more are slower, and survive nothing that is likely."""

Members = Annotated[tuple[Identity, ...], msgspec.Meta(min_length=1, max_length=MOST_MEMBERS)]
Sets = Annotated[tuple[Members, ...], msgspec.Meta(max_length=2)]
Number = Annotated[int, msgspec.Meta(ge=-1, le=2**53)]
Stamp = tuple[Epoch, int]
"""Orders all writes of one register."""


class Wanted(Enum):
    """What people and tasks want of a task; it outlives a reboot and a take-over."""

    RUNNING = "running"
    STOPPED = "stopped"
    FAILED = "failed"
    """Its service gave it up."""
    REMOVED = "removed"
    DISPUTED = "disputed"
    """Another agent owns it too: it is paused until a person decides which copy lives."""


class Register(NamedTuple):
    """What an agent has on disk for one task. Never deleted.

    Attributes:
        epoch: who wrote it: the minter of the epoch is the owner of the task.
        no: the sequence number of the write under that epoch.
        sets: one set of members; two while the second takes over from the first.
        since: the write at which the members changed last, or an offer was taken back that members knew of. Members
            with an older write do not count for the lease.
        heir: the agent to which the owner offers the task; `NOBODY`: none.
        wanted: what is wanted of the task.
        state: the newest checkpoint; None: this agent has none (a tombstone, or a summary).
        promised: the agent follows no lower epoch. It is this agent's own, and not part of what its owner wrote.
    """

    epoch: Epoch = NO_EPOCH
    no: Number = 0
    sets: Sets = ()
    since: Number = 0
    heir: Identity = NOBODY
    wanted: Wanted = Wanted.RUNNING
    state: Any = None
    promised: Epoch = NO_EPOCH

    @property
    def stamp(self) -> Stamp:
        """Orders the writes of one task."""
        return self.epoch, self.no

    @property
    def owner(self) -> Identity:
        """The agent that wrote it."""
        return self.epoch.minter

    @property
    def unguarded(self) -> bool:
        """Whether its owner is its only member."""
        return self.sets == ((self.owner,),)

    @property
    def clockless(self) -> bool:
        """Whether nobody can take the task without its owner: each quorum has it. Then no lease is needed.

        So it is while others become members of a task that was unguarded. It is not yet so while its guard is given up:
        the members may not know of that.
        """
        return self.sets[:1] == ((self.owner,),)

    @property
    def members(self) -> frozenset[Identity]:
        """All members, of one set or of both."""
        return _members_of(self.sets)

    def as_written(self) -> Register:
        """Return it as its owner wrote it, without what is only this agent's."""
        return self._replace(promised=NO_EPOCH)

    def summary(self) -> Register:
        """Return it without its state."""
        return self._replace(state=None)


def members_in(sets: Sets) -> list[Identity]:
    """Return all members, each once, in the order in which they were chosen."""
    return list(dict.fromkeys(member for one in sets for member in one))


@lru_cache(maxsize=1024)
def _members_of(sets: tuple[Members, ...]) -> frozenset[Identity]:
    return frozenset(member for one in sets for member in one)


BLANK: Final = Register()
"""The register of a task that an agent has never heard of."""


def is_quorum(sets: tuple[Members, ...], who: Collection[Identity]) -> bool:
    """Return whether agents are more than half of each set."""
    return bool(sets) and all(2 * sum(member in who for member in one) > len(one) for one in sets)


class Standing(Enum):
    """Where an agent stands with a task: a view of its register."""

    NONE = "none"
    OWNER = "owner"
    OFFERED = "offered"
    """The owner has paused it, and offers it to an heir. Any later write takes the offer back."""
    YIELDED = "yielded"
    """The owner has promised it to another agent, and keeps its state until that agent owns it."""
    DISPUTED = "disputed"
    HEIR = "heir"
    """The task was offered to this agent, which asks the members for it."""
    MEMBER = "member"
    RELEASED = "released"
    """A tombstone: the task is elsewhere, or was removed."""


def standing_of(me: Identity, register: Register) -> Standing:
    """Return where an agent stands with a task."""
    if register.epoch == NO_EPOCH:
        return Standing.NONE
    if register.owner == me:
        if register.promised > register.epoch:
            return Standing.YIELDED
        if register.wanted is Wanted.DISPUTED:
            return Standing.DISPUTED
        if register.wanted is Wanted.REMOVED:
            return Standing.RELEASED
        return Standing.OFFERED if register.heir != NOBODY else Standing.OWNER
    if register.heir == me and register.state is not None:
        return Standing.HEIR
    return Standing.MEMBER if me in register.members else Standing.RELEASED
