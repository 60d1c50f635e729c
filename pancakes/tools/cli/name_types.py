"""How people name things at a terminal: `AGENT`, `AGENT/TASK`, `AGENT/SERVICE/TASK`, `AGENT/SERVICE`, `AGENT/CHANNEL`.

Before each may stand the fleet, as in `FLEET/AGENT/TASK`; a verb speaks to one fleet then. What reads as
`AGENT/SERVICE/TASK` and as `FLEET/AGENT/TASK` is the first where there is such an agent
(`pancakes.tools.cli.asking.meant`).

The shell completes these names from what the running agents say (see `pancakes.tools.cli.completing`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import click

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem


class TaskName(NamedTuple):
    """Names a task.

    Attributes:
        agent: the agent that it is on.
        service: its service; empty where that was not said.
        task: its name.
    """

    agent: str
    service: str
    task: str

    @property
    def target(self) -> str:
        """It as the agent itself reads it (see `pancakes.control`)."""
        return f"{self.service}/{self.task}" if self.service else self.task

    def __str__(self) -> str:
        return f"{self.agent}/{self.target}"


class ServiceName(NamedTuple):
    """Names a service.

    Attributes:
        agent: the agent that it is on.
        service: its name.
    """

    agent: str
    service: str

    @property
    def target(self) -> str:
        """It as the agent itself reads it, also where one of its tasks has the same name."""
        return f"{self.service}/"

    def __str__(self) -> str:
        return f"{self.agent}/{self.service}"


class ChannelName(NamedTuple):
    """Names a channel.

    Attributes:
        agent: the agent whose channel it is.
        channel: its name, such as `system`.
    """

    agent: str
    channel: str

    def __str__(self) -> str:
        return f"{self.agent}/{self.channel}"


_FLEET: Final = "pancakes.fleet"
"""Under this name a command keeps the fleet that stands before one of its names."""


def say_fleet(type_: click.ParamType, fleet: str, param: click.Parameter | None, ctx: click.Context | None) -> None:
    """Notes the fleet that stands before a name, for `the_fleet`; all names of a command must be of the same."""
    if ctx is not None and ctx.meta.setdefault(_FLEET, fleet) != fleet:
        type_.fail(f"a command speaks to one fleet, not to {ctx.meta[_FLEET]} and {fleet}", param, ctx)


def the_fleet(option: str) -> str:
    """Returns the fleet that a command is about: that of `--fleet`, or that before its names; empty: any."""
    said: str = click.get_current_context().meta.get(_FLEET, "")
    if option and said and option != said:
        raise click.UsageError(f"a command speaks to one fleet, not to {option} (--fleet) and {said}")
    return option or said


class NameType(click.ParamType):
    """Reads a name, with its fleet before it or without; also good as the type of an option.

    Args:
        noun: what bears such a name: `agent`, `task`, `service` or `channel`.
        name: how the name is written.
        counts: how many parts it may have; a name of the largest number begins with the fleet.
        made: makes the name of its parts, without the fleet.
        how: how to write it, for a sentence that refuses what is no such name.
    """

    def __init__(self, noun: str, name: str, counts: Sequence[int], made: Callable[..., Any], how: str = "") -> None:
        self.noun = noun
        self.name = name
        self._counts = counts
        self._made = made
        self._how = how or f"write it as {name} or FLEET/{name}"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not isinstance(value, str):
            return value
        parts = value.split("/")
        if len(parts) not in self._counts or (len(parts) > 1 and not all(parts)):
            self.fail(f"{value!r} names no {self.noun}: {self._how}", param, ctx)
        if len(parts) == max(self._counts):
            say_fleet(self, parts.pop(0), param, ctx)
        return self._made(*parts)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType`."""
        from pancakes.tools.cli.completing import names

        return names(self.noun, ctx, param, incomplete)


def _task_name(agent: str, *rest: str) -> TaskName:
    *service, task = rest
    return TaskName(agent, "".join(service), task)


AGENT_NAME: Final = NameType("agent", "AGENT", (1, 2), str)
TASK_NAME: Final = NameType(
    "task",
    "AGENT/TASK",
    (2, 3, 4),
    _task_name,
    "write it as AGENT/TASK or AGENT/SERVICE/TASK, with FLEET/ before it where that is needed",
)
SERVICE_NAME: Final = NameType("service", "AGENT/SERVICE", (2, 3), ServiceName)
CHANNEL_NAME: Final = NameType("channel", "AGENT/CHANNEL", (2, 3), ChannelName)

an_agent = click.argument("agent", metavar="[AGENT]", default="", type=AGENT_NAME)
"""The argument `agent` of a verb about all agents, or one of them; a string, empty where it was left out."""
the_agent = click.argument("agent", metavar="AGENT", type=AGENT_NAME)
"""The argument `agent` of a verb about one agent; a string."""
agents = click.argument("agents", metavar="[AGENT]...", nargs=-1, type=AGENT_NAME)
"""The argument `agents` of a verb about all agents, or those that are named; a tuple of strings."""
a_channel = click.argument("name", metavar="AGENT/CHANNEL", type=CHANNEL_NAME)
"""The argument `name` of a verb about one channel, a `ChannelName`."""
a_task = click.argument("name", metavar="AGENT/TASK", type=TASK_NAME)
"""The argument `name` of a verb about one task, a `TaskName`."""
a_service = click.argument("name", metavar="AGENT/SERVICE", type=SERVICE_NAME)
"""The argument `name` of a verb about one service, a `ServiceName`."""
