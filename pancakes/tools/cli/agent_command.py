"""`pancakes-agent`: run one agent from its configuration file until it is asked to stop."""

from __future__ import annotations

from typing import Final

import click

from pancakes.tools.cli.exit_codes import Guarded
from pancakes.tools.cli.help_sections import HELP_OPTIONS
from pancakes.tools.cli.version import version_option
from pancakes.util.docstring import docstring_of

LOWEST_READY_FD: Final = 3
"""The descriptors below it are the standard streams."""


@click.command(cls=Guarded, context_settings=HELP_OPTIONS)
@click.option("--config", "path", metavar="FILE", required=True, help="The agent's configuration, a TOML file.")
@click.option(
    "--set", "sets", metavar="KEY=VALUE", multiple=True, help="Override a key of the file with VALUE. Repeatable."
)
@click.option(
    "--record",
    metavar="[FILE]",
    is_flag=False,
    flag_value="",
    help="Record the packets on its channels, to FILE or to the path that its configuration names.",
)
@click.option("--traceback", is_flag=True, help="Log the whole traceback when a task fails.")
@click.option("--check", is_flag=True, help="Check the configuration and the plug-ins, then exit.")
@click.option(
    "--die-with-parent",
    "parent_pid",
    metavar="[PID]",
    type=click.IntRange(min=0),
    is_flag=False,
    flag_value=0,
    help="Stop when the process that launched this one, PID, ends.",
)
@click.option(
    "--ready-fd",
    metavar="FD",
    type=click.IntRange(min=LOWEST_READY_FD),
    help="Write a line to this file descriptor and close it when all tasks that start with the agent run.",
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

    SIGINT or SIGTERM stops the agent gracefully; a second one ends it at once. SIGHUP does the same if standard input
    is a terminal. Otherwise SIGHUP reopens the log file and the recording if they were moved (log rotation).
    The exit code is 0 if it was stopped, 1 if it cannot run, 4 if its configuration is bad.

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


def run_verb() -> click.Command:
    """Return the same program as a verb, `pancakes agent run FILE`."""
    own: list[click.Parameter] = [it for it in agent.params if it.name not in ("path", "version", "help")]
    example = "pancakes agent run configs/single.toml --set clock.speed=5"
    assert agent.callback is not None
    return Guarded(
        "run",
        callback=agent.callback,
        params=[click.Argument(["path"], metavar="FILE", type=click.Path()), *own],
        help=docstring_of(agent.callback).replace(
            "pancakes-agent --config configs/single.toml --set clock.speed=5", example
        ),
    )


if __name__ == "__main__":
    from pancakes.tools.cli import quiet_interrupt  # noqa: F401 - a SIGINT ends it quietly

    agent()
