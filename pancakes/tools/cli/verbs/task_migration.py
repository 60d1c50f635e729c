"""`pancakes task migrate|migrations|adopt|forget|forget-peer`: migrate tasks, and decide about tasks in doubt."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import click
import msgspec

from pancakes.control import Adopt, Checkpoints, Forget, Migrate, Migrations, Reply
from pancakes.errors import ControlRefusedError, NoAnswerError, PancakesError
from pancakes.tools.cli.agent_requests import ask_each, confirm, force_option, request, request_confirmed, resolve_fleet
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
from pancakes.tools.cli.verbs.task_arguments import birthplace_option, costs, tasks_beside

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
    """List the newest 100 migrations of each agent, or only of those named, oldest first.

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


@click.command()
@a_task
@force_option
@birthplace_option("Where the task was born, if two tasks of this name are in doubt.")
@dry_run_option
@orders_agents
def adopt(name: TaskName, force: bool, birthplace: str, dry_run: bool, ask: Ask) -> None:
    """Run a task on AGENT that does not start because AGENT cannot know whether it runs elsewhere.

    Only you can know that it runs nowhere else. If it does, or if it comes back on an agent that is switched off, two
    copies run. So check first, with `pancakes task list`. The command prints the consequences and asks; if this is not
    a terminal, --force is required.

    If its hand-off to another agent is in doubt, that agent must be gone for good: switch it off, adopt the task, and
    only then set the agent up again with an empty state_dir. Adopting is refused while that agent is connected.

    If AGENT's own record of the task was lost, the task continues from what is readable of the record. Otherwise it
    begins from scratch, as its configuration says. If it runs elsewhere, use `pancakes task forget` instead.

    \b
    Example:
        pancakes task adopt agent1/ScanTarget
        pancakes task adopt agent1/ScanTarget --force
    """
    with ask.client() as client:
        name = resolve_fleet(client, name)
        reply = request_confirmed(
            client, name.agent, lambda forced, dry: Adopt(name.target, forced, birthplace, dry), force, dry_run
        )
    _show_decided(ask, name, reply, DRY_RUN if dry_run else "adopted", instead_of=reply.result["peer"])


@click.command()
@a_task
@birthplace_option("Where the task was born, if the records of two tasks of this name were lost.")
@force_option
@dry_run_option
@orders_agents
def forget(name: TaskName, birthplace: str, force: bool, dry_run: bool, ask: Ask) -> None:
    """Stop AGENT for good from starting a task whose record it has lost, because the task runs elsewhere.

    An agent whose record of a task is damaged cannot know whether it gave the task away. It does not start the task,
    even after a restart, until you decide: `forget` if the task runs elsewhere or is not wanted any more;
    `pancakes task adopt` if it runs nowhere and should run on AGENT.

    A forgotten task can still migrate to AGENT, and `pancakes task adopt` reverses the decision.

    --force also drops a task whose hand-off to AGENT is in doubt because its source agent is gone; see also
    `pancakes task forget-peer`.

    \b
    Example:
        pancakes task forget agent1/ScanTarget --dry-run
        pancakes task forget agent1/ScanTarget --force
    """
    with ask.client() as client:
        body = Forget(name.target, birthplace, force=force)
        if not (force or dry_run):
            request(client, name.agent, msgspec.structs.replace(body, dry_run=True))
        confirm(f"{name} would not start any more, and the state of it on {name.agent} is lost", force, dry_run)
        reply = request(client, name.agent, msgspec.structs.replace(body, dry_run=dry_run))
    _show_decided(ask, name, reply, DRY_RUN if dry_run else "forgotten")


@click.command("forget-peer")
@the_agent
@click.argument("peer", metavar="PEER", type=AGENT_NAME)
@force_option
@dry_run_option
@orders_agents
def forget_peer(agent: str, peer: str, force: bool, dry_run: bool, ask: Ask) -> None:
    """Drop the tasks on AGENT whose hand-off from PEER is in doubt, once PEER is gone.

    A robot that was lost or revoked may leave tasks behind whose hand-off is in doubt. AGENT keeps them, because PEER
    may have committed the hand-off. If PEER is gone for good, first run those that you need on AGENT with
    `pancakes task adopt`, then drop the others with this command.

    \b
    Example:
        pancakes task forget-peer agent1 stolen --dry-run
        pancakes task forget-peer agent1 stolen --force
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
            body = Forget(name, birthplace, dry_run=dry_run, force=True)
            reply = request(client, agent, body)
            done = DRY_RUN if dry_run else "forgotten"
            rows.append({"agent": agent, "task_id": reply.result["task_id"], "done": done, "number": reply.number})
    ask.printer.table(rows, tuple(rows[0]))


def _show_decided(ask: Ask, name: TaskName, reply: Reply, done: str, **others: Any) -> None:
    row = {"agent": name.agent, "task_id": reply.result["task_id"], "done": done, **others, "number": reply.number}
    ask.printer.table([row], tuple(row))


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
