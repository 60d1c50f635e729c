"""What a person decides about a task: which one is meant, and what has to be known before (see docs/protocol.md)."""

from __future__ import annotations

from collections.abc import Sequence

from pancakes.errors import ControlRefused
from pancakes.mesh.migration.epoch import NO_EPOCH
from pancakes.mesh.migration.owner import is_disputed
from pancakes.mesh.migration.record import Phase, Record, TaskId
from pancakes.runtime.hosting.lost import Lost


def was_forgotten(record: Record) -> bool:
    """Returns whether a person has let the task rest here, after its record was lost."""
    return record.phase is Phase.ABSENT and record.seen != NO_EPOCH and not record.peer


def chosen(
    service: str,
    name: str,
    birthplace: str,
    records: Sequence[Record],
    lost: Sequence[Lost],
    verb: str = "adopt",
) -> Record | Lost:
    """Returns what is known of the task that is to be adopted or forgotten.

    Args:
        service: address of the service that is asked.
        name: the task's name.
        birthplace: the agent that it was born on; empty: any.
        records: what the service has of tasks of this name.
        lost: those of this name whose records were lost.
        verb: what is to be done: `adopt`, or `forget`, which is for the latter, and for what another agent has brought
            and not handed over.

    Raises:
        ControlRefused: none of them can be meant, or several can.
    """
    meant = [record for record in records if birthplace in ("", record.task_id.birthplace)]
    found: list[Record | Lost] = [one for one in lost if birthplace in ("", one.task_id.birthplace)]
    if verb == "adopt":
        found += [record for record in meant if record.in_doubt]
        found += [record for record in meant if was_forgotten(record) or is_disputed(record)]
    else:
        found += [record for record in meant if record.phase is Phase.PREPARED]
    known = {one.task_id for one in found}
    meant = [record for record in meant if record.task_id in known or not record.unborn]
    if len(found) == 1:
        return found[0]
    if found:
        ids = " and ".join(str(one.task_id) for one in found)
        raise ControlRefused(f"{service} has {ids} in doubt: say which by its birthplace")
    if not meant:
        raise ControlRefused(f"{service} knows of no task {name!r}" + (f" of {birthplace}" if birthplace else ""))
    stands = " and ".join(f"{record.task_id} is {_standing(record)}" for record in meant)
    raise ControlRefused(f"there is nothing to {verb}: {stands}")


def meaning(record: Record, me: str) -> str:
    """Returns what adopting a task would mean, for a person who has not yet said `force`."""
    task_id, peer = record.task_id, record.peer
    if is_disputed(record):
        return (
            f"{task_id} is owned by {me} (epoch {record.epoch}) and by {peer}, and rests here. By force, it runs on"
            f" {me} as it was, under an epoch that is higher than both, and stands still on {peer}."
            f" `pancakes task resolve {me}/{task_id.name}` does that, and clears it from {peer}. Nothing was done"
        )
    if record.phase is Phase.COMMITTED:
        doubt = f"{task_id} was given to {peer} (offer {record.offer}), which does not say that it has it"
    else:
        doubt = f"{task_id} rests on {me} (offer {record.offer}), and {peer} does not say whether it was given away"
    return (
        f"{doubt}. Adopted by force, it runs on {me} from the snapshot of that hand-off, under a new epoch."
        f" Where {peer} runs it, or ever comes back with its disk, there are two of it."
        f" So only where {peer} is gone for good: see that the task runs nowhere, switch {peer} off, adopt by force,"
        f" and only after that set {peer} up anew, with an empty state_dir."
        f" Otherwise wait: the hand-off goes on by itself once {peer} answers. Nothing was done"
    )


def cost_of_forgetting(record: Record, me: str) -> str:
    """Returns what dropping a task that was never handed over means, for a person who has not yet said `force`."""
    return (
        f"{record.task_id} rests on {me} (offer {record.offer}), and {record.peer} does not say whether it was given"
        f" away. Forgotten by force, it is nowhere if {record.peer} has given it away and is gone for good. Nothing was"
        f" done"
    )


def meaning_of_copy(record: Record, me: str) -> str:
    """Returns what it would mean that a task goes on from an old copy, for a person who has not yet said `force`."""
    return (
        f"{record.task_id} stands still, because the disk of {me} is an old copy: it may be elsewhere by now. By force,"
        f" it goes on on {me} from that copy (epoch {record.epoch}). Where another agent owns it, both run until they"
        f" are linked; then this one stands still, and `pancakes task resolve` decides. Nothing was done"
    )


def cost_of_revival(task_id: TaskId, me: str, checkpoint: str) -> str:
    """Returns what reviving a task would mean, for a person who has not yet said `force`.

    Args:
        task_id: the task.
        me: the agent that it is to run on.
        checkpoint: what it would go on from, as a clause; empty: it begins as its configuration says.
    """
    if checkpoint:
        loss = (
            f"{task_id} would go on on {me} from {checkpoint}: what it has done since is lost, and with it the effect"
            f" of what it has acknowledged since"
        )
    else:
        loss = (
            f"{task_id} would begin anew on {me}, as its configuration says: its state is lost, and with it the effect"
            f" of all that it has acknowledged"
        )
    return (
        f"{loss}. Packets that wait for it come here. Where the agent that had it still runs, cut off from {me}, there"
        f" are two of it until they are linked; then the other one stands still. So only where that agent is gone for"
        f" good, or off. Nothing was done"
    )


def cost_of_standing_alone(record: Record, me: str) -> str:
    """Returns what it would mean that a task goes on without its guardians, for a person who has not said `force`."""
    others = " and ".join(one.agent for one in record.guards.members() if one.agent != me) or "no other agent"
    return (
        f"{record.task_id} stands still on {me}: its guardians are {me} and {others}, and more than half do not answer."
        f" By force, it goes on as it stands, nothing is lost, and {me} alone guards it until others are chosen."
        f" Where those that are silent still run, cut off from {me}, they may have another agent run it, and there are"
        f" two of it until they are linked; then the other one stands still. So only where they are gone for good, or"
        f" off. Nothing was done"
    )


def _standing(record: Record) -> str:
    match record.phase:
        case Phase.OWNER if is_disputed(record):
            return f"here, and owned by {record.peer} too"
        case Phase.OWNER:
            return "here already"
        case Phase.RELEASED if record.removed:
            return "removed"
        case Phase.RELEASED:
            return f"with {record.peer}, which has said so"
        case Phase.FROZEN:
            return "here, and about to be handed over"
        case Phase.COMMITTED | Phase.PREPARED:
            return f"in doubt between this agent and {record.peer}, so adopt it or wait"
        case _:
            return "not here" + (f", {record.peer} had it last" if record.peer else "")
