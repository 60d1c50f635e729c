"""The world of one hosted task on one agent, for the search of its life joined with its hand-off."""

from __future__ import annotations

from typing import Any, Final

import msgspec

from pancakes.durable.messages import Solicit
from pancakes.durable.record import Epoch, Record, TaskId
from pancakes.durable.snapshot import Snapshot
from pancakes.durable.state_machine import Standing
from pancakes.supervision.lifecycle import Life
from pancakes.supervision.restart import RestartSpec

ME: Final = "a"
PEER: Final = "b"
REQUEST: Final = Solicit(TaskId(ME, "Task"), 1, "tests.Task", "1.0", "client")
SEQUEL: Final = b"what follows"


def _snapshot(step: int) -> bytes:
    return Snapshot(TaskId(ME, "Task"), "tests.Task", "1.0", "client", state={"step": step}).encode()


BIRTH: Final = _snapshot(0)
"""What a task is that begins as its configuration says."""
LATER: Final = _snapshot(1)
"""What it is once it has run."""


class Bounds(msgspec.Struct, frozen=True):
    """What may happen in one history, and how often.

    Attributes:
        restart: the restart policy.
        visitor: whether the task was born on the other agent, which has it at first.
        requests: so many requests to start, stop or restart it come.
        spawns: so many actors are made; then there is no room for a further one.
        ends: so often its actor ends by itself.
        errors: whether it may end by an error.
        sticks: whether an actor that is told to end may take too long.
        offers: the highest epoch that this agent offers it under.
        awards: so often the other agent is chosen as its next host.
        theirs: so many offers come from the other agent.
        faults: so many writes fail.
        crashes: so often the agent crashes.
        refusals: so often it lacks room, or what else it asks for.
        closes: whether its service ends.
        checkpoints: whether it is written down while it runs.
        decisions: so often a person has it adopted or forgotten.
        lost: whether its record was lost.
        wiped: whether the whole disk was, and the agent does not know that it ever had a record.
        blocked: whether another task has its name at first.
        follows: whether it is to run because another task has left.
        claims: so often another agent says that it owns it too.
        births: whether it is not born before others have told what they know of it.
        removals: whether a person may have it removed, where it rests; that is a decision.
        copies: so often others take its agent's disk for an old copy, and it stands still until they told.
    """

    restart: RestartSpec = RestartSpec("always", at_most=1)
    visitor: bool = False
    requests: int = 0
    spawns: int = 2
    ends: int = 1
    errors: bool = True
    sticks: bool = False
    offers: int = 0
    awards: int = 1
    theirs: int = 0
    faults: int = 0
    crashes: int = 0
    refusals: int = 0
    closes: bool = False
    checkpoints: bool = False
    decisions: int = 0
    lost: bool = False
    wiped: bool = False
    blocked: bool = False
    follows: bool = False
    claims: int = 0
    births: bool = False
    removals: bool = False
    copies: int = 0


class Spent(msgspec.Struct, frozen=True):
    """How much of its bounds a history has used up."""

    requests: int = 0
    spawns: int = 0
    ends: int = 0
    faults: int = 0
    crashes: int = 0
    refusals: int = 0
    awards: int = 0
    decisions: int = 0
    followed: bool = False
    claims: int = 0
    copies: int = 0


class World(msgspec.Struct, frozen=True):
    """What there is.

    Attributes:
        standing: how the task stands, for the machine.
        disk: the record that a crash would find.
        life: its life; None: it has no place.
        actor: "": none; "made"; "runs"; "still": it stands still; "told": told to end; "told early": that, before it
            ran.
        inbox: what its actor was told and has not come to yet: to stand still for an offer, or to go on (None).
        stood: what its actor has answered to that: the offer, and whether it stands still.
        writing: the record that is being written.
        fence: the epoch and the incarnation that its place was prepared for.
        carried: what its place carries, encoded; empty: what its record says.
        fresh: whether it is to begin anew.
        reserved: whether actuators are kept for it.
        timers: the events that are to come some time, or never.
        open: the requests that are not answered: their numbers, and what they ask for.
        asked_for: what the service has promised others: "adopt", "forget", "follow", "move".
        parts: how much of what follows its hand-over is still to be done.
        settled: whether the start of its service still waits for it.
        closing: "": its service runs; "begun": it ends; "told": the task was told; "over": the task is dealt with.
        blocked: whether another task has its name.
        sent: the messages that this agent has sent.
        theirs: what the other agent has offered, and what became of that.
        lost: whether its record was lost, and what is to become of it is not decided.
        unsure: whether its agent does not know yet whether it is elsewhere.
        spent: how much of the bounds is used up.
    """

    standing: Standing
    disk: Record
    life: Life | None = None
    actor: str = ""
    inbox: tuple[Epoch | None, ...] = ()
    stood: tuple[tuple[Epoch, bool], ...] = ()
    writing: Record | None = None
    fence: tuple[Epoch, int] | None = None
    carried: bytes = b""
    fresh: bool = False
    reserved: bool = False
    timers: frozenset[Any] = frozenset()
    open: frozenset[tuple[int, str]] = frozenset()
    asked_for: frozenset[str] = frozenset()
    parts: int = 0
    settled: bool = True
    closing: str = ""
    blocked: bool = False
    sent: frozenset[tuple[str, Epoch]] = frozenset()
    theirs: tuple[tuple[Epoch, str], ...] = ()
    lost: bool = False
    unsure: bool = False
    spent: Spent = Spent()


class Violation(Exception):
    """A promise is broken."""
