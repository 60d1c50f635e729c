"""`pancakes new ...`: create a distribution from a template."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from pancakes.tools.cli.options import format_option
from pancakes.tools.cli.output import Printer, Rows

if TYPE_CHECKING:
    from pancakes.tools.cli.verbs.scaffold import Names

COLUMNS = ("file", "purpose")
_ABOUT: Final = {
    "task": (
        "Create a task: it watches how busy this computer is, and publishes changes.",
        "Create a task.",
        "pancakes new task ScanTarget",
    ),
    "driver": (
        "Create a driver: a sensor that reads a file, with its own packet type.",
        "Create a driver.",
        "pancakes new driver wind-speed --into ..",
    ),
    "service": (
        "Create a service: it counts the packets of each publisher, with its own task and channel.",
        "Create a service.",
        "pancakes new service bookkeeping",
    ),
    "filter": (
        "Create a filter of an actuator: a drive is slow while the robot's computer is busy.",
        "Create a filter of an actuator.",
        "pancakes new filter careful-drive",
    ),
    "cost": (
        "Create a cost function: the agent with the least busy computer takes the task.",
        "Create a cost function for migrations.",
        "pancakes new cost calm",
    ),
    "world": (
        "Create a simulated world: robots on a rail, where the calls of your own simulator belong.",
        "Create a simulated world.",
        "pancakes new world flat-land",
    ),
    "plugin": (
        "Create a plug-in: a driver, a task, a service and packet types that work together, and two agents.",
        "Create a plug-in with a task, a driver, a service and packets.",
        "pancakes new plugin greenhouse",
    ),
}
"""For each kind: what its command does, its line in the list of commands, and an example."""


class DistributionName(click.ParamType):
    """Read the name of a new distribution."""

    name = "NAME"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Names:
        from pancakes.tools.cli.verbs.scaffold import Names

        if isinstance(value, Names):
            return value
        try:
            return Names.of(str(value))
        except ValueError as error:
            self.fail(str(error), param, ctx)


@click.group()
def new() -> None:
    """Create a package for your own task, driver, service, filter, cost function, world or plug-in.

    Each command writes a working distribution: with entry points, tests that pass, a configuration that runs it, and a
    README. Start from there.
    """


def _command(kind: str) -> click.Command:
    about, short, example = _ABOUT[kind]

    @click.command(kind, short_help=short)
    @click.argument("name", metavar="NAME", type=DistributionName())
    @click.option(
        "--into",
        type=click.Path(exists=True, file_okay=False, writable=True, path_type=Path),
        default=".",
        metavar="DIR",
        help="The folder in which to create the distribution's folder. [default: the present one]",
    )
    @click.option("--dry-run", is_flag=True, help="Only list what would be written.")
    @format_option
    def command(name: Names, into: Path, dry_run: bool, printer: Printer) -> None:
        _make(kind, name, into, dry_run, printer)

    command.help = f"""{about}

    You may write NAME as scan_target, scan-target or ScanTarget. The distribution and its folder are then called
    scan-target, the package scan_target, and the class ScanTarget.

    \b
    Example:
        {example}
        {example} --dry-run
    """
    return command


for _kind in _ABOUT:
    new.add_command(_command(_kind))


def _make(kind: str, names: Names, into: Path, dry_run: bool, printer: Printer) -> None:
    from pancakes.errors import PancakesError
    from pancakes.tools.cli.verbs.scaffold import check_free, files_of, write

    folder = into / names.dist
    check_free(folder)
    conflict = names.conflict(kind)
    if conflict:
        raise PancakesError(f"{conflict}: choose another name than {names.package}")
    files = files_of(kind, names)
    if not dry_run:
        write(folder, files)
    rows = [{"file": str(folder / file.path), "purpose": file.purpose, "written": not dry_run} for file in files]
    steps = "".join(f"    {line}\n" for line in _next(kind, names, folder))
    printer.emit(rows, Rows(rows, COLUMNS), "Nothing was written." if dry_run else f"Next:\n\n{steps}")


def _next(kind: str, names: Names, folder: Path) -> list[str]:
    """Return the commands that the user runs next."""
    run = "pancakes up configs" if kind == "plugin" else f"pancakes-agent --config configs/{names.package}.toml"
    return [f"cd {shlex.quote(os.path.relpath(folder))}", 'pip install -e ".[test]"', "pytest", run]
