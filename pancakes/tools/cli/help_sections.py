"""Group the verbs in the help of a command by what a person wants to do, each with one whole line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import click

Sections = Mapping[str, Mapping[str, str]]
"""The titles of sections, and in each the names of verbs with their lines."""

HELP_OPTIONS = {"help_option_names": ["-h", "--help"]}
"""For the programs themselves; all of their verbs take it from there."""


def write_sections(formatter: click.HelpFormatter, sections: Sections) -> None:
    """Write the verbs of a group, with their lines in one column."""
    width = max((len(name) for verbs in sections.values() for name in verbs), default=0)
    for title, verbs in sections.items():
        if verbs:
            with formatter.section(title):
                formatter.write_dl([(name.ljust(width), line) for name, line in verbs.items()])


class SectionedGroup(click.Group):
    """A group of verbs whose help has sections.

    Args:
        sections: all of its verbs.
        attributes: see `click.Group`.
    """

    def __init__(self, *args: Any, sections: Sections, **attributes: Any) -> None:
        super().__init__(*args, **{"context_settings": HELP_OPTIONS, **attributes})
        self.sections = sections

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [name for verbs in self.sections.values() for name in verbs]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        write_sections(formatter, self.sections)
