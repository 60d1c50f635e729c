"""`pancakes-agent`: runs one agent from its configuration file, until it is told to stop."""

from __future__ import annotations

from typing import Final

import click

from pancakes.tools.cli.exit_codes import Guarded
from pancakes.tools.cli.version import version_option

LOWEST_READY_FD: Final = 3
"""Those below are the standard streams."""


@click.command(cls=Guarded)
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
    help="Write a line to this file descriptor, and close it, once all tasks that run from the start do.",
)
@version_option("pancakes-agent")
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

    SIGINT or SIGTERM stops it in good order; the same signal a second time ends it at once. SIGHUP does the same if its
    standard input is a terminal; else the agent begins its log file and its recording again if they were moved, and
    goes on.
    The exit code is 0 if it was stopped, 1 if it cannot run, 4 where its configuration is bad.

    \b
    Example:
        pancakes-agent --config configs/single.toml --set clock.speed=5
    """
    from pancakes.tools.cli.agent_process import SHOW_TRACEBACKS, run

    if record is not None:
        from pancakes.config.toml_writer import value_text

        path_set = [f"record.path={value_text(record)}"] if record else []
        sets = (*sets, "record.start=true", *path_set)
    if traceback:
        sets = (*sets, SHOW_TRACEBACKS)
    run(path, sets, check, parent_pid, ready_fd)


if __name__ == "__main__":
    from pancakes.tools.cli import quiet_interrupt  # noqa: F401 - a SIGINT ends it quietly

    agent()
