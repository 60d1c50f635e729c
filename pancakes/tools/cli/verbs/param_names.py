"""How people name settings at a terminal, and how a shell completes that."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import click

from pancakes.control import Describe
from pancakes.tools.cli.name_types import TASK_NAME, TaskName

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem


_F = TypeVar("_F", bound=Callable[..., Any])

Changes = tuple[tuple[tuple[str, ...], Any], ...]
"""Changes of settings: for each the keys that lead to the setting, and its value."""


class AgentOrTask(click.ParamType):
    """Reads the name of an agent or of a task; an agent is a `TaskName` without a task."""

    name = "AGENT[/TASK]"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> TaskName:
        if isinstance(value, str) and value and "/" not in value:
            return TaskName(value, "", "")
        return TASK_NAME.convert(value, param, ctx)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType`."""
        from pancakes.tools.cli import completing

        begun = [] if "/" in incomplete else completing.agents(ctx, param, incomplete)
        return begun + completing.names("task", ctx, param, incomplete)


class ParamName(click.ParamType):
    """The name of a setting of the task that stands before it.

    Attributes:
        end: the text that completes the name.
    """

    name = "NAME"
    end = ""

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType`."""
        from click.shell_completion import CompletionItem

        from pancakes.runtime.config.toml_text import value_text
        from pancakes.tools.cli.completing import answer

        name = ctx.params.get("name")
        told = answer(ctx, name.agent, Describe(name.target)) if isinstance(name, TaskName) else None
        settings = told.get("settings", {}) if isinstance(told, dict) else {}
        return [
            CompletionItem(f"{key}{self.end}", help=value_text(value))
            for key, value in settings.items()
            if key.startswith(incomplete)
        ]


class SettingChange(ParamName):
    """Reads `NAME=VALUE`, with a value as `--set` takes it, as the keys that lead to a setting, and its value."""

    name = "NAME=VALUE"
    end = "="

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        from pancakes.runtime.config.override import change_of

        found = change_of(value)
        if found is None:
            self.fail(f"{value!r} is no setting: write it as {self.name}", param, ctx)
        return found


a_task_or_agent = click.argument("name", metavar="AGENT[/TASK]", type=AgentOrTask())
"""The argument `name` of a verb about one task, or all tasks of one agent."""


def set_option(help_: str) -> Callable[[_F], _F]:
    """Returns the option `--set` for settings of a task; its parameter is `sets`, of the type `Changes`."""
    return click.option("--set", "sets", metavar="NAME=VALUE", type=SettingChange(), multiple=True, help=help_)
