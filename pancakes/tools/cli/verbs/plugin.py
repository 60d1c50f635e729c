"""`pancakes plugin ...`: list the plug-ins that are installed for agents."""

from __future__ import annotations

import sys
from typing import Any, Final

import click

from pancakes.errors import PluginError
from pancakes.tools.cli.exit_codes import OK, REFUSED
from pancakes.tools.cli.help_sections import SectionedGroup
from pancakes.tools.cli.options import format_option
from pancakes.tools.cli.output import Printer, show_text
from pancakes.util.plugins import GROUPS, Plugins

COLUMNS = ("group", "name", "class", "distribution", "version", "state", "reason")
NAMES = tuple(group.removeprefix("pancakes.") for group in GROUPS)


SECTIONS: Final = {
    "Commands": {
        "list": "List installed plug-ins, and what they bring.",
    },
}


@click.group(cls=SectionedGroup, sections=SECTIONS)
def plugin() -> None:
    """List the plug-ins that are installed for agents."""


@plugin.command("list")
@click.option("--group", type=click.Choice(NAMES), multiple=True, help="Only plug-ins of this group. Repeatable.")
@click.option("--broken", is_flag=True, help="Only plug-ins that cannot be used.")
@format_option
def list_(group: tuple[str, ...], broken: bool, printer: Printer) -> None:
    """List all plug-ins of this Python environment, with their distributions and whether they can be used.

    It imports all of them. The exit code is 1 if one is broken.

    \b
    Example:
        pancakes plugin list
        pancakes plugin list --group drivers --format json
    """
    plugins = Plugins()
    rows = [row for name in group or NAMES for row in rows_of(plugins, f"pancakes.{name}")]
    for problem in plugins.unreadable():
        show_text(str(problem), err=True)
    failed = bool(plugins.unreadable()) or any(row["state"] == "broken" for row in rows)
    printer.table([row for row in rows if row["state"] == "broken" or not broken], COLUMNS)
    sys.exit(REFUSED if failed else OK)


def rows_of(plugins: Plugins, group: str) -> list[dict[str, Any]]:
    """Import the plug-ins of a group, and return a row for each.

    Args:
        plugins: all plug-ins.
        group: the entry point group, such as `pancakes.tasks`.
    """
    rows = []
    for offered in plugins.offered(group):
        reason = ""
        try:
            plugins.get(group, offered.name)
        except PluginError as error:
            reason = str(error)
        rows.append(
            {
                "group": group.removeprefix("pancakes."),
                "name": offered.name,
                "class": offered.place,
                "distribution": offered.version.distribution,
                "version": offered.version.version,
                "state": "broken" if reason else "ok",
                "reason": reason,
            }
        )
    return rows
