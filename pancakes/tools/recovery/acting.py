"""Do what a diagnosis proposes, by control packets; with a dry run the agents only check that they would do it."""

from __future__ import annotations

from typing import Any

import msgspec

from pancakes.client import Client
from pancakes.control import Adopt, Forget, Reply, Reschedule, Revive, SetFence, Start, Stop, Take
from pancakes.errors import ControlRefusedError
from pancakes.packet import join
from pancakes.tools.recovery.diagnosis import Act, Findings, Proposal, newest
from pancakes.tools.recovery.looking import Survey

DONE: dict[Act, str] = {
    "start": "started",
    "adopt": "runs here",
    "resume": "goes on",
    "revive": "runs here",
    "begin": "runs here",
    "keep": "kept",
    "leave": "left",
    "take": "taken over",
    "obey": "obeyed",
}
"""What was done, in a word or two."""


class Beginning(msgspec.Struct, frozen=True):
    """How a task begins from scratch.

    Attributes:
        body: the request.
        rate_hz: the rate of its first timer; None: as its class says.
    """

    body: Revive
    rate_hz: float | None = None


def carry_out(
    client: Client,
    survey: Survey,
    found: Findings,
    proposal: Proposal,
    beginning: Beginning | None = None,
    *,
    dry_run: bool = False,
) -> str:
    """Do what is proposed.

    Args:
        client: sends the requests.
        survey: what the agents have reported.
        found: the findings that the proposal is about.
        proposal: the proposal; one without an act does nothing.
        beginning: how the task begins from scratch, if the proposal is that.
        dry_run: only have the agents check whether they would do it.

    Returns:
        The agent that runs the task then; empty: none, or it was not told.

    Raises:
        ControlRefusedError: an agent refuses; the message is its reason.
        UnreachableError: an agent does not answer any more.
    """
    birthplace, agent = found.task_id.partition("/")[0], proposal.agent
    target = _target(found, agent)

    def ask(name: str, body: Any) -> Reply:
        reply = client.request(name, body)
        if not reply.ok:
            raise ControlRefusedError.of(reply.refusal)
        return reply

    match proposal.act:
        case "start":
            ask(agent, Start(target, dry_run=dry_run))
        case "adopt":
            ask(agent, Adopt(target, birthplace, dry_run))
        case "keep":
            _keep(ask, found, proposal, dry_run)
        case "leave":
            ask(agent, Forget(target, birthplace, dry_run=dry_run))
            return ""
        case "take":
            return str(ask(agent, Take(found.name, birthplace, dry_run)).result["winner"])
        case "resume" | "revive" | "begin":
            body = beginning.body if beginning is not None else _revival(survey, found, proposal)
            ask(agent, msgspec.structs.replace(body, dry_run=dry_run))
            if beginning is not None and beginning.rate_hz is not None and not dry_run:
                ask(agent, Reschedule(join(body.service, found.name), beginning.rate_hz))
        case "obey":
            for name in proposal.others:
                at, _, actuator = name.partition("/")
                ask(at, SetFence(actuator, found.task_id, dry_run))
    return agent


def _target(found: Findings, agent: str) -> str:
    copy = found.copy(agent)
    return join(copy.service, found.name) if copy is not None and copy.service else found.name


def _keep(ask: Any, found: Findings, proposal: Proposal, dry_run: bool) -> None:
    """End the other copies, and let the one that is kept go on if it was paused."""
    birthplace, keeper = found.task_id.partition("/")[0], found.copy(proposal.agent)
    for name in proposal.others:
        target, copy = _target(found, name), found.copy(name)
        ask(name, Forget(target, birthplace, proposal.agent, dry_run=True))
        if dry_run:
            continue
        if copy is not None and copy.acts:
            ask(name, Stop(target))
        ask(name, Forget(target, birthplace, proposal.agent))
    if keeper is not None and not keeper.acts:
        ask(proposal.agent, Adopt(_target(found, proposal.agent), birthplace, dry_run))


def _revival(survey: Survey, found: Findings, proposal: Proposal) -> Revive:
    if proposal.act == "resume" and not found.checkpoints:
        return Revive(found.task_id)
    checkpoint = newest(found.checkpoints)
    body = survey.revival(found.task_id, checkpoint, found.service)
    if body is None:
        raise ControlRefusedError(f"{checkpoint.agent} holds another checkpoint of {found.task_id} by now: try again")
    return body
