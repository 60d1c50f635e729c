"""`pancakes`: speaks to running agents, and runs demos."""

from __future__ import annotations

import click

from pancakes import __version__
from pancakes.cli.errors import sentences
from pancakes.cli.lazy import Later, LazyGroup

COMMANDS = {
    "agent": Later("pancakes.cli.agent_verbs:agent", "Agents that run."),
    "task": Later("pancakes.cli.task_verbs:task", "Tasks that agents have."),
    "service": Later("pancakes.cli.service_verbs:service", "Services that agents have."),
    "demo": Later("pancakes.cli.demo:demo", "Run a whole mission, and judge it."),
}


@click.group(cls=LazyGroup, later=COMMANDS)
@click.version_option(__version__, prog_name="pancakes")
def pancakes() -> None:
    """Robots and sensor nodes that work as one.

    It finds the agents of this machine by itself, others with --at HOST:PORT, and the rest of the fleet through any
    one of them. To run an agent: pancakes-agent.

    Exit codes: 0 ok, 1 refused, 2 usage, 3 unreachable, 4 bad configuration.
    """


@sentences
def main() -> None:
    """The console script."""
    pancakes()


if __name__ == "__main__":
    main()
