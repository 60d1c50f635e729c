"""`pancakes task migrate|migrations|adopt|forget|forget-peer`: tasks that migrate, have migrated, or are in doubt."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import click
import msgspec

from pancakes.control import Adopt, Checkpoints, Forget, Migrate, Migrations, Reply
from pancakes.errors import ControlRefused, NoAnswer, PancakesError
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
from pancakes.tools.cli.verbs.task_arguments import costs, tasks_beside

_F = TypeVar("_F", bound=Callable[..., Any])

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


def _birthplace_option(help_: str) -> Callable[[_F], _F]:
    return click.option("--birthplace", metavar="AGENT", type=AGENT_NAME, default="", help=help_)


@click.command()
@a_task
@click.option("--to", metavar="AGENT", type=AGENT_NAME, default="", help="Ask only this neighbour.")
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
@click.option("--dry-run", is_flag=True, help="Only ask which agents would take it, and for what cost; move nothing.")
@asks_agents_for(30.0)
def migrate(name: TaskName, to: str, then: str, cost: str, dry_run: bool, ask: Ask) -> None:
    """Move a running task to the neighbour that takes it for the lowest cost, and wait until it runs there.

    Shows which agents were asked, what each answered, and why the others did not get it. The exit code is 1 if no
    agent takes it; the task has then never stopped.

    \b
    Example:
        pancakes task migrate agent1/ScanTarget --dry-run
        pancakes task migrate agent1/ScanTarget --to agent2 --then GoHome
    """
    with ask.client() as client:
        name = resolve_fleet(client, name)
        try:
            reply = client.request(name.agent, Migrate(name.target, to, then, cost, dry_run))
        except NoAnswer as error:
            if dry_run:
                raise
            hint = f"the move may go on all the same, pancakes task migrations {name.agent} shows what becomes of it"
            raise NoAnswer(f"{error}\n{hint}") from None
    if reply.result is not None:
        _show_ledger(reply.result, ask.printer)
    if not reply.ok:
        raise ControlRefused.of(reply.refusal)


@click.command()
@agents
@asks_agents
def migrations(agents: tuple[str, ...], ask: Ask) -> None:
    """List the moves that all agents, or those that are named, were asked for: the newest 100 of each, oldest first.

    They come from the journals of the agents that the tasks were to leave. As JSON, each has a line for every
    neighbour that was asked.

    \b
    Example:
        pancakes task migrations
        pancakes task migrations agent1 --format json
    """
    moves: list[dict[str, Any]] = [move for _, moves in ask_each(ask, Migrations(), *agents) for move in moves]
    told = [{**move, "reason": move["reason"] or move["cause"]} for move in moves]  # of a take-over, its cause
    ask.printer.emit(moves, Rows(told, MOVES))


@click.command()
@a_task
@force_option
@_birthplace_option("Where it was born, if two of its name are in doubt.")
@dry_run_option
@orders_agents
def adopt(name: TaskName, force: bool, birthplace: str, dry_run: bool, ask: Ask) -> None:
    """Run a task on AGENT that rests there because AGENT cannot know where it is. You know: it runs nowhere else.

    This is the one act that can make two of a task: if it runs elsewhere after all, or comes back on an agent that
    is off. So see first, with `pancakes task list`, that it runs nowhere. It is said what it would mean, and asked; if
    this is no terminal, nothing is done without --force, and the exit code is 1.

    Where its hand-off to another agent is in doubt, that agent must be gone for good: switch it off, adopt, and only
    then set it up again, with an empty state_dir. It is refused while the other agent is connected.

    Where AGENT's own record of it was lost, it goes on from what can be read of that, or else begins as its
    configuration says, without its state. If it does run elsewhere, see `pancakes task forget`.

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
@_birthplace_option("Where it was born, if the records of two of its name were lost.")
@force_option
@dry_run_option
@orders_agents
def forget(name: TaskName, birthplace: str, force: bool, dry_run: bool, ask: Ask) -> None:
    """Let a task rest on AGENT for good, because it runs elsewhere, and AGENT has lost its record of it.

    An agent whose record of a task is damaged cannot know whether it gave the task away. It does not start it, however
    often it is started itself, until you decide: `forget` where the task runs elsewhere, or is not wanted any more;
    `pancakes task adopt` if it runs nowhere, and shall run on AGENT.

    What was forgotten can still be moved to AGENT, and `pancakes task adopt` takes the decision back.

    A task that another agent has brought, which is gone now and does not say whether it gave the task away, is dropped
    with --force; see also `pancakes task forget-peer`.

    \b
    Example:
        pancakes task forget agent1/ScanTarget --dry-run
        pancakes task forget agent1/ScanTarget --force
    """
    with ask.client() as client:
        body = Forget(name.target, birthplace, force=force)
        if not (force or dry_run):
            request(client, name.agent, msgspec.structs.replace(body, dry_run=True))
        confirm(f"{name} rests for good, and what {name.agent} has of its state is lost", force, dry_run)
        reply = request(client, name.agent, msgspec.structs.replace(body, dry_run=dry_run))
    _show_decided(ask, name, reply, DRY_RUN if dry_run else "forgotten")


@click.command("forget-peer")
@the_agent
@click.argument("peer", metavar="PEER", type=AGENT_NAME)
@force_option
@dry_run_option
@orders_agents
def forget_peer(agent: str, peer: str, force: bool, dry_run: bool, ask: Ask) -> None:
    """Drop the tasks that PEER has brought to AGENT and never handed over, once PEER is gone.

    A robot that is lost, or was revoked, may leave tasks behind whose hand-off is in doubt. AGENT keeps them, for PEER
    may have given them away. If PEER is gone for good, `pancakes task adopt` runs one of them on AGENT, and this drops
    those that are left.

    \b
    Example:
        pancakes task forget-peer agent1 stolen --dry-run
        pancakes task forget-peer agent1 stolen --force
    """
    with ask.client() as client:
        held = request(client, agent, Checkpoints("")).result
        left = sorted(row["task_id"] for row in held if row["held"] == "in doubt" and row["peer"] == peer)
        if not left:
            raise PancakesError(f"{agent} keeps no task that {peer} has brought and not handed over")
        what = f"{agent} would drop {', '.join(left)}. Each is nowhere else if {peer} had given it away"
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
        "moved": f"{task_id} moved from {source} to {winner}",
        "dry run": f"{task_id} would move from {source} to {winner}",
        "stayed": f"{task_id} stays on {source}",
        "undecided": f"{task_id} was on its way from {source} to {winner} when this account was closed",
    }[ledger["outcome"]]
    only = f"; only {ledger['to']} was asked" if ledger["to"] else ""
    rows = [{**line, "neighbour": line["peer"], "terms": _terms(line["terms"])} for line in ledger["lines"]]
    printer.emit(
        [ledger],
        f"{story} (cost {ledger['cost']}, {duration_s:.3f} s{only})",
        Rows(rows, LINES) if rows else "",
    )


def _terms(terms: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:g}" for name, value in terms.items())
