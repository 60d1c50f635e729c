"""What the verbs have in common that ask agents for something."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import click

from pancakes.cli.client import Client
from pancakes.cli.names import TaskName
from pancakes.control import Describe
from pancakes.errors import ControlRefused
from pancakes.suggestion import suggestion


def survey(at: Sequence[str], timeout_s: float, agent: str = "") -> list[dict[str, Any]]:
    """Returns what the agents (or only `agent`) say of themselves; names on standard error who said nothing.

    Raises:
        PancakesError: nobody answers, ...
    """
    with Client(at, timeout_s) as client:
        found = client.survey(agent)
    for sentence in found.silent:
        click.echo(sentence, err=True)
    return found.agents


def order(client: Client, agent: str, body: Any) -> Any:
    """Has an agent do something, and returns the result that it answers with.

    Raises:
        ControlRefused: it refuses; the message is its reason.
        Unreachable: it does not answer.
    """
    reply = client.request(agent, body)
    if not reply.ok:
        raise ControlRefused(reply.reason)
    return reply.result


def placed(client: Client, name: TaskName) -> TaskName:
    """Returns the name of a task with its service, which the agent is asked for where it was not said.

    An agent would take the name of a service for that service, and stop it as a whole.

    Raises:
        ControlRefused: the agent has no such task, or two of them.
        Unreachable: it does not answer.
    """
    if name.service:
        return name
    agent = name.agent
    described = order(client, agent, Describe())
    services = [row["service"] for row in described["tasks"] if row["task"] == name.task]
    if len(services) == 1:
        return name._replace(service=services[0])
    if services:
        choices = " or ".join(f"{agent}/{service}/{name.task}" for service in services)
        raise ControlRefused(f"{agent} has several tasks {name.task!r}: say {choices}")
    if name.task in [row["service"] for row in described["services"]]:
        raise ControlRefused(f"{agent}/{name.task} is a service, not a task: see pancakes service --help")
    meant = suggestion(name.task, [row["task"] for row in described["tasks"]])
    raise ControlRefused(f"{agent} has no task {name.task!r}" + (f", did you mean {meant!r}?" if meant else ""))
