"""`pancakes task recover|guards|fence`: look after tasks whose owner is lost, silent or disputed.

`recover` says what happened to a task, and sets it right; what happened and what to do is decided in
`pancakes.tools.recovery.diagnosis`, and here a person is asked. `guards` and `fence` only show.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final

import click

from pancakes.control import Describe, Guarding, SetFence
from pancakes.errors import ControlRefusedError, PancakesError
from pancakes.packet import join
from pancakes.tools.cli.agent_requests import (
    ask_each,
    confirm,
    request_result,
    resolve_fleet,
    resolve_service,
    yes_option,
)
from pancakes.tools.cli.exit_codes import OK, REFUSED
from pancakes.tools.cli.options import (
    TASK_NAME,
    Ask,
    TaskName,
    agents,
    asks_agents,
    dry_run_option,
    orders_agents,
)
from pancakes.tools.cli.output import DRY_RUN, Part, Rows, show_text
from pancakes.tools.cli.verbs.agent_checks import is_awaited
from pancakes.tools.cli.verbs.task_arguments import birthplace_option

if TYPE_CHECKING:
    from pancakes.client import Client
    from pancakes.tools.recovery.acting import Beginning
    from pancakes.tools.recovery.diagnosis import Choice, Diagnosis, Findings
    from pancakes.tools.recovery.looking import Survey

GUARD_COLUMNS: Final = ("task_id", "owner", "permit_s", "guardian", "checkpoint", "age_s", "silent_s", "state")


@click.command()
@agents
@asks_agents
def guards(agents: tuple[str, ...], ask: Ask) -> None:
    """List the guarded tasks of all agents, or only of those named, with a line for each guardian.

    A guardian that does not answer is listed as silent. `permit_s` is the time for which the owner may still act, and
    is empty if it may not. `age_s` is the age of the guardian's newest checkpoint. `silent_s` is the time since the
    guardian last heard the owner.

    \b
    Example:
        pancakes task guards
        pancakes task guards agent1 --format json
    """
    rows = [row for _, answer in ask_each(ask, Guarding(), *agents) for row in answer]
    owners = {(row["task_id"], row["epoch"]): row for row in rows if "guardians" in row}
    shown = [_shown(row, owners.get((row["task_id"], row["epoch"]))) for row in rows]
    for (task_id, epoch), owner in owners.items():
        heard = {row["agent"] for row in rows if row["task_id"] == task_id and row["epoch"] == epoch}
        for name in owner["guardians"]:
            if name not in heard and not agents:
                row = {"task_id": task_id, "owner": owner["owner"], "guardian": name, "state": "silent"}
                shown.append({**dict.fromkeys(GUARD_COLUMNS), **row, "permit_s": _permit(owner)})
    ask.printer.table(sorted(shown, key=lambda row: (row["task_id"], row["guardian"])), GUARD_COLUMNS)


def _shown(row: dict[str, Any], owner: dict[str, Any] | None) -> dict[str, Any]:
    state = "guards" if row["lease"] else "owner silent"
    if is_awaited(row):
        state = f"owner silent, its lease ends in {row['lease_left_s']:.0f} s"
    return {**row, "guardian": row["agent"], "permit_s": _permit(owner), "state": state}


def _permit(owner: dict[str, Any] | None) -> float | None:
    return owner["permit_s"] or None if owner is not None else None


FENCE_COLUMNS = ("actuator", "task_id", "seen", "brought_by", "owner", "owner_has", "obeyed", "reason")
"""The epoch of a task that the actuator has seen, and the task's present owner and epoch, or why they are unknown."""


@click.command()
@click.argument("name", metavar="AGENT/ACTUATOR", type=TASK_NAME)
@asks_agents
def fence(name: TaskName, ask: Ask) -> None:
    """Show which tasks have commanded an actuator, and whether it obeys their present owners.

    An actuator refuses an epoch of a task that is lower than the highest it has seen, so an old copy of the task
    cannot move it. It accepts a higher epoch only from an agent that is known to have been given the task. If the
    agents that could confirm this are gone, or something brought too high an epoch, the task is refused, and the log
    has the reason. `pancakes task recover AGENT/TASK` sets that right; `pancakes task migrations` lists each such act.

    \b
    Example:
        pancakes task fence agent1/motors
        pancakes task fence agent1/motors --format json
    """
    with ask.client() as client:
        name = resolve_service(client, name)
        rows = fences_of(client, name.agent, name.target)
    ask.printer.table(rows, FENCE_COLUMNS)


def fences_of(client: Client, agent: str, target: str) -> list[dict[str, Any]]:
    """Return the epoch that an actuator has seen of each task that commanded it, and the task's present owner.

    Args:
        client: asks the agents.
        agent: the agent of the actuator.
        target: the actuator, as `service/device`.

    Raises:
        ControlRefusedError: the agent has no such device.
        UnreachableError: the agent does not answer.
    """
    rows: list[dict[str, Any]] = []
    for mark in request_result(client, agent, Describe(target)).get("fences", []):
        tried = client.request(agent, SetFence(target, mark["task_id"], dry_run=True))
        seen = f"{mark['epoch']}@{mark['minter']}"
        found = tried.result if tried.ok else {"owner": "", "now": ""}
        rows.append(
            {
                "actuator": join(agent, target),
                "task_id": mark["task_id"],
                "seen": seen,
                "brought_by": mark["brought_by"],
                "owner": found["owner"],
                "owner_has": found["now"],
                "obeyed": found["now"] == seen if tried.ok else None,
                "reason": tried.reason,
            }
        )
    return rows


RECOVER_COLUMNS: Final = ("task_id", "trouble", "proposal", "command")
COPY_COLUMNS: Final = ("agent", "state", "epoch", "reason")


@click.command()
@click.argument("name", metavar="[AGENT/TASK]", type=TASK_NAME, required=False)
@click.option("--here", is_flag=True, help="Run the task on AGENT, because it runs nowhere else.")
@click.option("--not-here", "not_here", is_flag=True, help="Give up what AGENT has of the task: it is elsewhere.")
@click.option(
    "--config",
    "path",
    metavar="FILE",
    default="",
    help="With --here: begin from scratch, as FILE (the configuration of the lost agent) says.",
)
@click.option(
    "--set", "sets", metavar="KEY=VALUE", multiple=True, help="Override a key of FILE with VALUE. Repeatable."
)
@birthplace_option("Where the task was born, if two tasks have this name. [with --config: FILE's agent]")
@yes_option
@dry_run_option
@orders_agents
def recover(
    name: TaskName | None,
    here: bool,
    not_here: bool,
    path: str,
    sets: tuple[str, ...],
    birthplace: str,
    force: bool,
    dry_run: bool,
    ask: Ask,
) -> None:
    """Say what happened to a task in trouble, and set it right; without AGENT/TASK, list the tasks in trouble.

    It asks all agents that can be reached. Then it says what happened (lost disk, restored backup, two owners, in
    doubt, guardians gone, given up, ...), what it proposes, and what would be lost. It does that once you confirm; if
    this is not a terminal, --yes is required. --dry-run only has the agents check it.

    The proposal is the mildest act that helps. If you know better, choose: --here runs the task on AGENT, --not-here
    gives up what AGENT has of it. AGENT is an agent that has the task, or the one that should run it.

    Only you can know whether a task also runs on an agent that does not answer. If it does, two copies run until the
    agents are linked again. Then one is paused, and this command keeps the one that you choose.

    The exit code is 0 if the task is in order, now or already, and 1 if it is not; 3 if no agent answers.

    \b
    Example:
        pancakes task recover
        pancakes task recover agent1/ScanTarget
        pancakes task recover agent1/ScanTarget --yes
        pancakes task recover agent2/ScanTarget --here
        pancakes task recover agent2/ScanTarget --here --config agent1.toml
    """
    from pancakes.tools.recovery.looking import Survey

    if here and not_here:
        raise click.UsageError("--here and --not-here contradict each other: give only one of them")
    if sets and not path:
        raise click.UsageError("--set overrides a key of FILE: pass --config FILE too")
    if path and not here:
        raise click.UsageError("--config says how the task begins on AGENT: pass --here too")
    if name is None and (here or not_here or birthplace or force or dry_run):
        raise click.UsageError("name the task to recover: AGENT/TASK. Without it, tasks in trouble are only listed")
    with ask.client() as client:
        if name is None:
            sys.exit(_list(ask, Survey(client)))
        name = resolve_fleet(client, name)
        choice: Choice = "here" if here else "not here" if not_here else ""
        beginning = _beginning(path, sets, name, birthplace) if path else None
        sys.exit(_recover(ask, client, Survey(client), name, birthplace, choice, beginning, path, force, dry_run))


def _list(ask: Ask, survey: Survey) -> int:
    """Print the tasks in trouble; return the exit code."""
    from pancakes.tools.recovery.diagnosis import diagnose

    for sentence in survey.silent:
        show_text(sentence, err=True)
    found: dict[str, tuple[str, Diagnosis]] = {}
    for asked in survey.suspects():
        try:
            told = diagnose(survey.look(asked))
        except ControlRefusedError as error:  # two tasks of one name; each is looked at for another agent
            show_text(f"{asked.agent}/{asked.task}: {error}", err=True)
            continue
        if told.trouble:
            found.setdefault(told.task_id, (f"{asked.agent}/{asked.task}", told))
    troubled = [found[task_id] for task_id in sorted(found)]
    rows = [
        {
            "task_id": it.task_id,
            "trouble": it.trouble,
            "proposal": it.proposal.text,
            "command": it.proposal.command or f"pancakes task recover {name}",
        }
        for name, it in troubled
    ]
    in_order = f"no task of {', '.join(survey.agents)} is in trouble"
    ask.printer.emit([_plain(it) for _, it in troubled], Rows(rows, RECOVER_COLUMNS) if rows else in_order)
    return REFUSED if rows else OK


def _recover(
    ask: Ask,
    client: Client,
    survey: Survey,
    name: TaskName,
    birthplace: str,
    choice: Choice,
    beginning: Beginning | None,
    path: str,
    force: bool,
    dry_run: bool,
) -> int:
    """Say what happened, ask, and do it; return the exit code."""
    from pancakes.tools.recovery.acting import DONE, carry_out
    from pancakes.tools.recovery.diagnosis import diagnose
    from pancakes.tools.recovery.looking import Asked, Survey

    asked = Asked(name.agent, name.task, name.service, birthplace)
    begins = beginning.body if beginning is not None else None
    found = survey.look(asked, choice == "here", begins, path)
    told = diagnose(found, choice)
    proposal = told.proposal
    for sentence in found.silent:
        show_text(sentence, err=True)
    ask.printer.tell(*_story(found, told))
    done, where = "", ""
    try:
        if proposal.act:
            using = beginning if proposal.act == "begin" else None
            carry_out(client, survey, found, proposal, using, dry_run=True)
            confirm(_question(told), force, dry_run)
            if not dry_run:
                where = carry_out(client, survey, found, proposal, using)
            done = DRY_RUN if dry_run else DONE[proposal.act]
    except ControlRefusedError:
        seen = Survey(client).look(asked)
        now = diagnose(seen)
        if now.trouble or all(copy.state != "running" for copy in seen.copies):
            raise
        told, proposal = now, now.proposal
        ask.printer.tell(f"It was set right meanwhile: {now.what}")
    finally:  # programs get the diagnosis also if it is declined or refused
        ask.printer.emit([{**_plain(told), "done": done, "runs_on": where}], *_ending(told, done, where))
    return OK if done or proposal.fine else REFUSED


def _beginning(path: str, sets: Sequence[str], name: TaskName, birthplace: str) -> Beginning:
    """Return how the task begins from scratch, as a configuration says."""
    import msgspec

    from pancakes.config import load
    from pancakes.control import Revive
    from pancakes.tools.recovery.acting import Beginning
    from pancakes.util.plugins import Plugins

    config = load(path, sets, Plugins())
    task = config.tasks.get(name.task)
    if task is None:
        raise PancakesError(f"{config.path} has no [task.{name.task}]. It has {', '.join(config.tasks) or 'no task'}")
    body = Revive(
        f"{birthplace or config.agent.name}/{name.task}",
        task.type,
        name.service or task.service,
        dict(task.settings),
        msgspec.to_builtins(task.restart),
        task.durability,
        msgspec.to_builtins(task.migrate) if task.migrate is not None else None,
        msgspec.to_builtins(task.guard) if task.guard is not None else None,
    )
    return Beginning(body, task.rate_hz)


# What people and programs see ------------------------------------------------------------------------------------


def _story(found: Findings, told: Diagnosis) -> Iterator[Part]:
    from pancakes.durable.record import MOVED

    yield f"{told.task_id}: {told.trouble or 'in order'}"
    yield told.what
    copies = [
        {"agent": it.agent, "state": it.rest or it.state or "in doubt", "epoch": it.epoch, "reason": it.reason}
        for it in found.copies
        if not (it.rest.startswith(MOVED) and len(found.copies) > 1)  # it is no copy any more
    ]
    if copies:
        yield Rows(copies, COPY_COLUMNS)
    proposal = told.proposal
    if proposal.act:
        only_if = {"only if": proposal.only_if} if proposal.only_if else {}
        yield {"what to do": {"proposal": proposal.text, "lost": proposal.lost or "nothing", **only_if}}
    else:
        yield f"What to do: {proposal.text}."
    for other in told.choices:
        lost = f" (lost: {other.lost})" if other.lost else ""
        yield f"Or {other.text}{lost}" + (f": {other.command}" if other.command else "")


def _question(told: Diagnosis) -> str:
    proposal = told.proposal
    only_if = f" Only if {proposal.only_if}" if proposal.only_if else ""
    return f"{proposal.text}? Lost: {proposal.lost or 'nothing'}.{only_if}".removesuffix(".")


def _ending(told: Diagnosis, done: str, where: str) -> Iterator[Part]:
    if done == DRY_RUN:
        yield "The agents would do it. Nothing was done (dry run)."
    elif done:
        yield f"Done: {told.task_id} runs on {where}." if where else f"Done: {told.proposal.text}."


def _plain(told: Diagnosis) -> dict[str, Any]:
    import msgspec

    return dict(msgspec.to_builtins(told))
