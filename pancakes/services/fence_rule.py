"""Rules of the fence: which agents may raise the fence of an actuator, and to what a person may set it. Pure.

A fence is the highest epoch of a task that an actuator has seen. If an agent could raise it at will, it would lock
the task's own commands out for good. So only an agent that has the task, or is known to have been given it, raises
it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Final

import msgspec

from pancakes.durable.messages import Fact
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import NO_EPOCH, Epoch
from pancakes.durable.rules import MOST_STEP
from pancakes.errors import MigrationError
from pancakes.packet import Fence

MOST_TASKS: Final = 1000
"""An actuator that has seen this many tasks takes no other from another agent: what it has seen is never forgotten."""
MOST_OF_PEER: Final = 250
"""At most this many are of one other agent, which would otherwise leave no room for those of others."""
MOST_ASKED: Final = 8
"""At most this many agents, one after the other, may each say that they gave the task to the next one."""


class TaskAt(msgspec.Struct, frozen=True):
    """Which agent has a task, as far as another one knows.

    Attributes:
        task_id: the task, as `birthplace/name`.
        peer: the agent that has it, which may be the sender; empty: unknown.
        epoch: the highest epoch that is known of it; of the agent that has it, the one under which it runs.
    """

    task_id: str
    peer: str = ""
    epoch: Epoch = NO_EPOCH


def task_at(task_id: str, by: str, fact: Fact | None) -> TaskAt:
    """Return what the answer of the agent `by` says of where a task is; `fact`: None: nothing."""
    return TaskAt(task_id, fact.at(by), fact.epoch) if fact is not None else TaskAt(task_id)


class Mark(msgspec.Struct, frozen=True, array_like=True):
    """The highest epoch of a task that an actuator has seen.

    Attributes:
        n: its number.
        minter: the agent that minted it.
        peer: the agent that brought it, which may be the actuator's own.
    """

    n: int
    minter: str
    peer: str


class EpochClaim(msgspec.Struct, frozen=True):
    """A command under an epoch that is new to an actuator.

    Attributes:
        fence: the task and the epoch.
        peer: the agent that the command comes from.
    """

    fence: Fence
    peer: str


class May(msgspec.Struct, frozen=True):
    """The fence is raised."""


class ClaimRefused(msgspec.Struct, frozen=True):
    """It is not; the reason is a clause for people."""

    reason: str


class AskAgent(msgspec.Struct, frozen=True):
    """This agent had the task, and is asked which one it gave it to."""

    peer: str


Verdict = May | ClaimRefused | AskAgent


def judged(
    me: str, claim: EpochClaim, marks: Mapping[str, Mark], record: Record | None, linked: Collection[str]
) -> Verdict:
    """Return what becomes of a claim.

    Args:
        me: the agent that has the actuator.
        claim: the claim, whose epoch is not lower than the mark of its task.
        marks: what the actuator has seen, by task.
        record: what this agent knows of the task.
        linked: the agents that can be asked.
    """
    task_id, n = claim.fence.task_id, claim.fence.epoch[0]
    if claim.peer == me:
        return May()
    mark = marks.get(task_id)
    if mark is None and len(marks) >= MOST_TASKS:
        return ClaimRefused(f"{len(marks)} tasks have commanded it, and {task_id} is none of them")
    if mark is None and sum(it.peer == claim.peer for it in marks.values()) >= MOST_OF_PEER:
        return ClaimRefused(f"{MOST_OF_PEER} tasks of {claim.peer} have commanded it, and {task_id} is none of them")
    known_n = max(mark.n if mark is not None else 0, record.seen.n if record is not None else 0)
    if n > known_n + MOST_STEP:
        return ClaimRefused(f"the epoch {n} of {task_id} is further from {known_n} than any task comes")
    last = mark.peer if mark is not None else ""
    if claim.peer == last:
        return May()
    if record is not None and record.owned:
        return ClaimRefused(f"{task_id} is here, under epoch {record.epoch.n}")
    # An agent may offer any task: only what this one has given away itself says where it is.
    given = record.gave if record is not None else ""
    birthplace = _birthplace(task_id)
    if claim.peer in (given, birthplace):
        return May()
    had = [agent for agent in dict.fromkeys((last, given, birthplace)) if agent not in ("", me)]
    for agent in had:
        if agent in linked:
            return AskAgent(agent)
    why = f", and {' and '.join(had)}, which had it, cannot be asked" if had else ""
    return ClaimRefused(f"{claim.peer} is not known to have been given {task_id}{why}")


def answered(claim: EpochClaim, asked: int, by: str, at: TaskAt, linked: Collection[str]) -> Verdict:
    """Return what becomes of a claim once an agent that had the task has said which one has it.

    Args:
        claim: the claim.
        asked: how many agents have been asked for it.
        by: the one that answers now.
        at: what it says.
        linked: the agents that can be asked.
    """
    task_id = claim.fence.task_id
    if at.peer == claim.peer:
        return May()
    if at.peer == by:
        return ClaimRefused(f"{by} has {task_id}, under epoch {at.epoch.n}, and not {claim.peer}")
    if not at.peer:
        return ClaimRefused(f"{by} does not know that {claim.peer} was given {task_id}")
    if at.peer in linked and asked < MOST_ASKED:
        return AskAgent(at.peer)
    return ClaimRefused(f"{by} gave {task_id} to {at.peer}, and not to {claim.peer}")


class PresentOwner(msgspec.Struct, frozen=True):
    """The agent that has a task now, and the mark that follows from that."""

    name: str
    mark: Mark


def present_owner(
    me: str, task_id: str, own: TaskAt, answers: Mapping[str, TaskAt | None]
) -> PresentOwner | ClaimRefused:
    """Return which agent has a task now: of several that say that they do, the one with the highest epoch.

    Args:
        me: the agent that has the actuator.
        task_id: the task.
        own: what it knows itself.
        answers: what all connected agents say; None: nothing.
    """
    silent = sorted(peer for peer, at in answers.items() if at is None)
    if silent:
        return ClaimRefused(
            f"{' and '.join(silent)} did not say whether {task_id} is there: ask again, or end it first"
        )
    claims = {peer: at.epoch for peer, at in {me: own, **answers}.items() if at is not None and at.peer == peer}
    if not claims:
        return ClaimRefused(
            f"no agent that is connected has {task_id}, so its fence stays as it is: recover the task first"
        )
    name = max(claims, key=lambda peer: claims[peer])
    epoch: Epoch = claims[name]
    return PresentOwner(name, Mark(epoch.n, epoch.minter.agent, name))


def _birthplace(task_id: str) -> str:
    try:
        return TaskId.parse(task_id).birthplace
    except MigrationError:
        return ""
