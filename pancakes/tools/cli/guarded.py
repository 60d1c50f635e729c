"""Commands that end as all of ours do: with a sentence and an exit code where click would show a traceback."""

from __future__ import annotations

import inspect
import sys
from typing import Any

import click

from pancakes.runtime.foundation.docstring import docstring_of
from pancakes.tools.cli.exit_codes import sentences


def with_help(command: click.Command) -> click.Command:
    """Gives a command, and those of a group, the help that click takes from docstrings: `python -OO` has none."""
    if sys.flags.optimize >= 2:
        if not command.help and command.callback is not None:
            command.help = docstring_of(inspect.unwrap(command.callback)) or None
        for inner in command.commands.values() if isinstance(command, click.Group) else ():
            with_help(inner)
    return command


class Guarded(click.Command):
    """A click command whose errors become sentences, also where the reader of its output ends early (`| head -1`).

    A group of this class does so for its commands, too.
    """

    def make_context(self, *args: Any, **more: Any) -> click.Context:
        with_help(self)
        with sentences():
            return super().make_context(*args, **more)

    def invoke(self, ctx: click.Context) -> Any:
        with sentences():
            return super().invoke(ctx)
