"""Send requests to agents, and ask the user before data is lost: shared by all verbs that talk to agents.

One rule for all verbs: a command that loses data asks first on a terminal, and needs `--yes` elsewhere.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import click

from pancakes.client import Client
from pancakes.control import Describe, Reply, Reschedule
from pancakes.errors import ControlRefusedError
from pancakes.tools.cli.options import Ask, ServiceName, TaskName
from pancakes.tools.cli.output import DRY_RUN, show_text
from pancakes.util.text import did_you_mean

if TYPE_CHECKING:
    from pancakes.client import Client
    from pancakes.control import Reply


def survey(ask: Ask, *agents: str) -> list[dict[str, Any]]:
    """Return the descriptions of agents; name on standard error those that do not answer.

    Args:
        ask: how to ask.
        agents: only these; empty strings are ignored, so that an omitted argument can be passed on.

    Raises:
        UnreachableError: no agent answers, or a named agent does not exist.
    """
    with ask.client() as client:
        return survey_with(client, *agents)


def survey_with(client: Client, *agents: str) -> list[dict[str, Any]]:
    """As `survey`, with a client that is open already."""
    found = client.describe(*agents)
    for sentence in found.silent:
        show_text(sentence, err=True)
    return found.agents


def ask_each(ask: Ask, body: Any, *agents: str) -> list[tuple[str, Any]]:
    """Send a request to all agents, or those named; name on standard error those that do not answer.

    Args:
        ask: how to ask.
        body: a control packet's body that changes nothing, such as `Channels()`.
        agents: only these; empty strings are ignored.

    Returns:
        The names of the agents that answered, each with its result.

    Raises:
        UnreachableError: no agent answers, or a named agent does not exist.
        ControlRefusedError: all of them refuse.
    """
    with ask.client() as client:
        found = client.request_all(body, *agents)
    sentences = [*found.silent, *(f"{agent} refused: {reply.reason}" for agent, reply in found.replies if not reply.ok)]
    answers = [(agent, reply.result) for agent, reply in found.replies if reply.ok]
    if not answers:
        raise ControlRefusedError("\n".join(sentences))
    for sentence in sentences:
        show_text(sentence, err=True)
    return answers


def request_result(client: Client, agent: str, body: Any) -> Any:
    """Send a control packet to an agent, and return the result in its reply; see `request`."""
    return request(client, agent, body).result


def request(client: Client, agent: str, body: Any) -> Reply:
    """Send a control packet to an agent, and return its reply, which comes when the work is done.

    Raises:
        ControlRefusedError: the agent refuses; the message is its reason.
        UnreachableError: the agent does not answer.
    """
    reply = client.request(agent, body)
    if not reply.ok:
        raise ControlRefusedError.of(reply.refusal)
    return reply


def resolve_fleet(client: Client, name: TaskName) -> TaskName:
    """Return the task that a name means; a name of three parts may begin with a fleet.

    `A/B/C` is the task C of the service B of the agent A, if such an agent exists. Otherwise it is the task C of the
    agent B of the fleet A, and the client then talks only to that fleet.
    """
    if not name.service or client.is_reachable(name.agent) or not client.is_reachable(name.service, name.agent):
        return name
    client.use_fleet(name.agent)
    return TaskName(name.service, "", name.task)


def resolve_service(client: Client, name: TaskName) -> TaskName:
    """Return the name of a task with its service; ask the agent for the service if the name lacks it.

    Without the service, a name that a service also has would mean the service, and the agent would stop all of it.

    Raises:
        ControlRefusedError: the agent has no such task, or several.
        UnreachableError: the agent does not answer.
    """
    name = resolve_fleet(client, name)
    if name.service:
        return name
    agent = name.agent
    described = request_result(client, agent, Describe())
    services = [row["service"] for row in described["tasks"] if row["task"] == name.task]
    if len(services) == 1:
        return name._replace(service=services[0])
    if services:
        choices = " or ".join(f"{agent}/{service}/{name.task}" for service in services)
        raise ControlRefusedError(f"{agent} has several tasks {name.task!r}: use {choices}")
    if name.task in [row["service"] for row in described["services"]]:
        raise ControlRefusedError(f"{agent}/{name.task} is a service, not a task: see pancakes service --help")
    if any(row["state"] != "running" for row in described["services"]):
        # The agent refuses this, and its reason names the task's service if that service does not run.
        request_result(client, agent, Describe(name.task))
    elsewhere = _agent_of(client, f"{agent}/{name.task}", name.task)
    if elsewhere:
        raise ControlRefusedError(f"{agent}/{name.task} is on {elsewhere}: use {elsewhere}/{name.task}")
    hint = did_you_mean(name.task, [row["task"] for row in described["tasks"]])
    raise ControlRefusedError(f"{agent} has no task {name.task!r}{hint}")


def _agent_of(client: Client, task_id: str, task: str) -> str:
    """Return the agent that has a task: that with this identity, or else the only one of this name; empty: none."""
    found = []
    for row in client.tasks():
        if row.task == task:
            reply = client.request(row.agent, Describe(f"{row.service}/{row.task}"))
            if reply.ok and reply.result["fence"]:
                if reply.result["fence"]["task_id"] == task_id:
                    return row.agent
                found.append(row.agent)
    return found[0] if len(found) == 1 else ""


def show_done(ask: Ask, client: Client, name: TaskName | ServiceName, done: str, body: Any, **others: Any) -> None:
    """Send a control packet about a task or a service, and print that it was done.

    Args:
        ask: has the printer.
        client: sends the request.
        name: the task or the service.
        done: the word for what was done; unused in a dry run.
        body: the control packet's body.
        others: further columns to print.
    """
    reply = request(client, name.agent, body)
    result = reply.result if isinstance(body, Reschedule) else {}
    row = {**name._asdict(), "done": DRY_RUN if body.dry_run else done, "number": reply.number, **result, **others}
    ask.printer.table([row], tuple(row))


yes_option = click.option(
    "-y", "--yes", "force", is_flag=True, help="Do not ask first. Required if this is not a terminal."
)
"""The option `--yes` of verbs that lose data; its parameter is `force`."""


def confirm(meaning: str, force: bool, dry_run: bool = False) -> None:
    """Return only if the user confirms: with `--yes`, or by answering the question on the terminal.

    Args:
        meaning: what is lost, as a sentence without its full stop.
        force: whether `--yes` was given.
        dry_run: whether this is a dry run, which needs no confirmation.

    Raises:
        ControlRefusedError: the user declines, or there is no terminal to ask on.
    """
    if force or dry_run:
        return
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise ControlRefusedError(f"{meaning}. Pass --yes to do it, or --dry-run to check it first. Nothing was done")
    if not click.confirm(f"{meaning}. Do it?", err=True):
        raise ControlRefusedError("nothing was done")
