"""`pancakes task ...`: the tasks of agents."""

from __future__ import annotations

import click

from pancakes.cli.asking import survey
from pancakes.cli.errors import sentences
from pancakes.cli.options import asks_agents
from pancakes.cli.output import show

COLUMNS = ("agent", "service", "task", "type", "state", "rate_hz")


@click.group()
def task() -> None:
    """Tasks that agents have."""


@task.command("list")
@click.argument("agent", default="")
@asks_agents
@sentences
def list_(agent: str, format_: str, at: tuple[str, ...], timeout: float) -> None:
    """List the tasks of all agents, or of AGENT.

    Who does not answer in time is named on standard error; the exit code is 3 where nobody answers.

    \b
    Example:
        pancakes task list
        pancakes task list agent1 --format json
    """
    show([row for found in survey(at, timeout, agent) for row in found["tasks"]], COLUMNS, format_)
