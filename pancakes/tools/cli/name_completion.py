"""Complete names in the shell from what the running agents report.

A completion takes `LIMIT_S` at most, and completes nothing if something fails. A choice that ends in a slash is only a
part of a name: if it is the only one, what is below it is offered, because a shell would end the word after it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

import click
from click.shell_completion import CompletionItem

from pancakes.util.text import printable

if TYPE_CHECKING:
    from pancakes.client import Where


LIMIT_S: Final = 1.0
"""How long a person waits for a completion, at most."""

Choices = Iterable[tuple[str, str]]
"""Names, each with a line that says what it is."""


def names(noun: str, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete the name of an agent, or of what an agent has: `task`, `service` or `channel`."""
    return agents(ctx, param, incomplete) if noun == "agent" else _below(ctx, incomplete, _BELOW[noun])


def agents(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete `AGENT`; those that stand on the line already are not offered again."""
    named = ctx.params.get(param.name or "")
    taken = named if isinstance(named, (list, tuple)) else ()
    fleet, slash, begun = incomplete.rpartition("/")
    return [
        CompletionItem(f"{fleet}{slash}{found['agent']}", help=f"{found['role']} in {found['fleet']}")
        for found in descriptions(ctx)
        if found["agent"].startswith(begun) and found["agent"] not in taken and fleet in ("", found["fleet"])
    ]


def descriptions(ctx: click.Context, *agents: str) -> list[dict[str, Any]]:
    """Return what the agents (or only those named) say of themselves; nothing if none answers in time."""
    from pancakes.client import Client

    try:
        with Client(_at(ctx), LIMIT_S) as client:
            return _printable(client.survey(*agents).agents)
    except Exception:  # no error may disturb a user who types
        return []


def answer(ctx: click.Context, agent: str, body: Any) -> Any:
    """Return the result that an agent answers a control packet with; None if it gives none in time."""
    from pancakes.client import Client

    try:
        with Client(_at(ctx), LIMIT_S) as client:
            return _printable(client.request(agent, body).result)
    except Exception:
        return None


def _printable(value: Any) -> Any:
    """Return what an agent says with the control characters of its texts escaped: a shell shows what it completes."""
    if isinstance(value, dict):
        return {key: _printable(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_printable(item) for item in value]
    return printable(value) if isinstance(value, str) else value


def _at(ctx: click.Context) -> Where:
    """The addresses and the fleet that are on the line already."""
    from pancakes.client import Where

    return Where(tuple(ctx.params.get("at") or ()), ctx.params.get("fleet") or "")


def _below(
    ctx: click.Context, incomplete: str, choices: Callable[[dict[str, Any], str], Choices]
) -> list[CompletionItem]:
    """Complete what is named below an agent.

    Args:
        choices: given an agent's description and what is written after `AGENT/`, returns what it has.
    """
    agent, slash, begun = incomplete.partition("/")
    found = descriptions(ctx, agent) if slash else descriptions(ctx)
    if slash and not found:  # then it is a fleet
        of_fleet = [description for description in descriptions(ctx) if description["fleet"] == agent]
        below = _among(of_fleet, begun, choices)
        return [CompletionItem(f"{agent}/{item.value}", help=item.help) for item in below]
    return _among(found, incomplete, choices)


def _among(
    found: Sequence[dict[str, Any]], incomplete: str, choices: Callable[[dict[str, Any], str], Choices]
) -> list[CompletionItem]:
    """Complete what is named below one of some agents; see `_below`."""
    agent, slash, begun = incomplete.partition("/")
    there = {description["agent"]: description for description in found if description["agent"].startswith(agent)}
    if not slash and len(there) > 1:
        return [CompletionItem(f"{name}/") for name in there]
    return [
        CompletionItem(f"{name}/{choice}", help=help_ or None)
        for name, description in there.items()
        for choice, help_ in choices(description, begun)
        if choice.startswith(begun)
    ]


def _tasks(description: dict[str, Any], begun: str) -> Choices:
    """The tasks of an agent; with their services where a service is begun, or a name is in several services."""
    rows = [(row["service"], row["task"], f"{row['type']}, {row['state']}") for row in description["tasks"]]
    names = [task for _, task, _ in rows]
    short = [(task if names.count(task) == 1 else f"{service}/{task}", what) for service, task, what in rows]
    if any(choice.startswith(begun) for choice, _ in short):
        return short
    full = [(f"{service}/{task}", what) for service, task, what in rows]
    of_services = list(dict.fromkeys(service for service, _, _ in rows if service.startswith(begun)))
    return full if len(of_services) < 2 else [(f"{service}/", "") for service in of_services]


_BELOW: Final[dict[str, Callable[[dict[str, Any], str], Choices]]] = {
    "task": _tasks,
    "service": lambda found, begun: ((row["service"], row["state"]) for row in found["services"]),
    "channel": lambda found, begun: ((name, "") for name in found["channels"]),
}
"""What an agent has, by its kind: as the agent describes itself, given what is written of the name."""
