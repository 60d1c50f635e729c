"""Arguments about a task and their completion: settings (`NAME=VALUE`), timers, types, cost functions."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.shell_completion import CompletionItem

from pancakes.control import Describe
from pancakes.tools.cli.name_completion import answer, descriptions
from pancakes.tools.cli.options import AGENT_NAME, TASK_NAME, TaskName

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem


def timers(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete the timers of the task that the command line names already."""
    name = _task_named(ctx)
    found = answer(ctx, name.agent, Describe(name.target)) if name is not None else None
    # If a service has this name, the answer is a list.
    rows = found["timers"] if isinstance(found, dict) else []
    return [
        CompletionItem(row["timer"], help=f"{row['rate_hz']:g} Hz")
        for row in rows
        if row["timer"].startswith(incomplete)
    ]


def tasks_beside(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete the other tasks on the agent of the task that the command line names already."""
    name = _task_named(ctx)
    if name is None:
        return []
    return [
        CompletionItem(row["task"], help=f"{row['type']}, {row['state']}")
        for description in descriptions(ctx, name.agent)
        for row in description["tasks"]
        if row["task"].startswith(incomplete) and row["task"] != name.task
    ]


def costs(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete the cost functions that are installed here."""
    return _installed("pancakes.costs", incomplete)


def types(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete the types of tasks that are installed here."""
    return _installed("pancakes.tasks", incomplete)


def _installed(group: str, incomplete: str) -> list[CompletionItem]:
    from pancakes.util.plugins import Plugins

    return [CompletionItem(name) for name in Plugins().names(group) if name.startswith(incomplete)]


def _task_named(ctx: click.Context) -> TaskName | None:
    """Return the argument that names a task; click has not parsed it yet while it completes an option's value."""
    for word in ctx.args:
        with suppress(click.BadParameter):
            return TASK_NAME.convert(word, None, ctx)
    return None


_F = TypeVar("_F", bound=Callable[..., Any])

Changes = tuple[tuple[tuple[str, ...], Any], ...]
"""Changes of settings: for each, the path of keys to the setting, and its value."""


class AgentOrTask(click.ParamType):
    """Read the name of an agent or of a task; an agent is a `TaskName` without a task."""

    name = "AGENT[/TASK]"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> TaskName:
        if isinstance(value, str) and value and "/" not in value:
            return TaskName(value, "", "")
        return TASK_NAME.convert(value, param, ctx)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType`."""
        from pancakes.tools.cli import name_completion

        of_agents = [] if "/" in incomplete else name_completion.agents(ctx, param, incomplete)
        return of_agents + name_completion.names("task", ctx, param, incomplete)


class ParamName(click.ParamType):
    """The name of a setting of the task that precedes it on the command line.

    Attributes:
        end: the text to append to a completed name.
    """

    name = "NAME"
    end = ""

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType`."""
        from click.shell_completion import CompletionItem

        from pancakes.config.toml_writer import value_text
        from pancakes.tools.cli.name_completion import answer

        name = ctx.params.get("name")
        found = answer(ctx, name.agent, Describe(name.target)) if isinstance(name, TaskName) else None
        settings = found.get("settings", {}) if isinstance(found, dict) else {}
        return [
            CompletionItem(f"{key}{self.end}", help=value_text(value))
            for key, value in settings.items()
            if key.startswith(incomplete)
        ]


class SettingChange(ParamName):
    """Read `NAME=VALUE` into the path of keys to a setting, and its value."""

    name = "NAME=VALUE"
    end = "="

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        from pancakes.config.toml_reader import change_of

        found = change_of(value)
        if found is None:
            self.fail(f"{value!r} is not a setting: write it as {self.name}", param, ctx)
        return found


a_task_or_agent = click.argument("name", metavar="AGENT[/TASK]", type=AgentOrTask())
"""The argument `name` of a verb about one task, or about all tasks of one agent."""


def set_option(help_: str) -> Callable[[_F], _F]:
    """Return the option `--set` for settings of a task; its parameter is `sets`, of the type `Changes`."""
    return click.option("--set", "sets", metavar="NAME=VALUE", type=SettingChange(), multiple=True, help=help_)


def birthplace_option(help_: str) -> Callable[[_F], _F]:
    """Return the option `--birthplace`, which tells tasks of the same name apart; its parameter is `birthplace`."""
    return click.option("--birthplace", metavar="AGENT", type=AGENT_NAME, default="", help=help_)
