"""`pancakes-agent` as click knows it: all of its options, its help, and what is wrong with a command line."""

from __future__ import annotations

import click

from pancakes import __version__
from pancakes.cli.agent_options import LOWEST_READY_FD, Options
from pancakes.cli.agent_process import run
from pancakes.cli.piped import Piped


@click.command(cls=Piped)
@click.option("--config", "path", metavar="FILE", required=True, help="The agent's configuration, a TOML file.")
@click.option(
    "--set", "sets", metavar="KEY=VALUE", multiple=True, help="Put VALUE in place of what the file says. Repeatable."
)
@click.option(
    "--record",
    metavar="[FILE]",
    is_flag=False,
    flag_value="",
    help="Record what is said on its channels; without FILE, where its configuration says.",
)
@click.option("--traceback", is_flag=True, help="Show a failure of a task with its whole traceback.")
@click.option("--check", is_flag=True, help="Only check the configuration and the plug-ins; run nothing.")
@click.option(
    "--die-with-parent",
    "parent_pid",
    metavar="[PID]",
    type=click.IntRange(min=0),
    is_flag=False,
    flag_value=0,
    help="Stop when the process that launched this one ends; PID says which that was.",
)
@click.option(
    "--ready-fd",
    metavar="FD",
    type=click.IntRange(min=LOWEST_READY_FD),
    help="Write a line to this file descriptor, and close it, once all that is to run at the start does.",
)
@click.version_option(__version__, prog_name="pancakes-agent")
def agent(
    path: str,
    sets: tuple[str, ...],
    record: str | None,
    traceback: bool,
    check: bool,
    parent_pid: int | None,
    ready_fd: int | None,
) -> None:
    """Run an agent.

    SIGINT or SIGTERM stops it in good order; the same signal a second time ends it at once.
    The exit code is 0 where it was stopped, 1 where it cannot run, 4 where its configuration is bad.

    \b
    Example:
        pancakes-agent --config configs/single.toml --set clock.speed=5
    """
    run(Options(path, sets, record, check, parent_pid, ready_fd, traceback))
