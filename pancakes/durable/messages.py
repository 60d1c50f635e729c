"""The packets by which agents decide which of them has a durable task. Pure.

Each is the body of a packet on `network`. `Solicit`, `Bid` and `Refuse` go between the Task Migrators of two agents,
all others between their registrars. The network may lose, double, reorder and delay all of them. The rules that they
feed are in `rules`, whose messages they carry.

`journal` is the id of the receiver's journal, as far as the sender knows it. An agent that lost its disk has a new
journal, so it ignores what was meant for its former self. `addressed` fills the field in on the way out, and `is_for`
checks it on the way in.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Annotated, Final, TypeVar

import msgspec
from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.durable.record import TaskId
from pancakes.durable.register import NOBODY, Epoch, Identity, Number, Register, Sets, Stamp
from pancakes.migration import CostChoice
from pancakes.packet import packet_type

REGISTRAR: Final = "kernel/Registrar"
"""Where on each agent the registrar is."""
MOST_ASKED: Final = 256
"""At most this many tasks are named in one packet."""
SHORTEST_LEASE_S: Final = 0.5
LONGEST_LEASE_S: Final = 3600.0
MOST_AGE_S: Final = 1e9
LeaseSeconds = Annotated[float, msgspec.Meta(ge=SHORTEST_LEASE_S, le=LONGEST_LEASE_S)]
AgeSeconds = Annotated[float, msgspec.Meta(ge=0.0, le=MOST_AGE_S)]
_Name = Annotated[str, msgspec.Meta(max_length=256)]

# Bids ---------------------------------------------------------------------------------------------------------------


@packet_type("migration.solicit")
class Solicit(msgspec.Struct, frozen=True):
    """Asks a neighbour whether it would take a task, and at what cost.

    Attributes:
        task_id: the task.
        ask: number of this asking at the source; the answer repeats it.
        type: entry point name of the task's class.
        version: version of the distribution that it comes from.
        service: name of the service that looks after it, here and there.
        requires: the device types that it depends on.
        cost: name of the cost function to use, or the weight of each of several.
        moves_on_below: battery level below which the task would have to move on at once; None: it has no such rule.
        offer: what bidders are told of the task (`Snapshot.offer`), if the cost function is none of the core's.
        hold: whether the neighbour made the lowest bid: it keeps room for the task, and its actuators, for some
            seconds.
        journal: see the module's text.
        least_reserve_s: reserve below which the task would have to move on at once, in seconds; None: it has no such
            rule.
    """

    task_id: TaskId
    ask: int
    type: str
    version: str
    service: str
    requires: tuple[str, ...] = ()
    cost: CostChoice = "tasks"
    moves_on_below: float | None = None
    offer: bytes = b""
    hold: bool = False
    journal: str = ""
    least_reserve_s: float | None = None


@packet_type("migration.bid")
class Bid(msgspec.Struct, frozen=True):
    """Offers to take a task.

    Attributes:
        cost: what it would cost; the cheapest wins.
        terms: what the cost is made of.
        holds: whether room is kept for the task.
        by: then, the agent with its disk.
    """

    task_id: TaskId
    ask: int
    cost: float
    terms: dict[str, float]
    holds: bool = False
    by: Identity = NOBODY
    journal: str = ""


@packet_type("migration.refuse")
class Refuse(msgspec.Struct, frozen=True):
    """Declines to take a task, and says why. To a registrar: the heir declines what it was offered.

    Attributes:
        ask: the number of the asking, or of the write that offers the task.
    """

    task_id: TaskId
    ask: int
    refusal: Refusal
    journal: str = ""


# The rules of a register --------------------------------------------------------------------------------------------


@packet_type("task.accept")
class Accept(msgspec.Struct, frozen=True):
    """The owner's write, for its members, its heir and the former owner; see `rules.Accept`.

    Attributes:
        task_id: the task.
        type: entry point name of its class.
        service: the service that looks after it.
        register: the write, without its state.
        beat: the request for a lease that goes with it; 0: none.
        lease_s: how long a lease is, in host seconds, from the arrival of this.
        to: the heir that is told alone so far.
        state: the state, encoded; None: the receiver has it, as far as the sender knows, or it comes in pieces.
        age_s: how long ago the owner knew that the task is as its state says, in host seconds.
    """

    task_id: TaskId
    type: _Name
    service: _Name
    register: Register
    beat: int = 0
    lease_s: LeaseSeconds = SHORTEST_LEASE_S
    to: Identity = NOBODY
    state: bytes | None = None
    age_s: AgeSeconds = 0.0
    journal: str = ""


@packet_type("task.piece")
class Piece(msgspec.Struct, frozen=True):
    """A part of a large state on its way (see `snapshot.Assembly`).

    Attributes:
        stamp: which write the state is of.
        index: which part it is, from 0.
        count: how many there are.
        size_bytes: length of the whole.
        digest: SHA-256 of the whole.
        data: the part's bytes.
    """

    task_id: TaskId
    stamp: Stamp
    index: int
    count: int
    size_bytes: int
    digest: bytes
    data: bytes
    journal: str = ""


@packet_type("task.accepted")
class Accepted(msgspec.Struct, frozen=True):
    """A member or heir has the owner's write `no` on disk, and grants the lease for `beat`.

    Attributes:
        by: the member.
        told: the newest write of that epoch that it was told of, also if it has no room for it; -1: none.
    """

    task_id: TaskId
    epoch: Epoch
    by: Identity
    beat: int
    no: Number
    told: Number = -1
    journal: str = ""


@packet_type("task.prepare")
class Prepare(msgspec.Struct, frozen=True):
    """An agent asks members for their promises; see `rules.Prepare`."""

    task_id: TaskId
    type: _Name
    epoch: Epoch
    held: Stamp
    sets: Sets
    journal: str = ""


@packet_type("task.promise")
class Promise(msgspec.Struct, frozen=True):
    """A member follows no epoch lower than this one any more.

    Attributes:
        register: what it holds, without the state.
        state: the state; None: it has none, or it comes in pieces.
        pieces: whether the state comes in pieces.
    """

    task_id: TaskId
    epoch: Epoch
    by: Identity
    register: Register
    state: bytes | None = None
    pieces: bool = False
    journal: str = ""


# What others know ---------------------------------------------------------------------------------------------------


class Fact(msgspec.Struct, frozen=True):
    """What an agent knows of a task.

    Attributes:
        task_id: the task.
        register: its register, without the state.
        lease: whether a lease runs that it has granted.
        acts: if the agent owns the task: whether it may act now.
        age_s: how old the checkpoint was that it holds when the owner was heard last; None: that is not known.
        called: the agent that it has called to take the task; empty: none.
        gave: the agent to which it gave the task, or promised it as its owner; empty: none.
    """

    task_id: TaskId
    register: Register
    lease: bool = False
    acts: bool = False
    age_s: AgeSeconds | None = None
    called: _Name = ""
    gave: _Name = ""

    @property
    def epoch(self) -> Epoch:
        """The highest epoch that is known."""
        return max(self.register.epoch, self.register.promised)

    @property
    def owner(self) -> str:
        """The agent that has the task, as far as that is known; empty: it was removed, or that is not known."""
        if self.removed:
            return ""
        register = self.register
        is_given = register.promised > register.epoch and register.promised.minter.agent == self.gave
        return self.gave if is_given else register.owner.agent

    def at(self, by: str) -> str:
        """Return the agent that has the task, if the one that says this must know: itself, or one to which it gave it.

        All else that it knows is by the word of others, who may have no right to the task.
        """
        return "" if self.removed else self.gave or (by if self.owner == by else "")

    @property
    def removed(self) -> bool:
        """Whether the task was removed, and is nowhere."""
        return self.register.wanted.value == "removed"


_Asked = Annotated[tuple[TaskId, ...], msgspec.Meta(max_length=MOST_ASKED)]


@packet_type("task.who_has")
class WhoHas(msgspec.Struct, frozen=True):
    """Asks what an agent knows of tasks. The one question; `Known` is the one answer.

    Attributes:
        task_ids: the tasks.
        silent: whether a member asks because the owner is silent: it looks for another one.
    """

    task_ids: _Asked
    silent: bool = False


@packet_type("task.known")
class Known(msgspec.Struct, frozen=True):
    """What an agent knows of tasks: an answer, a refusal, or news at a new link.

    Attributes:
        by: the agent.
        task_ids: the tasks that were asked about.
        facts: what it knows; of the other tasks nothing.
    """

    by: Identity
    task_ids: _Asked
    facts: Annotated[tuple[Fact, ...], msgspec.Meta(max_length=MOST_ASKED)]

    @property
    def claims(self) -> list[Fact]:
        """What it says of the tasks that it owns."""
        return [fact for fact in self.facts if fact.register.owner == self.by and not fact.removed]


@packet_type("task.boot")
class BootRemembered(msgspec.Struct, frozen=True):
    """Tells an agent that its disk is an old copy, as the sender remembers a later boot of its journal.

    Attributes:
        boot_journal: the id of that journal.
        number: the latest boot that the sender remembers.
        life: what was drawn at it.
    """

    boot_journal: Annotated[str, msgspec.Meta(max_length=64)]
    number: int
    life: Annotated[str, msgspec.Meta(max_length=64)]


# Members ------------------------------------------------------------------------------------------------------------


@packet_type("task.call")
class Call(msgspec.Struct, frozen=True):
    """A member tells an agent to take a task whose owner is silent: it made the lowest bid. No safety hangs on it.

    Attributes:
        type: entry point name of the task's class.
        service: the service that is to look after it.
        floor: the highest epoch that any member follows, as far as is known.
        sets: the members.
        silent_s: for how long the owner has been silent, in host seconds.
    """

    task_id: TaskId
    type: _Name
    service: _Name
    floor: Epoch
    sets: Sets
    silent_s: AgeSeconds = 0.0
    journal: str = ""


@packet_type("task.may_guard")
class MayGuard(msgspec.Struct, frozen=True):
    """The owner of a task asks another agent whether it would guard it. Answered by `CanGuard`."""

    task_id: TaskId
    type: _Name
    journal: str = ""


@packet_type("task.can_guard")
class CanGuard(msgspec.Struct, frozen=True):
    """Says whether an agent would guard a task.

    Attributes:
        guardian: the agent that says so.
        refusal: why not; empty: it would.
        runs_type: whether it could run the task: else it is a witness, which only remembers.
        on_battery: whether it runs on a battery.
        up_s: for how long it has been up, in host seconds.
    """

    task_id: TaskId
    guardian: Identity
    refusal: str
    runs_type: bool
    on_battery: bool
    up_s: float
    journal: str = ""


OfRegister = Accept | Piece | Accepted | Prepare | Promise | Call | MayGuard | CanGuard | Refuse
Bidding = Solicit | Bid | Refuse
ToPeer = OfRegister | Bidding

_M = TypeVar("_M", bound=msgspec.Struct)


def addressed(message: _M, journal: str) -> _M:
    """Return the message, meant for the agent whose journal has the id `journal`."""
    return replace(message, journal=journal)


def is_for(message: ToPeer, journal: str) -> bool:
    """Return whether the agent whose journal has the id `journal` may believe the message."""
    return message.journal == journal


LONG_UP_S: Final = 600.0
"""An agent that has been up for this long counts as stable."""


def choose(
    me: Identity,
    now: Iterable[Identity],
    silent: Collection[Identity],
    named: Collection[str],
    number: int,
    answers: Iterable[CanGuard],
) -> tuple[Identity, ...] | None:
    """Choose the members of a task.

    Those that are there stay, unless they are silent. Of the others, those that the configuration names come first,
    then those that can run the task, those on mains, and those that have been up for long.

    Args:
        me: the owner, which is one of them.
        now: the members as they are.
        silent: those of them that have said nothing for too long.
        named: agents that the configuration names.
        number: how many there are to be.
        answers: what neighbours have said.

    Returns:
        The members; None: there are not enough.
    """
    able = [one for one in answers if not one.refusal and one.guardian.agent != me.agent]
    stay = [one for one in now if one not in silent and one.agent != me.agent][: number - 1]
    taken = {me.agent, *(one.agent for one in stay)}
    able.sort(
        key=lambda one: (
            one.guardian.agent not in named,
            not one.runs_type,
            one.on_battery,
            one.up_s < LONG_UP_S,
            one.guardian.agent,
        )
    )
    new = [one.guardian for one in able if one.guardian.agent not in taken][: number - 1 - len(stay)]
    chosen = (me, *stay, *new)
    return chosen if len(chosen) == number else None
