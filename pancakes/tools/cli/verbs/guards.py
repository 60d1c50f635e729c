"""`pancakes task guards|take`: guarded tasks, their guardians, and the agents that take them over."""

from __future__ import annotations

from typing import Any, Final

import click

from pancakes.control import Guarding, Take
from pancakes.tools.cli.asking import accepted, ask_each
from pancakes.tools.cli.name_types import AGENT_NAME, TaskName, a_task, agents
from pancakes.tools.cli.options import Ask, asks_agents, asks_agents_for, dry_run_option
from pancakes.tools.cli.output import DRY_RUN
from pancakes.tools.cli.verbs.guard_checks import is_awaited

COLUMNS: Final = ("task_id", "owner", "permit_s", "guardian", "checkpoint", "age_s", "silent_s", "state")


@click.command()
@agents
@asks_agents
def guards(agents: tuple[str, ...], ask: Ask) -> None:
    """List the guarded tasks of all agents, or of those that are named, with a line for each of their guardians.

    A guardian that does not answer is listed as silent. `permit_s` says for how long the owner may act yet: empty where
    it may not. `age_s` says how long ago the task was known to be as the guardian's newest checkpoint says, and
    `silent_s` how long the guardian has not heard the owner.

    \b
    Example:
        pancakes task guards
        pancakes task guards agent1 --format json
    """
    rows = [row for _, answer in ask_each(ask, Guarding(), *agents) for row in answer]
    owners = {(row["task_id"], row["epoch"]): row for row in rows if "guardians" in row}
    shown = [_shown(row, owners.get((row["task_id"], row["epoch"]))) for row in rows]
    for (task_id, epoch), owner in owners.items():
        heard = {row["agent"] for row in rows if row["task_id"] == task_id and row["epoch"] == epoch}
        for name in owner["guardians"]:
            if name not in heard and not agents:
                row = {"task_id": task_id, "owner": owner["owner"], "guardian": name, "state": "silent"}
                shown.append({**dict.fromkeys(COLUMNS), **row, "permit_s": _permit(owner)})
    ask.show(sorted(shown, key=lambda row: (row["task_id"], row["guardian"])), COLUMNS)


def _shown(row: dict[str, Any], owner: dict[str, Any] | None) -> dict[str, Any]:
    state = "guards" if row["lease"] else "owner silent"
    if is_awaited(row):
        state = f"owner silent, its lease ends in {row['lease_left_s']:.0f} s"
    return {**row, "guardian": row["agent"], "permit_s": _permit(owner), "state": state}


def _permit(owner: dict[str, Any] | None) -> float | None:
    return owner["permit_s"] or None if owner is not None else None


@click.command()
@a_task
@click.option(
    "--birthplace", metavar="AGENT", type=AGENT_NAME, default="", help="Where it was born, if two bear its name."
)
@dry_run_option
@asks_agents_for(10.0)
def take(name: TaskName, birthplace: str, dry_run: bool, ask: Ask) -> None:
    """Have a guarded task taken over whose owner is silent; AGENT is one of its guardians.

    Guardians do that by themselves, unless the task says `takeover = "ask"`. More than half of them must say that the
    owner is silent. --dry-run names the agent that would take it, and the newest checkpoint. What the task did after
    that is lost: `age_s` says how old it was when the owner was heard last, and `silent_s` how long ago that is.

    \b
    Example:
        pancakes task take agent2/ScanTarget --dry-run
        pancakes task take agent2/ScanTarget
    """
    with ask.client() as client:
        result = accepted(client, name.agent, Take(name.task, birthplace, dry_run)).result
    row = {"task_id": result["task_id"], "taker": result["winner"], "done": DRY_RUN if dry_run else "taken over"}
    row |= {key: result[key] for key in ("checkpoint", "age_s", "silent_s")}
    ask.show([row], tuple(row))
