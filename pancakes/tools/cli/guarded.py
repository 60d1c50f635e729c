"""Commands that end as all of ours do: with a sentence and an exit code where click would show a traceback."""

from __future__ import annotations

from typing import Any

import click

from pancakes.tools.cli.exit_codes import sentences


class Guarded(click.Command):
    """A click command whose errors become sentences, also where the reader of its output ends early (`| head -1`).

    A group of this class does so for its commands, too.
    """

    def make_context(self, *args: Any, **more: Any) -> click.Context:
        with sentences():
            return super().make_context(*args, **more)

    def invoke(self, ctx: click.Context) -> Any:
        with sentences():
            return super().invoke(ctx)
