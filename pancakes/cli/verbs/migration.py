"""`pancakes task migrate|migrations|adopt`: tasks that move, have moved, or are stuck between two agents."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import click

from pancakes.cli.asking import accepted, ask_each
from pancakes.cli.completing import costs, tasks_beside
from pancakes.cli.errors import sentences
from pancakes.cli.names import AgentNameType, TaskName, a_task, agents
from pancakes.cli.options import asks_agents, asks_agents_for, dry_run_option, orders_agents
from pancakes.cli.output import DRY_RUN, show, show_json
from pancakes.client import Client
from pancakes.control import Adopt, Migrate, Migrations
from pancakes.errors import ControlRefused, NoAnswer

LINES = ("neighbour", "answer", "cost", "terms", "fate", "reason")
MOVES = (
    "source",
    "number",
    "boot",
    "mission_s",
    "task_id",
    "outcome",
    "winner",
    "to",
    "cost",
    "duration_s",
    "asked_by",
    "reason",
)


@click.command()
@a_task
@click.option("--to", metavar="AGENT", type=AgentNameType(), default="", help="Ask only this neighbour.")
@click.option(
    "--then",
    metavar="TASK",
    default="",
    shell_complete=tasks_beside,
    help="Start this task where the other was, once it has gone.",
)
@click.option(
    "--cost",
    metavar="NAME",
    default="tasks",
    show_default=True,
    shell_complete=costs,
    help="The cost function to bid with.",
)
@click.option("--dry-run", is_flag=True, help="Only ask who would take it, and for what cost; move nothing.")
@asks_agents_for(30.0)
@sentences
def migrate(
    name: TaskName,
    to: str,
    then: str,
    cost: str,
    dry_run: bool,
    format_: str,
    at: tuple[str, ...],
    timeout: float,
) -> None:
    """Move a running task to the neighbour that takes it for the lowest cost, and wait until it runs there.

    Shows who was asked, what each answered, and why the others did not get it. The exit code is 1 where nobody takes
    it; the task has then never stopped.

    \b
    Example:
        pancakes task migrate agent1/ScanTarget --dry-run
        pancakes task migrate agent1/ScanTarget --to agent2 --then GoHome
    """
    with Client(at, timeout) as client:
        try:
            reply = client.request(name.agent, Migrate(name.target, to, then, cost, dry_run))
        except NoAnswer as error:
            if dry_run:
                raise
            hint = f"the move may go on all the same, pancakes task migrations {name.agent} shows what becomes of it"
            raise NoAnswer(f"{error}\n{hint}") from None
    if reply.result is not None:
        _show_ledger(reply.result, format_)
    if not reply.ok:
        raise ControlRefused(reply.reason)


@click.command()
@agents
@asks_agents
@sentences
def migrations(agents: tuple[str, ...], format_: str, at: tuple[str, ...], timeout: float) -> None:
    """List the moves that all agents, or those that are named, were asked for: the newest 100 of each, oldest first.

    They come from the journals of the agents that the tasks were to leave. As JSON, each has a line for every
    neighbour that was asked.

    \b
    Example:
        pancakes task migrations
        pancakes task migrations agent1 --format json
    """
    moves: list[dict[str, Any]] = [move for _, moves in ask_each(at, timeout, Migrations(), *agents) for move in moves]
    if format_ == "json":
        show_json(moves)
    else:
        show(moves, MOVES, format_)


@click.command()
@a_task
@click.option("--force", is_flag=True, help="Do it. Without, it is only said what it would mean.")
@click.option(
    "--birthplace",
    metavar="AGENT",
    type=AgentNameType(),
    default="",
    help="Where it was born, if two of its name are in doubt.",
)
@dry_run_option
@orders_agents
@sentences
def adopt(
    name: TaskName,
    force: bool,
    birthplace: str,
    dry_run: bool,
    format_: str,
    at: tuple[str, ...],
    timeout: float,
) -> None:
    """Run a task on AGENT whose hand-off is in doubt, because the other agent is gone for good.

    This is the one act that can make two of a task: where the other agent runs it, or comes back with its disk. So
    see first that the task runs nowhere, and switch the other agent off; set it up anew, with an empty state_dir, only
    after the adoption. It is refused while the other agent is connected. Without --force nothing is done, and the exit
    code is 1.

    \b
    Example:
        pancakes task adopt agent1/ScanTarget
        pancakes task adopt agent1/ScanTarget --force
    """
    with Client(at, timeout) as client:
        reply = accepted(client, name.agent, Adopt(name.target, force, birthplace, dry_run))
    row = {
        "agent": name.agent,
        "task_id": reply.result["task_id"],
        "done": DRY_RUN if dry_run else "adopted",
        "instead_of": reply.result["peer"],
        "number": reply.number,
    }
    show([row], tuple(row), format_)


def _show_ledger(ledger: Mapping[str, Any], format_: str) -> None:
    if format_ == "json":
        show_json([ledger])
        return
    task_id, source, winner, duration_s = (ledger[key] for key in ("task_id", "source", "winner", "duration_s"))
    story = {
        "moved": f"{task_id} moved from {source} to {winner}",
        "dry run": f"{task_id} would move from {source} to {winner}",
        "stayed": f"{task_id} stays on {source}",
        "undecided": f"{task_id} was on its way from {source} to {winner} when this account was closed",
    }[ledger["outcome"]]
    only = f"; only {ledger['to']} was asked" if ledger["to"] else ""
    click.echo(f"{story} (cost {ledger['cost']}, {duration_s:.3f} s{only})")
    if ledger["lines"]:
        rows = [{**line, "neighbour": line["peer"], "terms": _terms(line["terms"])} for line in ledger["lines"]]
        show(rows, LINES, format_)


def _terms(terms: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:g}" for name, value in terms.items())
