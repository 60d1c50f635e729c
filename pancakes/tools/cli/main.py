"""`pancakes`: the command line that talks to running agents and runs demos.

A verb is imported only when it is used, so that the program starts fast; `HELP` lists the verbs. Other distributions
add commands by entry point (`pancakes.commands`).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Final

import click
from click.shell_completion import CompletionItem

from pancakes.tools.cli.exit_codes import Guarded, with_help
from pancakes.tools.cli.help_sections import HELP_OPTIONS, write_sections
from pancakes.tools.cli.standard_files import fill_standard_files
from pancakes.tools.cli.version import PROGRAM, VARIABLE, version_option
from pancakes.util.text import suggestion

GROUP: Final = "pancakes.commands"
"""The entry point group of commands that other distributions add: each names a click command."""


@dataclass(frozen=True, slots=True)
class LazyCommand:
    """A command that is not imported yet.

    Attributes:
        place: `module:name`.
        help: its line in the group's help.
    """

    place: str
    help: str


class LazyGroup(Guarded, click.Group):
    """A click group whose commands are imported late.

    Args:
        lazy: its own commands, by name. An installed command cannot replace one of them.
        attributes: see `click.Group`.
    """

    def __init__(self, *args: Any, lazy: Mapping[str, LazyCommand], **attributes: Any) -> None:
        super().__init__(*args, **attributes)
        self._own = dict(lazy)

    @cached_property
    def _commands(self) -> dict[str, LazyCommand]:
        """All commands: its own, then those of other distributions. None is imported."""
        installed = {
            point.name: LazyCommand(point.value, f"From {point.dist.name}." if point.dist is not None else "")
            for point in sorted(entry_points(group=GROUP), key=lambda point: point.name)
        }
        return {**self._own, **{name: command for name, command in installed.items() if name not in self._own}}

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self._commands)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        command = self._own.get(cmd_name)
        if command is None:
            return with_help(_installed(cmd_name)) if cmd_name in self._commands else None
        module, _, name = command.place.partition(":")
        command = getattr(import_module(module), name)
        assert isinstance(command, click.Command)
        return with_help(command)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        known = name in self._own or name in self._commands
        if not known and not name.startswith("-") and not ctx.resilient_parsing:
            from pancakes.util.plugins import to_install

            meant = suggestion(name, self._commands)
            if command := to_install(GROUP, name, self._commands):
                ctx.fail(f"No such command {name!r}: {command}")
            ctx.fail(f"No such command {name!r}." + (f" Did you mean {meant!r}?" if meant else ""))
        return super().resolve_command(ctx, args)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete the names of the commands, without importing them."""
        names = [
            CompletionItem(name, help=command.help)
            for name, command in self._commands.items()
            if name.startswith(incomplete)
        ]
        return names + click.Command.shell_complete(self, ctx, incomplete)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        others = {name: command.help for name, command in self._commands.items() if name not in HELP}
        write_sections(formatter, {**SECTIONS, "From plug-ins": others})


def _installed(name: str) -> click.Command:
    """Import a command of another distribution.

    Raises:
        PluginError: it cannot be imported, two distributions offer it, or it is not a click command.
    """
    from pancakes.errors import PluginError
    from pancakes.util.plugins import Plugins

    plugins = Plugins()
    command = plugins.get(GROUP, name)
    if not isinstance(command, click.Command):
        distribution, version = plugins.version(GROUP, name)
        raise PluginError(f"the command {name!r} of {distribution} {version} is not a click command: {command!r}")
    return command


SECTIONS: Final = {
    "Look and control": {
        "agent": "Run, list and show agents.",
        "task": "Show, control and migrate tasks.",
        "service": "Show and control services.",
        "channel": "Show channels, and the packets on them.",
        "param": "Read and change the settings of tasks.",
        "log": "Show the log and the events of agents.",
        "halt": "Bring all actuators to a stop, until you end that.",
        "drive": "Drive a robot by hand, from keys or a gamepad.",
        "top": "Watch agents and tasks: rates, lateness, load.",
        "view": "Show a fleet live on a web page.",
        "doctor": "Look for faults on this machine and in its agents.",
        "what-if": "Show what a change would do, before you make it.",
    },
    "Run fleets": {
        "demo": "Run a whole mission, and judge it.",
        "up": "Run a fleet from its files.",
        "down": "Stop a fleet, or single agents, gracefully.",
        "deploy": "Install a fleet on its hosts, and keep it running there.",
        "keys": "Manage the keys of a fleet's members, and their rights.",
    },
    "Recordings": {
        "record": "Record agents, and show recordings.",
        "replay": "Feed a recording into a fleet.",
        "rerun": "Run a recorded task again with its present code.",
        "why": "Explain the commands to actuators in a recording.",
        "report": "Turn a recording into a page and figures for a paper.",
    },
    "Develop": {
        "new": "Create a package of your own: task, driver, service, ...",
        "config": "Check and show configuration files.",
        "plugin": "List the plug-ins that are installed for agents.",
        "completion": "Set up completion of names in your shell.",
    },
}
"""The verbs, each with its line in the help. The module of a verb has the verb's name."""

HELP: Final = {name: line for verbs in SECTIONS.values() for name, line in verbs.items()}
"""All verbs, each with its line."""

COMMANDS: Final = {
    name: LazyCommand(f"pancakes.tools.cli.verbs.{(verb := name.replace('-', '_'))}:{verb}", help_)
    for name, help_ in HELP.items()
}


@click.group(cls=LazyGroup, lazy=COMMANDS, context_settings=HELP_OPTIONS)
@version_option("pancakes")
def pancakes() -> None:
    """Control robots and sensor nodes that work as one.

    pancakes finds the agents of this machine by itself. To reach others, pass --at HOST:PORT of any one of them: it
    knows the rest of its fleet.

    Exit codes: 0 ok, 1 refused, 2 usage, 3 unreachable, 4 bad configuration; 130 interrupted, 141 if the
    reader of the output ends early (| head).
    """


def main() -> None:
    """The console script."""
    fill_standard_files()
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the shell (>&-)
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - stays open until the process ends
    if VARIABLE in os.environ:
        from pancakes.tools.cli.verbs.completion import answer_shell

        answer_shell(pancakes)
    pancakes(prog_name=PROGRAM)


if __name__ == "__main__":
    from pancakes.tools.cli import quiet_interrupt  # noqa: F401 - a SIGINT ends it quietly

    main()
