"""Ask agents for something, and confirm with a person what loses data: shared by all verbs that speak to agents.

One rule for all verbs: what loses something asks on a terminal, and needs `--force` elsewhere.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from pancakes.client import Client
from pancakes.control import Describe, Reply, Reschedule
from pancakes.errors import ControlRefused
from pancakes.tools.cli.options import Ask, ServiceName, TaskName
from pancakes.tools.cli.output import DRY_RUN, show_text
from pancakes.util.text import did_you_mean

if TYPE_CHECKING:
    from pancakes.client import Client
    from pancakes.control import Reply


def survey(ask: Ask, *agents: str) -> list[dict[str, Any]]:
    """Return what the agents say of themselves; name on standard error those that said nothing.

    Args:
        ask: how to ask.
        agents: only these; empty strings do not count, so that an argument that was left out can be passed on.

    Raises:
        Unreachable: no agent answers, or there is none of a name.
    """
    with ask.client() as client:
        return survey_with(client, *agents)


def survey_with(client: Client, *agents: str) -> list[dict[str, Any]]:
    """As `survey`, with a client that is there."""
    found = client.survey(*agents)
    for sentence in found.silent:
        show_text(sentence, err=True)
    return found.agents


def ask_each(ask: Ask, body: Any, *agents: str) -> list[tuple[str, Any]]:
    """Ask all agents, or those named, the same, all at once; name on standard error those that gave no answer.

    Args:
        ask: how to ask.
        body: a control packet's body that changes nothing, such as `Channels()`.
        agents: only these; empty strings do not count.

    Returns:
        The agents' names, each with the result that it answered with.

    Raises:
        Unreachable: no agent answers, or there is none of a name.
        ControlRefused: all of them refuse.
    """
    with ask.client() as client:
        found = client.request_all(body, *agents)
    sentences = [*found.silent, *(f"{agent} refused: {reply.reason}" for agent, reply in found.replies if not reply.ok)]
    answers = [(agent, reply.result) for agent, reply in found.replies if reply.ok]
    if not answers:
        raise ControlRefused("\n".join(sentences))
    for sentence in sentences:
        show_text(sentence, err=True)
    return answers


def request_result(client: Client, agent: str, body: Any) -> Any:
    """Have an agent do something, and return the result that it answers with; see `request`."""
    return request(client, agent, body).result


def request(client: Client, agent: str, body: Any) -> Reply:
    """Have an agent do something, and return its reply once it has done it.

    Raises:
        ControlRefused: it refuses; the message is its reason.
        Unreachable: it does not answer.
    """
    reply = client.request(agent, body)
    if not reply.ok:
        raise ControlRefused.of(reply.refusal)
    return reply


def resolve_fleet(client: Client, name: TaskName) -> TaskName:
    """Return the task that is meant by a name, which may begin with a fleet if it has three parts.

    `A/B/C` is the task C of the service B of the agent A, if there is such an agent. Otherwise it is the task C of
    the agent B of the fleet A, and from then on the client speaks to that fleet alone.
    """
    if not name.service or client.is_reachable(name.agent) or not client.is_reachable(name.service, name.agent):
        return name
    client.use_fleet(name.agent)
    return TaskName(name.service, "", name.task)


def resolve_service(client: Client, name: TaskName) -> TaskName:
    """Return the name of a task with its service, which the agent is asked for if it was not said.

    An agent would take the name of a service for that service, and stop it as a whole.

    Raises:
        ControlRefused: the agent has no such task, or two of them.
        Unreachable: it does not answer.
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
        raise ControlRefused(f"{agent} has several tasks {name.task!r}: say {choices}")
    if name.task in [row["service"] for row in described["services"]]:
        raise ControlRefused(f"{agent}/{name.task} is a service, not a task: see pancakes service --help")
    if any(row["state"] != "running" for row in described["services"]):
        # It refuses, and names the task's service if that does not run.
        request_result(client, agent, Describe(name.task))
    elsewhere = _agent_of(client, f"{agent}/{name.task}", name.task)
    if elsewhere:
        raise ControlRefused(f"{agent}/{name.task} is on {elsewhere}: say {elsewhere}/{name.task}")
    hint = did_you_mean(name.task, [row["task"] for row in described["tasks"]])
    raise ControlRefused(f"{agent} has no task {name.task!r}{hint}")


def _agent_of(client: Client, task_id: str, task: str) -> str:
    """Return the agent that has a task, given its identity and name; empty: none that answers."""
    for row in client.tasks():
        if row.task == task:
            told = client.request(row.agent, Describe(f"{row.service}/{row.task}"))
            if told.ok and told.result["fence"] and told.result["fence"]["task_id"] == task_id:
                return row.agent
    return ""


def show_done(ask: Ask, client: Client, name: TaskName | ServiceName, done: str, body: Any, **others: Any) -> None:
    """Have an agent do something with a task or a service, and show that it was done.

    Args:
        ask: how to print it.
        client: asks the agent.
        name: the task or the service.
        done: what was done, if it was not only asked whether it would be.
        body: the control packet's body.
        others: what is shown besides.
    """
    reply = request(client, name.agent, body)
    result = reply.result if isinstance(body, Reschedule) else {}
    row = {**name._asdict(), "done": DRY_RUN if body.dry_run else done, "number": reply.number, **result, **others}
    ask.printer.table([row], tuple(row))


force_option = click.option("--force", is_flag=True, help="Do it without asking. Needed if this is no terminal.")
"""The option `--force` of verbs that lose something; its parameter is `force`."""


def confirm(meaning: str, force: bool, dry_run: bool = False) -> None:
    """Go on only if a person means it: with `--force`, or after they were asked on the terminal.

    Args:
        meaning: what is lost, as a sentence without its full stop.
        force: whether `--force` was given.
        dry_run: whether nothing is done anyway.

    Raises:
        ControlRefused: they do not, or nobody can be asked.
    """
    if force or dry_run:
        return
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise ControlRefused(f"{meaning}. With --force it is done, with --dry-run only shown. Nothing was done")
    if not click.confirm(f"{meaning}. Do it?", err=True):
        raise ControlRefused("nothing was done")


def request_confirmed(
    client: Client, agent: str, body: Callable[[bool, bool], Any], force: bool, dry_run: bool
) -> Reply:
    """Have an agent do what it refuses without force; its refusal, which says what that would mean, is the question.

    Args:
        client: asks the agent.
        agent: the agent.
        body: makes the control packet's body, given whether it is forced and whether it is a dry run.
        force: whether `--force` was given.
        dry_run: whether `--dry-run` was given.

    Raises:
        ControlRefused: the agent refuses it in any case, or it is not meant.
        Unreachable: the agent does not answer.
    """
    # only now: many a verb that asks needs no client

    if force or dry_run or not (sys.stdin.isatty() and sys.stderr.isatty()):
        return request(client, agent, body(force, dry_run))
    request(client, agent, body(True, True))
    unforced = client.request(agent, body(False, False))
    if unforced.ok:
        return unforced
    confirm(unforced.reason.removesuffix(". Nothing was done"), force)
    return request(client, agent, body(True, False))
