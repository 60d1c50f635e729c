"""`pancakes task migrate|migrations|forget-peer`: migrate tasks, and drop what a lost agent left in doubt."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import click

from pancakes.control import Checkpoints, Forget, Migrate, Migrations
from pancakes.errors import ControlRefusedError, NoAnswerError, PancakesError
from pancakes.tools.cli.agent_requests import ask_each, confirm, request, resolve_fleet, yes_option
from pancakes.tools.cli.options import (
    AGENT_NAME,
    Ask,
    TaskName,
    a_task,
    agents,
    asks_agents,
    asks_agents_for,
    dry_run_option,
    orders_agents,
    the_agent,
)
from pancakes.tools.cli.output import DRY_RUN, Printer, Rows
from pancakes.tools.cli.verbs.task_arguments import costs, tasks_beside

ANSWER_COLUMNS = ("neighbour", "answer", "cost", "terms", "fate", "reason")
MIGRATION_COLUMNS = (
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
@click.option("--to", metavar="AGENT", type=AGENT_NAME, default="", help="Ask only this neighbour to take the task.")
@click.option(
    "--then",
    metavar="TASK",
    default="",
    shell_complete=tasks_beside,
    help="Start this task on the source agent after the migration.",
)
@click.option(
    "--cost",
    metavar="NAME",
    default="tasks",
    show_default=True,
    shell_complete=costs,
    help="The cost function to bid with.",
)
@click.option("--dry-run", is_flag=True, help="Only ask which agents would take it, and at what cost.")
@asks_agents_for(30.0)
def migrate(name: TaskName, to: str, then: str, cost: str, dry_run: bool, ask: Ask) -> None:
    """Migrate a running task to the neighbour that bids the lowest cost, and wait until it runs there.

    It prints which agents were asked, what each answered, and why the others did not get the task. The exit code is 1
    if no agent takes the task; then it has not stopped.

    \b
    Example:
        pancakes task migrate agent1/ScanTarget --dry-run
        pancakes task migrate agent1/ScanTarget --to agent2 --then GoHome
    """
    with ask.client() as client:
        name = resolve_fleet(client, name)
        try:
            reply = client.request(name.agent, Migrate(name.target, to, then, cost, dry_run))
        except NoAnswerError as error:
            if dry_run:
                raise
            hint = f"the migration may still continue: pancakes task migrations {name.agent} shows its outcome"
            raise NoAnswerError(f"{error}\n{hint}") from None
    if reply.result is not None:
        _show_ledger(reply.result, ask.printer)
    if not reply.ok:
        raise ControlRefusedError.of(reply.refusal)


@click.command()
@agents
@asks_agents
def migrations(agents: tuple[str, ...], ask: Ask) -> None:
    """List the newest 100 migrations of each agent, or only of those named: one agent after the other, oldest first.

    Mission time begins again when an agent is restarted (`boot`), so migrations of several agents have no common order.
    They come from the journals of the source agents, and include migrations that failed. In JSON, each has an entry
    for every neighbour that was asked.

    \b
    Example:
        pancakes task migrations
        pancakes task migrations agent1 --format json
    """
    ledgers: list[dict[str, Any]] = [row for _, rows in ask_each(ask, Migrations(), *agents) for row in rows]
    shown = [{**row, "reason": row["reason"] or row["cause"]} for row in ledgers]  # a take-over has only a cause
    ask.printer.emit(ledgers, Rows(shown, MIGRATION_COLUMNS))


@click.command("forget-peer")
@the_agent
@click.argument("peer", metavar="PEER", type=AGENT_NAME)
@yes_option
@dry_run_option
@orders_agents
def forget_peer(agent: str, peer: str, force: bool, dry_run: bool, ask: Ask) -> None:
    """Drop the tasks on AGENT whose hand-off from PEER is in doubt, once PEER is gone.

    A robot that was lost or revoked may leave tasks behind whose hand-off is in doubt. AGENT keeps them, because PEER
    may have committed the hand-off. If PEER is gone for good, first run those that you need with
    `pancakes task recover AGENT/TASK`, then drop the others with this command.

    \b
    Example:
        pancakes task forget-peer agent1 stolen --dry-run
        pancakes task forget-peer agent1 stolen --yes
    """
    with ask.client() as client:
        held = request(client, agent, Checkpoints("")).result
        left = sorted(row["task_id"] for row in held if row["held"] == "in doubt" and row["peer"] == peer)
        if not left:
            raise PancakesError(f"{agent} has no task whose hand-off from {peer} is in doubt")
        what = f"{agent} would drop {', '.join(left)}. If {peer} had committed a hand-off, that task is lost"
        confirm(what, force, dry_run)
        rows = []
        for birthplace, name in (task_id.split("/") for task_id in left):
            body = Forget(name, birthplace, dry_run=dry_run)
            reply = request(client, agent, body)
            done = DRY_RUN if dry_run else "forgotten"
            rows.append({"agent": agent, "task_id": reply.result["task_id"], "done": done, "number": reply.number})
    ask.printer.table(rows, tuple(rows[0]))


def _show_ledger(ledger: Mapping[str, Any], printer: Printer) -> None:
    task_id, source, winner, duration_s = (ledger[key] for key in ("task_id", "source", "winner", "duration_s"))
    story = {
        "moved": f"{task_id} migrated from {source} to {winner}",
        "dry run": f"{task_id} would migrate from {source} to {winner}",
        "stayed": f"{task_id} stays on {source}",
        "undecided": f"{task_id} was migrating from {source} to {winner} when this ledger was closed",
    }[ledger["outcome"]]
    only = f"; only {ledger['to']} was asked" if ledger["to"] else ""
    rows = [{**line, "neighbour": line["peer"], "terms": _terms(line["terms"])} for line in ledger["lines"]]
    printer.emit(
        [ledger],
        f"{story} (cost {ledger['cost']}, {duration_s:.3f} s{only})",
        Rows(rows, ANSWER_COLUMNS) if rows else "",
    )


def _terms(terms: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:g}" for name, value in terms.items())
