"""What the search is made of: the task, the agents that have it or not, and what one step does to one of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from pancakes.durable import handoff, snapshot
from pancakes.durable.handoff_events import Effect, Event
from pancakes.durable.messages import Solicit
from pancakes.durable.record import Epoch, Record, TaskId, Volatile
from pancakes.durable.snapshot import Snapshot

TASK: Final = TaskId("A", "ScanTarget")
"""The task that moves; it is born on A."""
REQUEST: Final = Solicit(TASK, 1, "encirclement.ScanTarget", "1.0", "client")
STREAM: Final = "sender"
"""The stream of the packets that are sent to the task."""
ALL: Final = 1 << 30
"""More packets than are ever sent."""


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
    """One agent.

    Attributes:
        disk: the record on its disk.
        memory: the record that it holds for true; the same, as long as no write has failed.
        volatile: what it knows until it crashes.
        actor: the task's object, where there is one.
        pending: what is on its way to the core inside this agent, in order: a checkpoint that was taken, a write
            that is to be tried again.
    """

    disk: Record
    memory: Record
    volatile: Volatile = Volatile()
    actor: Actor | None = None
    pending: tuple[Event, ...] = ()


BLANK: Final = Agent(Record(TASK), Record(TASK))
"""An agent that has never heard of the task."""


class Outcome(NamedTuple):
    """What one step of one agent does to the world.

    Attributes:
        story: the step in a sentence.
        agent: the agent's number afterwards.
        sends: the messages that it sent, as bits.
        acked: the highest packet acknowledged in it.
        kept: the highest packet that it left; what follows was never checkpointed, and is lost with its owner.
        started: the epochs under which it started the task, in order.
        before_crash: the agent's number just before it crashed, for what it had started counts; -1: no crash.
        fault: whether a write failed in it.
    """

    story: str
    agent: int
    sends: int = 0
    acked: int = 0
    kept: int = ALL
    started: tuple[Epoch, ...] = ()
    before_crash: int = -1
    fault: bool = False


@dataclass(frozen=True)
class Core:
    """The functions under search; the product's, or a mutant's."""

    handle: Callable[..., list[Effect]] = handoff.handle
    recover: Callable[..., list[Effect]] = handoff.recover
    decode: Callable[[bytes], Snapshot] = snapshot.Snapshot.decode


@dataclass(frozen=True)
class Keep:
    """An effect that only a mutant asks for: believe a record without writing it."""

    record: Record


@dataclass(frozen=True)
class Bounds:
    """How far a search goes. Whatever is not bounded here may happen any number of times.

    Attributes:
        agents: how many there are.
        offers: how many hand-offs may be tried.
        packets: how many packets are sent to the task.
        durability: `each` or `lazy`, as for a task.
        refusals: whether destinations refuse and tasks fail to stop.
        reserve: whether reservations are exchanged; else the answer may appear at any time (more can happen,
            in fewer states).
        restarts: how often under one epoch the task's actor may fail, or be stopped, and be started again.
        stops: whether the task may also be stopped, or given up by its service, within `restarts`.
        late: whether a checkpoint may reach the core long after it was taken.
        faults: how many writes to a disk fail.
        wipes: how many disks are lost.
        adopt: whether a person has the task adopted where the other side's disk is lost, and the newest record
            of the task is here.
    """

    agents: int = 2
    offers: int = 2
    packets: int = 1
    durability: str = "each"
    refusals: bool = True
    reserve: bool = True
    restarts: int = 0
    stops: bool = False
    late: bool = False
    faults: int = 0
    wipes: int = 0
    adopt: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the agents."""
        return tuple("ABCDE"[: self.agents])

    @property
    def lazy(self) -> bool:
        """Whether packets are acknowledged ahead of the checkpoint."""
        return self.durability == "lazy"

    def __str__(self) -> str:
        plain = Bounds()
        words = [f"{self.agents} agents", f"{self.offers} offer{'s' * (self.offers > 1)}"]
        words.append(f"{self.packets} packet{'s' * (self.packets > 1)}")
        for name, word in _WORDS.items():
            value: Any = getattr(self, name)
            if value != getattr(plain, name):
                words.append(word.format(value, "s" * (value > 1)) if isinstance(value, int) else word)
        return ", ".join(words)


_WORDS: Final = {
    "durability": "lazy",
    "refusals": "no refusals",
    "reserve": "no reservations",
    "restarts": "{} restart{}",
    "stops": "stops",
    "late": "late checkpoints",
    "faults": "{} failed write{}",
    "wipes": "{} lost disk{}",
    "adopt": "adopted",
}


def heard_of(snapshot: Snapshot) -> int:
    """Returns up to which packet the task has heard its sender."""
    return snapshot.heard.get(STREAM, 0)
