"""A group of commands that imports a command only when it is used, so that the others start fast.

Other distributions add commands by entry point (`pancakes.commands`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Final

import click
from click.shell_completion import CompletionItem

from pancakes.runtime.foundation.suggestion import suggestion
from pancakes.tools.cli.guarded import Guarded, with_help

GROUP: Final = "pancakes.commands"
"""The entry point group of commands that other distributions add: each names a click command."""


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
        later: its own commands, by name; no installed command takes the name of one.
        attributes: see `click.Group`.
    """

    def __init__(self, *args: Any, later: Mapping[str, Later], **attributes: Any) -> None:
        super().__init__(*args, **attributes)
        self._own = dict(later)

    @cached_property
    def _later(self) -> dict[str, Later]:
        """All commands: its own, and after them those of other distributions. Imports none."""
        installed = {
            point.name: Later(point.value, f"From {point.dist.name}." if point.dist is not None else "")
            for point in sorted(entry_points(group=GROUP), key=lambda point: point.name)
        }
        return {**self._own, **{name: later for name, later in installed.items() if name not in self._own}}

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self._later)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        later = self._own.get(cmd_name)
        if later is None:
            return with_help(_installed(cmd_name)) if cmd_name in self._later else None
        module, _, name = later.place.partition(":")
        command = getattr(import_module(module), name)
        assert isinstance(command, click.Command)
        return with_help(command)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        known = name in self._own or name in self._later
        if not known and not name.startswith("-") and not ctx.resilient_parsing:
            from pancakes.runtime.plugins import to_install

            meant = suggestion(name, self._later)
            if command := to_install(GROUP, name, self._later):
                ctx.fail(f"No such command {name!r}: {command}")
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


def _installed(name: str) -> click.Command:
    """Imports a command of another distribution.

    Raises:
        PluginError: it cannot be imported, two distributions offer it, or it is no click command.
    """
    from pancakes.errors import PluginError
    from pancakes.runtime.plugins import Plugins

    plugins = Plugins()
    command = plugins.get(GROUP, name)
    if not isinstance(command, click.Command):
        distribution, version = plugins.version(GROUP, name)
        raise PluginError(f"the command {name!r} of {distribution} {version} is no click command: {command!r}")
    return command
