"""`pancakes service ...`: list, show, start, stop and restart the services of agents."""

from __future__ import annotations

from typing import Any, Final

import click

from pancakes.control import Restart, Start, Stop
from pancakes.errors import ControlRefusedError
from pancakes.supervision.restart import tries
from pancakes.tools.cli.agent_requests import confirm, request, show_done, survey, yes_option
from pancakes.tools.cli.help_sections import SectionedGroup
from pancakes.tools.cli.options import (
    Ask,
    Duration,
    ServiceName,
    a_service,
    agents,
    asks_agents,
    dry_run_option,
    keep_state_option,
    orders_agents,
)
from pancakes.util.text import hint_of

COLUMNS = ("agent", "service", "type", "state", "tasks", "reason")
TASKS = ("task", "type", "state", "rate_hz", "reason")
STATES = ("stopped", "starting", "running", "stopping", "restarting", "failed")
"""The words of `pancakes.supervision.lifecycle` for services. Importing that module would slow each command."""


SECTIONS: Final = {
    "Commands": {
        "list": "List services, and whether they run.",
        "info": "Show a service and its tasks.",
        "start": "Start a stopped service and its tasks.",
        "stop": "Stop a service and its tasks.",
        "restart": "Stop a service and start it again.",
    },
}


@click.group(cls=SectionedGroup, sections=SECTIONS)
def service() -> None:
    """Show and control the services of agents."""


@service.command("list")
@agents
@click.option("--state", type=click.Choice(STATES), help="Only services in this state.")
@asks_agents
def list_(agents: tuple[str, ...], state: str | None, ask: Ask) -> None:
    """List the services of all agents, or only of those named.

    An agent that does not answer in time is named on standard error; the exit code is 3 if none answers.

    \b
    Example:
        pancakes service list
        pancakes service list agent1 --state failed --format json
    """
    found = survey(ask, *agents)
    rows = [row for agent in found for row in agent["services"] if state in (None, row["state"])]
    ask.printer.table(rows, COLUMNS)


@service.command()
@a_service
@asks_agents
def info(name: ServiceName, ask: Ask) -> None:
    """Show a service and its tasks.

    \b
    Example:
        pancakes service info agent1/device
    """
    (agent,) = survey(ask, name.agent)
    rows = {row["service"]: row for row in agent["services"]}
    if name.service not in rows:
        hint = hint_of(name.service, list(rows))
        raise ControlRefusedError(f"{name.agent} has no service {name.service!r}{hint}")
    tasks = [row for row in agent["tasks"] if row["service"] == name.service]
    found: dict[str, Any] = {**rows[name.service], "tasks": tasks}
    facts = {**{key: found[key] for key in ("type", "state", "reason")}, "tries": tries(found)}
    rows_of_tasks = [
        {**{key: row[key] for key in TASKS}, "state": row["rest"] or row["state"], "tries": tries(row)} for row in tasks
    ]
    ask.printer.emit([found], {str(name): facts, "tasks": rows_of_tasks})


@service.command()
@a_service
@dry_run_option
@orders_agents
def start(name: ServiceName, dry_run: bool, ask: Ask) -> None:
    """Start a stopped service, and wait until it and its tasks run.

    \b
    Example:
        pancakes service start agent1/client
    """
    _order(ask, name, "started", Start(name.target, dry_run=dry_run))


@service.command()
@a_service
@click.option(
    "--for", "for_s", metavar="TIME", type=Duration(), help="Start it again after this mission time, such as 30s."
)
@dry_run_option
@orders_agents
def stop(name: ServiceName, for_s: float | None, dry_run: bool, ask: Ask) -> None:
    """Stop a service and all of its tasks, and wait until they have stopped.

    The Network Service of another agent can be stopped only with --for, because no command could reach the agent to
    start the service again.

    \b
    Example:
        pancakes service stop agent1/client
        pancakes service stop agent1/network --for 30s
    """
    _order(ask, name, "stopped", Stop(name.target, for_s, dry_run), for_s=for_s)


@service.command()
@a_service
@keep_state_option("Keep the state and settings of its tasks, or begin from scratch as their configuration says.")
@yes_option
@dry_run_option
@orders_agents
def restart(name: ServiceName, keep_state: bool, force: bool, dry_run: bool, ask: Ask) -> None:
    """Stop a service and all of its tasks, start it, and wait until it runs.

    With --drop-state it asks first; if this is not a terminal, --yes is required.

    \b
    Example:
        pancakes service restart agent1/device
        pancakes service restart agent1/client --drop-state --yes
    """
    with ask.client() as client:
        if not (keep_state or force or dry_run):
            request(client, name.agent, Restart(name.target, keep_state, dry_run=True))
            confirm(f"all tasks of {name} would begin from scratch: their state is lost", force)
        show_done(ask, client, name, "restarted", Restart(name.target, keep_state, dry_run))


def _order(ask: Ask, name: ServiceName, done: str, body: Start | Stop, **others: Any) -> None:
    """Send a control packet about a service, and print that it was done."""
    with ask.client() as client:
        show_done(ask, client, name, done, body, **others)
