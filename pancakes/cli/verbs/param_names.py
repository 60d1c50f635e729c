"""How people name settings at a terminal, and how a shell completes that."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from pancakes.cli.names import TaskName, TaskNameType
from pancakes.control import Describe

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem


class AgentOrTask(click.ParamType):
    """Reads the name of an agent or of a task; an agent is a `TaskName` without a task."""

    name = "AGENT[/TASK]"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> TaskName:
        if isinstance(value, str) and value and "/" not in value:
            return TaskName(value, "", "")
        return TaskNameType().convert(value, param, ctx)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType`."""
        from pancakes.cli import completing

        begun = [] if "/" in incomplete else completing.agents(ctx, param, incomplete)
        return begun + completing.tasks(ctx, incomplete)


class ParamName(click.ParamType):
    """The name of a setting of the task that stands before it.

    Args:
        equals: whether `=` and a value are to follow.
    """

    name = "NAME"

    def __init__(self, equals: bool = False) -> None:
        self._end = "=" if equals else ""

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType`."""
        from click.shell_completion import CompletionItem

        from pancakes.cli.completing import answer
        from pancakes.config.toml_text import value_text

        name = ctx.params.get("name")
        told = answer(ctx, name.agent, Describe(name.target)) if isinstance(name, TaskName) else None
        settings = told.get("settings", {}) if isinstance(told, dict) else {}
        return [
            CompletionItem(f"{key}{self._end}", help=value_text(value))
            for key, value in settings.items()
            if key.startswith(incomplete)
        ]


a_task_or_agent = click.argument("name", metavar="AGENT[/TASK]", type=AgentOrTask())
"""The argument `name` of a verb about one task, or all tasks of one agent."""
