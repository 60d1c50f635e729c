"""Complete names in the shell from what the running agents report.

A completion takes at most `LIMIT_S`, and offers nothing if something fails. A choice that ends in a slash is only a
part of a name. If it would be the only choice, the names below it are offered, because a shell would end the word
after a single choice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

import click
from click.shell_completion import CompletionItem

from pancakes.util.text import printable

if TYPE_CHECKING:
    from pancakes.client import Target


LIMIT_S: Final = 1.0
"""The longest time, in seconds, that a user waits for a completion."""

Choices = Iterable[tuple[str, str]]
"""Names, each with a line that describes it."""


def names(noun: str, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete the name of an agent, or of a `task`, `service` or `channel` of an agent."""
    return agents(ctx, param, incomplete) if noun == "agent" else _below(ctx, incomplete, _BELOW[noun])


def agents(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete `AGENT`; agents that are on the command line already are not offered again."""
    named = ctx.params.get(param.name or "")
    taken = named if isinstance(named, (list, tuple)) else ()
    fleet, slash, prefix = incomplete.rpartition("/")
    return [
        CompletionItem(f"{fleet}{slash}{found['agent']}", help=f"{found['role']} in {found['fleet']}")
        for found in descriptions(ctx)
        if found["agent"].startswith(prefix) and found["agent"] not in taken and fleet in ("", found["fleet"])
    ]


def descriptions(ctx: click.Context, *agents: str) -> list[dict[str, Any]]:
    """Return the descriptions of all agents, or of those named; empty if none answers in time."""
    from pancakes.client import Client

    try:
        with Client(_at(ctx), LIMIT_S) as client:
            return _printable(client.describe(*agents).agents)
    except Exception:  # an error must not print into the line that the user types
        return []


def answer(ctx: click.Context, agent: str, body: Any) -> Any:
    """Return an agent's result for a control packet; None if it does not answer in time."""
    from pancakes.client import Client

    try:
        with Client(_at(ctx), LIMIT_S) as client:
            return _printable(client.request(agent, body).result)
    except Exception:
        return None


def _printable(value: Any) -> Any:
    """Return an agent's answer with control characters escaped, because a shell prints what it completes."""
    if isinstance(value, dict):
        return {key: _printable(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_printable(item) for item in value]
    return printable(value) if isinstance(value, str) else value


def _at(ctx: click.Context) -> Target:
    """The addresses and the fleet that are on the command line already."""
    from pancakes.client import Target

    return Target(tuple(ctx.params.get("at") or ()), ctx.params.get("fleet") or "")


def _below(
    ctx: click.Context, incomplete: str, choices: Callable[[dict[str, Any], str], Choices]
) -> list[CompletionItem]:
    """Complete the name of something that an agent has.

    Args:
        choices: returns what an agent has, given its description and the text after `AGENT/`.
    """
    agent, slash, prefix = incomplete.partition("/")
    found = descriptions(ctx, agent) if slash else descriptions(ctx)
    if slash and not found:  # the first part is a fleet, not an agent
        of_fleet = [description for description in descriptions(ctx) if description["fleet"] == agent]
        below = _among(of_fleet, prefix, choices)
        return [CompletionItem(f"{agent}/{item.value}", help=item.help) for item in below]
    return _among(found, incomplete, choices)


def _among(
    found: Sequence[dict[str, Any]], incomplete: str, choices: Callable[[dict[str, Any], str], Choices]
) -> list[CompletionItem]:
    """Complete the name of something that one of these agents has; see `_below`."""
    agent, slash, prefix = incomplete.partition("/")
    matching = {description["agent"]: description for description in found if description["agent"].startswith(agent)}
    if not slash and len(matching) > 1:
        return [CompletionItem(f"{name}/") for name in matching]
    return [
        CompletionItem(f"{name}/{choice}", help=help_ or None)
        for name, description in matching.items()
        for choice, help_ in choices(description, prefix)
        if choice.startswith(prefix)
    ]


def _tasks(description: dict[str, Any], prefix: str) -> Choices:
    """The tasks of an agent; with their services if the prefix is one, or if several services have the name."""
    rows = [(row["service"], row["task"], f"{row['type']}, {row['state']}") for row in description["tasks"]]
    names = [task for _, task, _ in rows]
    short = [(task if names.count(task) == 1 else f"{service}/{task}", help_) for service, task, help_ in rows]
    if any(choice.startswith(prefix) for choice, _ in short):
        return short
    full = [(f"{service}/{task}", help_) for service, task, help_ in rows]
    services = list(dict.fromkeys(service for service, _, _ in rows if service.startswith(prefix)))
    return full if len(services) < 2 else [(f"{service}/", "") for service in services]


_BELOW: Final[dict[str, Callable[[dict[str, Any], str], Choices]]] = {
    "task": _tasks,
    "service": lambda found, prefix: ((row["service"], row["state"]) for row in found["services"]),
    "channel": lambda found, prefix: ((name, "") for name in found["channels"]),
}
"""The choices for each kind of name, given an agent's description and the text so far."""
