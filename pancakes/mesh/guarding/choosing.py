"""Which agents guard a task: the owner asks its neighbours, and chooses. Pure."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import msgspec

from pancakes.mesh.migration.guards import GuardianId
from pancakes.mesh.migration.record import TaskId
from pancakes.packet import packet_type

LONG_UP_S = 600.0
"""An agent that has been up for so long counts as stable."""


@packet_type("guard.ask")
class MayGuard(msgspec.Struct, frozen=True):
    """The owner of a task asks the guardian of another agent whether it would guard it. Answered by `CanGuard`.

    Attributes:
        type: entry point name of the task's class.
    """

    task_id: TaskId
    type: str
    journal: str = ""


@packet_type("guard.can")
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
    guardian: GuardianId
    refusal: str
    runs_type: bool
    on_battery: bool
    up_s: float
    journal: str = ""


def choose(
    me: GuardianId,
    now: Iterable[GuardianId],
    silent: Collection[GuardianId],
    named: Collection[str],
    number: int,
    answers: Iterable[CanGuard],
) -> tuple[GuardianId, ...] | None:
    """Chooses the guardians of a task.

    Those that are there stay, unless they are silent. Of the others, those that the configuration names come first,
    then those that can run the task, those on mains, and those that have been up for long.

    Args:
        me: the owner, which is one of them.
        now: the guardians as they are.
        silent: those of them that have said nothing for too long.
        named: agents that the configuration names.
        number: how many there are to be.
        answers: what neighbours have said.

    Returns:
        The guardians; None: there are not enough.
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
