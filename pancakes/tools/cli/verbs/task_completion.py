"""What a shell may put in place of a word that goes with the task on the same line: its timers, tasks beside it."""

from __future__ import annotations

from contextlib import suppress

import click
from click.shell_completion import CompletionItem

from pancakes.control import Describe
from pancakes.tools.cli.completing import answer, descriptions
from pancakes.tools.cli.name_types import TASK_NAME, TaskName


def timers(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Completes the timers of the task that is named on the line already."""
    name = _task_named(ctx)
    found = answer(ctx, name.agent, Describe(name.target)) if name is not None else None
    # A service of that name would answer with a list.
    rows = found["timers"] if isinstance(found, dict) else []
    return [
        CompletionItem(row["timer"], help=f"{row['rate_hz']:g} Hz")
        for row in rows
        if row["timer"].startswith(incomplete)
    ]


def tasks_beside(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Completes the tasks on the agent of the task that is named on the line already."""
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
    """Completes the cost functions that are installed here."""
    return _installed("pancakes.costs", incomplete)


def types(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Completes the types of tasks that are installed here."""
    return _installed("pancakes.tasks", incomplete)


def _installed(group: str, incomplete: str) -> list[CompletionItem]:
    from pancakes.runtime.plugins import Plugins

    return [CompletionItem(name) for name in Plugins().names(group) if name.startswith(incomplete)]


def _task_named(ctx: click.Context) -> TaskName | None:
    """The argument that names a task; click leaves arguments unread where the value of an option is asked for."""
    for word in ctx.args:
        with suppress(click.BadParameter):
            return TASK_NAME.convert(word, None, ctx)
    return None
