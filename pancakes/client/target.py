"""How a program names what agents have: `AGENT/TASK`, `AGENT/SERVICE/TASK`, `AGENT/CHANNEL`. Pure."""

from __future__ import annotations

from pancakes.client.task_row import TaskRow
from pancakes.errors import PancakesError


def task_of(task: str | TaskRow) -> tuple[str, str]:
    """Returns the agent of a task, and the task as that agent reads it (see `pancakes.control`).

    Raises:
        PancakesError: it is no such name.
    """
    agent, *rest = str(task).split("/")
    if not agent or len(rest) not in (1, 2) or not all(rest):
        raise PancakesError(f"{str(task)!r} names no task: write it as AGENT/TASK or AGENT/SERVICE/TASK")
    return agent, "/".join(rest)


def channel_of(channel: str) -> tuple[str, str]:
    """Returns the agent of a channel, empty where it names none, and the channel's name.

    Raises:
        PancakesError: it is no such name.
    """
    *agent, name = channel.split("/")
    if len(agent) > 1 or not all([*agent, name]):
        raise PancakesError(f"{channel!r} names no channel: write it as AGENT/CHANNEL, or CHANNEL for all agents")
    return "".join(agent), name
