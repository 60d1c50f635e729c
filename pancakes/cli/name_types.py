"""How people name things at a terminal: `AGENT`, `AGENT/TASK`, `AGENT/SERVICE/TASK`, `AGENT/SERVICE`, `AGENT/CHANNEL`.

Before each may stand the fleet, as in `FLEET/AGENT/TASK`; a verb speaks to one fleet then. What reads as
`AGENT/SERVICE/TASK` and as `FLEET/AGENT/TASK` is the first where there is such an agent (`pancakes.cli.asking.meant`).

The shell completes these names from what the running agents say (see `pancakes.cli.completing`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple

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


class AgentNameType(click.ParamType):
    """Reads the name of an agent; also good as the type of an option."""

    name = "AGENT"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        parts = str(value).split("/")
        if len(parts) > 2 or (len(parts) == 2 and not all(parts)):
            self.fail(f"{value!r} names no agent: write it as AGENT or FLEET/AGENT", param, ctx)
        if len(parts) == 2:
            say_fleet(self, parts[0], param, ctx)
        return parts[-1]

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType`."""
        from pancakes.cli.completing import agents

        return agents(ctx, param, incomplete)


class TaskNameType(click.ParamType):
    """Reads the name of a task."""

    name = "AGENT/TASK"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> TaskName:
        if isinstance(value, TaskName):
            return value
        parts = str(value).split("/")
        if len(parts) not in (2, 3, 4) or not all(parts):
            text = "write it as AGENT/TASK or AGENT/SERVICE/TASK, with FLEET/ before it where that is needed"
            self.fail(f"{value!r} names no task: {text}", param, ctx)
        if len(parts) == 4:
            say_fleet(self, parts.pop(0), param, ctx)
        return TaskName(parts[0], parts[1] if len(parts) == 3 else "", parts[-1])

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType`."""
        from pancakes.cli.completing import tasks

        return tasks(ctx, incomplete)


class _NameOnAgent(click.ParamType):
    """Reads the name of something that an agent has. Subclasses say what it is.

    Attributes:
        noun: what it is called.
        made: the class of its name.
    """

    noun: ClassVar[str]
    made: ClassVar[type[ServiceName | ChannelName]]

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if isinstance(value, self.made):
            return value
        parts = str(value).split("/")
        if len(parts) not in (2, 3) or not all(parts):
            self.fail(f"{value!r} names no {self.noun}: write it as {self.name} or FLEET/{self.name}", param, ctx)
        if len(parts) == 3:
            say_fleet(self, parts.pop(0), param, ctx)
        return self.made(*parts)


class ServiceNameType(_NameOnAgent):
    """Reads the name of a service."""

    name = "AGENT/SERVICE"
    noun = "service"
    made = ServiceName

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType`."""
        from pancakes.cli.completing import services

        return services(ctx, incomplete)


class ChannelNameType(_NameOnAgent):
    """Reads the name of a channel."""

    name = "AGENT/CHANNEL"
    noun = "channel"
    made = ChannelName

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType`."""
        from pancakes.cli.completing import channels

        return channels(ctx, incomplete)


an_agent = click.argument("agent", metavar="[AGENT]", default="", type=AgentNameType())
"""The argument `agent` of a verb about all agents, or one of them; a string, empty where it was left out."""
the_agent = click.argument("agent", metavar="AGENT", type=AgentNameType())
"""The argument `agent` of a verb about one agent; a string."""
agents = click.argument("agents", metavar="[AGENT]...", nargs=-1, type=AgentNameType())
"""The argument `agents` of a verb about all agents, or those that are named; a tuple of strings."""
a_channel = click.argument("name", metavar="AGENT/CHANNEL", type=ChannelNameType())
"""The argument `name` of a verb about one channel, a `ChannelName`."""
a_task = click.argument("name", metavar="AGENT/TASK", type=TaskNameType())
"""The argument `name` of a verb about one task, a `TaskName`."""
a_service = click.argument("name", metavar="AGENT/SERVICE", type=ServiceNameType())
"""The argument `name` of a verb about one service, a `ServiceName`."""
