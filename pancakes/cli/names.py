"""How people name tasks and services at a terminal: `AGENT/TASK`, `AGENT/SERVICE/TASK`, `AGENT/SERVICE`."""

from __future__ import annotations

from typing import Any, NamedTuple

import click


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


a_task = click.argument("name", metavar="AGENT/TASK", type=TaskNameType())
"""The argument `name` of a verb about one task, a `TaskName`."""
a_service = click.argument("name", metavar="AGENT/SERVICE", type=ServiceNameType())
"""The argument `name` of a verb about one service, a `ServiceName`."""
