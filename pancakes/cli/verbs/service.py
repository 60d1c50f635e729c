"""`pancakes service ...`: the services of agents."""

from __future__ import annotations

from typing import Any

import click

from pancakes.cli.asking import accepted, survey
from pancakes.cli.names import ServiceName, a_service, agents
from pancakes.cli.options import Duration, asks_agents, dry_run_option, orders_agents
from pancakes.cli.output import DRY_RUN, show, show_json, show_sections
from pancakes.client import Client, Where
from pancakes.control import Restart, Start, Stop
from pancakes.errors import ControlRefused
from pancakes.suggestion import suggestion
from pancakes.supervision import tries

COLUMNS = ("agent", "service", "type", "state", "tasks", "reason")
DONE = ("agent", "service", "done", "number")
TASKS = ("task", "type", "state", "rate_hz", "reason")
STATES = ("stopped", "starting", "running", "stopping", "restarting", "failed")
"""The values of `pancakes.services.root.ServiceState`, which is not imported for them: a command has to be quick."""


@click.group()
def service() -> None:
    """Services that agents have."""


@service.command("list")
@agents
@click.option("--state", type=click.Choice(STATES), help="Only those in this state.")
@asks_agents
def list_(agents: tuple[str, ...], state: str | None, format_: str, at: Where, timeout: float) -> None:
    """List the services of all agents, or of those that are named.

    Who does not answer in time is named on standard error; the exit code is 3 where nobody answers.

    \b
    Example:
        pancakes service list
        pancakes service list agent1 --state failed --format json
    """
    found = survey(at, timeout, *agents)
    rows = [row for agent in found for row in agent["services"] if state in (None, row["state"])]
    show(rows, COLUMNS, format_)


@service.command()
@a_service
@asks_agents
def info(name: ServiceName, format_: str, at: Where, timeout: float) -> None:
    """Show a service and its tasks.

    \b
    Example:
        pancakes service info agent1/device
    """
    (agent,) = survey(at, timeout, name.agent)
    rows = {row["service"]: row for row in agent["services"]}
    if name.service not in rows:
        meant = suggestion(name.service, rows)
        hint = f", did you mean {meant!r}?" if meant else f", only {', '.join(rows)}"
        raise ControlRefused(f"{name.agent} has no service {name.service!r}{hint}")
    tasks = [row for row in agent["tasks"] if row["service"] == name.service]
    found: dict[str, Any] = {**rows[name.service], "tasks": tasks}
    if format_ == "json":
        show_json([found])
        return
    facts = {**{key: found[key] for key in ("type", "state", "reason")}, "tries": tries(found)}
    rows_of_tasks = [
        {**{key: row[key] for key in TASKS}, "state": row["rest"] or row["state"], "tries": tries(row)} for row in tasks
    ]
    show_sections({str(name): facts, "tasks": rows_of_tasks})


@service.command()
@a_service
@dry_run_option
@orders_agents
def start(name: ServiceName, dry_run: bool, format_: str, at: Where, timeout: float) -> None:
    """Start a service that stands still, and wait until it and its tasks run.

    \b
    Example:
        pancakes service start agent1/client
    """
    _ask(name, Start(name.target, dry_run=dry_run), "started", format_, at, timeout)


@service.command()
@a_service
@click.option(
    "--for", "for_s", metavar="TIME", type=Duration(), help="It starts again by itself after this mission time: 30s."
)
@dry_run_option
@orders_agents
def stop(name: ServiceName, for_s: float | None, dry_run: bool, format_: str, at: Where, timeout: float) -> None:
    """Stop a service and all of its tasks, and wait for that.

    The Network Service of another agent can be stopped for a time only: nobody could start it again.

    \b
    Example:
        pancakes service stop agent1/client
        pancakes service stop agent1/network --for 30s
    """
    _ask(name, Stop(name.target, for_s, dry_run), "stopped", format_, at, timeout, for_s=for_s)


@service.command()
@a_service
@click.option(
    "--keep-state/--drop-state",
    default=True,
    show_default=True,
    help="Whether its tasks go on with their state and settings, or begin as their configuration says.",
)
@dry_run_option
@orders_agents
def restart(name: ServiceName, keep_state: bool, dry_run: bool, format_: str, at: Where, timeout: float) -> None:
    """Stop a service and all of its tasks, start it, and wait until it runs.

    \b
    Example:
        pancakes service restart agent1/device
        pancakes service restart agent1/client --drop-state
    """
    _ask(name, Restart(name.target, keep_state, dry_run), "restarted", format_, at, timeout)


def _ask(
    name: ServiceName,
    body: Start | Stop | Restart,
    done: str,
    format_: str,
    at: Where,
    timeout: float,
    **others: Any,
) -> None:
    """Has an agent do something with a service, and shows that it was done."""
    with Client(at, timeout) as client:
        number = accepted(client, name.agent, body).number
    row = {**name._asdict(), "done": DRY_RUN if body.dry_run else done, "number": number, **others}
    show([row], (*DONE, *others), format_)
