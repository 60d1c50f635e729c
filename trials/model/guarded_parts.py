"""What the search of guarded tasks is made of: the agents, what may happen to them, and the rules under search."""

from __future__ import annotations

from types import ModuleType
from typing import Any, Final, NamedTuple

from pancakes.durable import guarding, handoff
from pancakes.durable.guarding import GuardRegister, Lease, Seizing
from pancakes.durable.messages import (
    CheckpointId,
    HandOffMessage,
    KeepLease,
    LeaseKept,
    Pledge,
    SeizeTask,
    Solicit,
    YieldLease,
)
from pancakes.durable.record import NO_EPOCH, Epoch, GuardianId, Phase, Record, TaskId, Volatile

TASK: Final = TaskId("A", "Scan")
TYPE: Final = "scan"
REQUEST: Final = Solicit(TASK, 1, TYPE, "1.0", "client")
OWNED: Final = (Phase.OWNER, Phase.FROZEN)
STOP: Final = 7
"""The number of the packet that stands for a person's wish that the task be stopped."""
STOPPED: Final = 1 << STOP
BOOT: Final = 1
"""The life of every guardian: what was said to a former one is said to life 0."""


class Violation(Exception):
    """A promise is broken; the message says which."""


class Scenario(NamedTuple):
    """What may happen in one search, and how often. What is not bounded here may happen any number of times.

    Attributes:
        title: its name.
        agents: the agents.
        owner: the one that owns the task at first.
        guards: its guardians then.
        takers: the agents that guardians may call.
        numbers: the highest number in an epoch.
        called: the highest one under which an agent that guardians call asks for pledges.
        window: so many askings may be under way whose permits have not lapsed.
        own: so many of these may be of one life of an owner.
        packets: so many packets are sent to the task.
        moves: the agents to which the task may be handed over, once.
        swap: the guardians that may take the place of the first ones, once; a digit is the number of a journal.
        swapped: whether it begins where they have, and not all old guardians know: of those that stay, others than the
            owner know of both sets, and those that go of nothing; a KEEP from before is still on its way.
        wipes: the agents whose disks may be lost, each once.
        copies: the agents whose disks may be replaced by a copy, each once: it was made at any time before.
        stops: whether a person may have the task stopped, and then started again, once.
        adopts: whether a person has the task adopted where most of its guardians have lost their disks.
        goodbyes: so often an owner's agent may be shut down in order, and come back.
        bare: whether a KEEP may come without the checkpoint's body.
        crashes: the agents that may crash.
        at_once: whether an agent's own guardian hears at once what its owner, or taker, says to all guardians: both are
            actors of one agent. Else that may be late, and lost, as with others.
    """

    title: str
    agents: str = "ABC"
    owner: str = "A"
    guards: str = "ABC"
    takers: str = "BC"
    numbers: int = 1
    called: int = 1
    window: int = 2
    own: int = 1
    packets: int = 0
    moves: str = ""
    swap: str = ""
    swapped: bool = False
    wipes: str = ""
    copies: str = ""
    stops: bool = False
    adopts: bool = False
    goodbyes: int = 0
    bare: bool = False
    crashes: str = "ABCD"
    at_once: bool = True


class Backup(NamedTuple):
    """A copy of a disk.

    Attributes:
        record: the record of the task.
        register: what a guardian has of it that believes the copy; the product's does not.
    """

    record: Record
    register: GuardRegister = GuardRegister(TASK)


class Party(NamedTuple):
    """One agent.

    Attributes:
        record: its record of the task.
        volatile: what it knows besides, until it crashes.
        actor: what the task's object here has taken in, a bit for each packet; -1: there is none.
        still: whether it stands still for a hand-off.
        permit: the asking by which it may act; 0: it may not.
        asked: the askings of this owner that have not lapsed.
        behind: whether it has learnt that its disk is an old copy.
        owed: what is acknowledged once a checkpoint is at a quorum, as bits.
        taking: what it has that is to take the task.
        register: what its guardian has on disk.
        lease: what its guardian has granted.
        until: the asking with which that lease lapses; 0: it has, and may end at any time.
        journal: the number of its journal, and of the copy of that.
        original: the epoch under which it owned the task when that copy was made that it came back with.
        backup: the copy that was made of its disk; None: there is none, or it was used.
    """

    record: Record
    volatile: Volatile = Volatile()
    actor: int = -1
    still: bool = False
    permit: int = 0
    asked: tuple[int, ...] = ()
    behind: bool = False
    owed: tuple[tuple[CheckpointId, int], ...] = ()
    taking: Seizing | None = None
    register: GuardRegister = GuardRegister(TASK)
    lease: Lease = Lease(boot=BOOT)
    until: int = 0
    journal: int = 0
    original: Epoch = NO_EPOCH
    backup: Backup | None = None

    @property
    def acts(self) -> bool:
        """Whether the task may act here."""
        return self.actor >= 0 and not self.still and (self.permit > 0 or not self.record.guarded)

    @property
    def owns(self) -> bool:
        """Whether it asks guardians for leases."""
        return self.record.phase in OWNED and self.record.guarded


class Budget(NamedTuple):
    """What may still happen."""

    moves: int = 0
    swaps: int = 0
    wipes: str = ""
    copies: str = ""
    stops: int = 0
    adopts: int = 0
    goodbyes: int = 0


class GuardedWorld(NamedTuple):
    """All there is.

    Attributes:
        parties: the number of each agent.
        net: the messages that were sent, as bits.
        top: so many askings have not lapsed.
        acked: what was acknowledged, as bits.
        reign: the highest epoch that has acted.
        left: what may still happen.
    """

    parties: tuple[int, ...]
    net: int
    top: int
    acked: int
    reign: Epoch
    left: Budget


class Word(NamedTuple):
    """A message of a hand-off, on its way."""

    source: str
    to: str
    message: HandOffMessage


class Farewell(NamedTuple):
    """A YIELD on its way to one guardian."""

    to: GuardianId
    message: YieldLease


Message = KeepLease | LeaseKept | SeizeTask | Pledge | Word | Farewell


class Rules(NamedTuple):
    """The functions under search: the product's, or those of a broken variant.

    Attributes:
        core: decides for the agent that has, had or is to have the task.
        guardian: decides for a guardian.
        tenure: what an owner makes of its guardians' answers.
        seizing: what an agent makes of them that is to take the task.
        tells_copies: whether a guardian whose disk is a copy is another guardian.
        prunes: whether messages that can change nothing are left out; of a variant that is not sure.
    """

    core: ModuleType | Any = handoff
    guardian: ModuleType | Any = guarding
    tenure: ModuleType | Any = guarding
    seizing: ModuleType | Any = guarding
    tells_copies: bool = True
    prunes: bool = True


def guardians(text: str) -> tuple[GuardianId, ...]:
    """Returns the guardians that a scenario names: `AB1C` are A, B with its second journal, and C."""
    out: list[GuardianId] = []
    for letter in text:
        if letter.isdigit():
            out[-1] = GuardianId(out[-1].agent, f"j{letter}")
        else:
            out.append(GuardianId(letter, "j0"))
    return tuple(out)


def short(epoch: Epoch) -> str:
    """Returns an epoch for people."""
    return str(epoch) if epoch != NO_EPOCH else "none"
