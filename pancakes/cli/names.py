"""How people name things at a terminal: `AGENT`, `AGENT/TASK`, `AGENT/SERVICE/TASK`, `AGENT/SERVICE`, `AGENT/CHANNEL`.

The shell completes these names from what the running agents say (see `pancakes.cli.completing`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

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


class AgentNameType(click.ParamType):
    """Reads the name of an agent; also good as the type of an option."""

    name = "AGENT"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        text = str(value)
        if "/" in text:
            self.fail(f"{text!r} names no agent: write it as AGENT, without a slash", param, ctx)
        return text

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
        if len(parts) not in (2, 3) or not all(parts):
            self.fail(f"{value!r} names no task: write it as AGENT/TASK or AGENT/SERVICE/TASK", param, ctx)
        return TaskName(parts[0], parts[1] if len(parts) == 3 else "", parts[-1])

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType`."""
        from pancakes.cli.completing import tasks

        return tasks(ctx, incomplete)


class ServiceNameType(click.ParamType):
    """Reads the name of a service."""

    name = "AGENT/SERVICE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> ServiceName:
        if isinstance(value, ServiceName):
            return value
        agent, _, service = str(value).partition("/")
        if not agent or not service or "/" in service:
            self.fail(f"{value!r} names no service: write it as AGENT/SERVICE", param, ctx)
        return ServiceName(agent, service)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType`."""
        from pancakes.cli.completing import services

        return services(ctx, incomplete)


class ChannelNameType(click.ParamType):
    """Reads the name of a channel."""

    name = "AGENT/CHANNEL"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> ChannelName:
        if isinstance(value, ChannelName):
            return value
        agent, _, channel = str(value).partition("/")
        if not agent or not channel or "/" in channel:
            self.fail(f"{value!r} names no channel: write it as AGENT/CHANNEL", param, ctx)
        return ChannelName(agent, channel)

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
