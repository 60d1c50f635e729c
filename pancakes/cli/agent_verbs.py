"""`pancakes agent ...`: the agents themselves."""

from __future__ import annotations

import click

from pancakes.cli.asking import survey
from pancakes.cli.errors import sentences
from pancakes.cli.options import asks_agents
from pancakes.cli.output import show

COLUMNS = ("agent", "role", "fleet", "address", "ready", "mission_s", "tasks", "neighbours")


@click.group()
def agent() -> None:
    """Agents that run."""


@agent.command("list")
@asks_agents
@sentences
def list_(format_: str, at: tuple[str, ...], timeout: float) -> None:
    """List the agents that run.

    Who does not answer in time is named on standard error; the exit code is 3 where nobody answers.

    \b
    Example:
        pancakes agent list
        pancakes agent list --at 192.168.1.20:7401 --format json
    """
    rows = [
        {
            "agent": found["agent"],
            "role": found["role"],
            "fleet": found["fleet"],
            "address": found["listen"],
            "ready": found["ready"],
            "mission_s": round(found["mission_s"], 3),
            "tasks": len(found["tasks"]),
            "neighbours": found["neighbours"],
        }
        for found in survey(at, timeout)
    ]
    show(rows, COLUMNS, format_)
