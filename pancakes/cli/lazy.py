"""A group of commands that imports a command only when it is used, so that the others start fast."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import click
from click.shell_completion import CompletionItem

from pancakes.cli.guarded import Guarded
from pancakes.suggestion import suggestion


@dataclass(frozen=True, slots=True)
class Later:
    """A command that is not imported yet.

    Attributes:
        place: `module:name`.
        help: its line in the help of the group.
    """

    place: str
    help: str


class LazyGroup(Guarded, click.Group):
    """A click group whose commands are imported late.

    Args:
        later: its commands, by name.
        attributes: see `click.Group`.
    """

    def __init__(self, *args: Any, later: Mapping[str, Later], **attributes: Any) -> None:
        super().__init__(*args, **attributes)
        self._later = dict(later)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self._later)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        later = self._later.get(cmd_name)
        if later is None:
            return None
        module, _, name = later.place.partition(":")
        command = getattr(import_module(module), name)
        assert isinstance(command, click.Command)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        if name not in self._later and not name.startswith("-") and not ctx.resilient_parsing:
            meant = suggestion(name, self._later)
            ctx.fail(f"No such command {name!r}." + (f" Did you mean {meant!r}?" if meant else ""))
        return super().resolve_command(ctx, args)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Completes the names of the commands, without importing them."""
        names = [
            CompletionItem(name, help=later.help) for name, later in self._later.items() if name.startswith(incomplete)
        ]
        return names + click.Command.shell_complete(self, ctx, incomplete)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, later.help) for name, later in self._later.items()])
