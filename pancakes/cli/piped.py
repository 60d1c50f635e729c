"""Commands whose help somebody may stop reading: `pancakes --help | head -1`."""

from __future__ import annotations

from typing import Any

import click

from pancakes.cli.errors import end_unread


class Piped(click.Command):
    """A click command that ends as all verbs do where nobody reads what click itself says; click would end it with 1.

    A group of this class ends so for its commands, too.
    """

    def make_context(self, *args: Any, **more: Any) -> click.Context:
        try:
            return super().make_context(*args, **more)
        except BrokenPipeError:
            end_unread()

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except BrokenPipeError:
            end_unread()
