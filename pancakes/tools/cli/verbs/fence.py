"""`pancakes task fence`: which epochs of tasks an actuator has seen, and what a person does where that is wrong."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from pancakes.control import Describe, SetFence
from pancakes.errors import MigrationError
from pancakes.mesh.migration.record import TaskId
from pancakes.packet import join
from pancakes.tools.cli.asking import accepted, order, placed
from pancakes.tools.cli.consent import force_option, must_be_meant
from pancakes.tools.cli.name_types import TASK_NAME, TaskName
from pancakes.tools.cli.options import Ask, dry_run_option, orders_agents
from pancakes.tools.cli.output import DRY_RUN

if TYPE_CHECKING:
    from pancakes.client import Client

COLUMNS = ("actuator", "task_id", "seen", "brought_by", "owner", "owner_has", "obeyed", "reason")
"""What the actuator has seen of a task; which agent has the task now, under which epoch, or why that is not known."""


@click.command()
@click.argument("name", metavar="AGENT/ACTUATOR", type=TASK_NAME)
@click.option("--set", "task_id", metavar="BIRTHPLACE/NAME", default="", help="Set the fence for this task.")
@force_option
@dry_run_option
@orders_agents
def fence(name: TaskName, task_id: str, force: bool, dry_run: bool, ask: Ask) -> None:
    """Show which tasks have commanded an actuator, and whether it obeys those that have them now.

    An actuator obeys no epoch of a task lower than the highest that it has seen: so a copy that has lost its right
    moves no wheel. And it takes a higher one only from an agent that is known to have been given the task. Where those
    that could say so are gone, or something brought an epoch too high, the task is refused, and the log says why.

    With --set the actuator goes to its safe hold, and the fence is set to the epoch under which the task runs now. The
    agent of the actuator asks all agents that it is connected to. It refuses where one of them does not answer, and
    where none has the task; of two that have it, the higher epoch counts. See first, with `pancakes task list`, that
    the task runs once. It asks first; if this is no terminal, nothing is done without --force.
    `pancakes task migrations` keeps the account.

    \b
    Example:
        pancakes task fence agent1/motors
        pancakes task fence agent1/motors --set agent1/ScanTarget --dry-run
        pancakes task fence agent1/motors --set agent1/ScanTarget
    """
    if dry_run and not task_id:
        raise click.UsageError("--dry-run is about what --set would do: say for which task")
    if force and not task_id:
        raise click.UsageError("--force is about --set: say for which task")
    if task_id:
        try:
            TaskId.parse(task_id)
        except MigrationError as error:
            raise click.BadParameter(str(error), param_hint="--set") from None
    with ask.client() as client:
        name = placed(client, name)
        if task_id:
            if not (force or dry_run):
                accepted(client, name.agent, SetFence(name.target, task_id, dry_run=True))
                must_be_meant(f"{name} goes to its safe hold, and forgets which epoch of {task_id} it has seen", force)
            reply = accepted(client, name.agent, SetFence(name.target, task_id, dry_run))
            row = {**reply.result, "done": DRY_RUN if dry_run else "set", "number": reply.number}
            ask.show([row], tuple(row))
            return
        rows = fences_of(client, name.agent, name.target)
    ask.show(rows, COLUMNS)


def fences_of(client: Client, agent: str, target: str) -> list[dict[str, Any]]:
    """Returns what an actuator has seen of each task that has commanded it, and which agent has that task now.

    Args:
        client: asks.
        agent: the agent of the actuator.
        target: the actuator, as `service/device`.

    Raises:
        ControlRefused: there is no such device.
        Unreachable: the agent does not answer.
    """
    rows: list[dict[str, Any]] = []
    for mark in order(client, agent, Describe(target)).get("fences", []):
        tried = client.request(agent, SetFence(target, mark["task_id"], dry_run=True))
        seen = f"{mark['epoch']}@{mark['minter']}"
        found = tried.result if tried.ok else {"owner": "", "now": ""}
        rows.append(
            {
                "actuator": join(agent, target),
                "task_id": mark["task_id"],
                "seen": seen,
                "brought_by": mark["brought_by"],
                "owner": found["owner"],
                "owner_has": found["now"],
                "obeyed": found["now"] == seen if tried.ok else None,
                "reason": tried.reason,
            }
        )
    return rows
