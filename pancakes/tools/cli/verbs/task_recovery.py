"""`pancakes task guards|take|revive|resolve|fence`: recover tasks whose owner is lost or disputed.

`take` makes a guardian take over, `revive` starts a task from the newest checkpoint that any agent holds, `resolve`
decides between two owners, and `fence` shows and sets the epochs that an actuator has seen.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

import click
import msgspec

from pancakes.client import Client
from pancakes.control import (
    Adopt,
    Checkpoints,
    Describe,
    Forget,
    Guarding,
    HeldCheckpoint,
    Reschedule,
    Revive,
    SetFence,
    Stop,
    Take,
)
from pancakes.durable.record import TaskId
from pancakes.errors import ControlRefusedError, MigrationError, PancakesError
from pancakes.packet import join
from pancakes.tools.cli.agent_requests import (
    ask_each,
    confirm,
    force_option,
    request,
    request_confirmed,
    request_result,
    resolve_fleet,
    resolve_service,
)
from pancakes.tools.cli.options import (
    TASK_NAME,
    Ask,
    TaskName,
    a_task,
    agents,
    asks_agents,
    asks_agents_for,
    dry_run_option,
    orders_agents,
)
from pancakes.tools.cli.output import DRY_RUN
from pancakes.tools.cli.verbs.agent_checks import is_awaited
from pancakes.tools.cli.verbs.task_arguments import birthplace_option

if TYPE_CHECKING:
    from pancakes.client import Client
    from pancakes.config.tables import TaskConfig


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


@click.command()
@a_task
@birthplace_option("Where the task was born, if two tasks have this name.")
@dry_run_option
@asks_agents_for(10.0)
def take(name: TaskName, birthplace: str, dry_run: bool, ask: Ask) -> None:
    """Make the guardians take over a guarded task whose owner is silent; AGENT is one of them.

    Guardians take over by themselves, unless the task has `takeover = "ask"`. A quorum (more than half) of them must
    report the owner as silent. --dry-run shows the agent that would take over, and the newest checkpoint. What the
    task did after that checkpoint is lost: `age_s` is the checkpoint's age when the owner was last heard, and
    `silent_s` is the time since then.

    \b
    Example:
        pancakes task take agent2/ScanTarget --dry-run
        pancakes task take agent2/ScanTarget
    """
    with ask.client() as client:
        result = request(client, name.agent, Take(name.task, birthplace, dry_run)).result
    row = {"task_id": result["task_id"], "taker": result["winner"], "done": DRY_RUN if dry_run else "taken over"}
    row |= {key: result[key] for key in ("checkpoint", "age_s", "silent_s")}
    ask.printer.table([row], tuple(row))


RUNS = ("running", "starting", "restarting", "stuck")


@click.command()
@a_task
@click.option(
    "--config",
    "path",
    metavar="FILE",
    default="",
    help="Begin from scratch, as FILE (the configuration of the lost agent) says.",
)
@click.option(
    "--set", "sets", metavar="KEY=VALUE", multiple=True, help="Override a key of FILE with VALUE. Repeatable."
)
@birthplace_option("Where the task was born, if two tasks have this name. [with --config: FILE's agent]")
@force_option
@dry_run_option
@orders_agents
def revive(
    name: TaskName, path: str, sets: tuple[str, ...], birthplace: str, force: bool, dry_run: bool, ask: Ask
) -> None:
    """Run a task of an agent that is gone for good on AGENT, from the newest checkpoint that any agent holds.

    Guardians hold checkpoints of guarded tasks. An agent whose hand-off of a task is in doubt holds one of that task,
    guarded or not. If no agent holds a checkpoint, pass --config: the task begins from scratch, and its state is lost.

    The task runs under an epoch above all known ones, so actuators obey it, and packets for it come to AGENT.
    If the lost agent comes back, its copy is paused once the two agents are linked. The command shows the checkpoint
    and the consequences, and asks; if this is not a terminal, --force is required.

    A guarded task that is paused on AGENT because more than half of its guardians are gone for good continues with its
    present state. If more than half of them answer, use `pancakes task take` instead.

    \b
    Example:
        pancakes task revive agent2/ScanTarget
        pancakes task revive agent2/ScanTarget --force
        pancakes task revive agent2/ScanTarget --config agent1.toml --force
    """
    if sets and not path:
        raise click.UsageError("--set overrides a key of FILE: pass --config FILE too")
    with ask.client() as client:
        name = resolve_fleet(client, name)
        body, rate_hz = _configured(path, sets, name, birthplace) if path else (None, None)
        birthplace = body.task_id.partition("/")[0] if body is not None else birthplace
        held = _held(client, Checkpoints(name.task, birthplace))
        services = {name.service} if name.service else {body.service} if body else {row["service"] for row in held}
        here = _must_be_lost(client, name, services, held)
        body = body or (Revive(here) if here and not held else _from_newest(client, name, held))
        seen = max((row["seen"] for row in held), default=0)
        revival = msgspec.structs.replace(body, seen=seen)
        reply = request_confirmed(
            client,
            name.agent,
            lambda forced, dry: msgspec.structs.replace(revival, force=forced or dry, dry_run=dry),
            force,
            dry_run,
        )
        if rate_hz is not None and not dry_run:
            request(client, name.agent, Reschedule(f"{body.service}/{name.task}", rate_hz))
    done = {"task_id": reply.result["task_id"], "done": DRY_RUN if dry_run else "revived", "number": reply.number}
    checkpoint = name_of(newest(held)) if body.checkpoint is not None else ""
    ask.printer.table([{"agent": name.agent, **done, "from": checkpoint}], ("agent", *done, "from"))


def _configured(path: str, sets: Sequence[str], name: TaskName, birthplace: str) -> tuple[Revive, float | None]:
    """Return how the task begins from scratch, and its rate; None: the rate of its class."""
    from pancakes.config import load
    from pancakes.util.plugins import Plugins

    config = load(path, sets, Plugins())
    task: TaskConfig | None = config.tasks.get(name.task)
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
        msgspec.to_builtins(task.guard_rule) if task.guard_rule is not None else None,
    )
    return body, task.rate_hz


def _held(client: Client, asked: Checkpoints) -> list[dict[str, Any]]:
    replies = client.request_all(asked).replies
    return [row for _, reply in replies if reply.ok for row in reply.result]


def _must_be_lost(client: Client, name: TaskName, services: set[str], held: Sequence[dict[str, Any]]) -> str:
    """Check that the task neither runs nor is about to be taken over.

    Args:
        client: asks the agents.
        name: the task.
        services: the services that may run it; empty: any.
        held: its checkpoints that agents hold.

    Returns:
        The task's id if it is paused on the agent that should run it; otherwise an empty text.

    Raises:
        ControlRefusedError: it runs, or is about to be taken over.
    """
    for agent in client.describe().agents:
        for row in agent["tasks"]:
            meant_here = row["task"] == name.task and row["service"] in (services or {row["service"]})
            if not meant_here or row["state"] not in RUNS:
                continue
            if row.get("guarding") is None or row["guarding"]["permit_s"]:
                raise ControlRefusedError(f"{name.task} is {row['state']} on {agent['agent']}: it is not lost")
            if agent["agent"] != name.agent:
                raise ControlRefusedError(
                    f"{name.task} is paused on {agent['agent']}, with its state: `pancakes task revive"
                    f" {agent['agent']}/{name.task}` resumes it there without its guardians"
                )
            return str(row["guarding"]["task_id"])
    guarding = [row for row in held if row["guardians"]]
    if guarding and has_quorum(newest(guarding), guarding):
        row = newest(guarding)
        raise ControlRefusedError(
            f"more than half of the guardians of {row['task_id']} answer, so it is not lost: one of them takes over"
            f" by itself, or after `pancakes task take {row['agent']}/{name.task}`"
        )
    return ""


def newest(held: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Return the newest of some checkpoints."""
    return max(held, key=lambda row: (row["epoch"], row["no"], row["agent"]))


def has_quorum(row: dict[str, Any], held: Iterable[dict[str, Any]]) -> bool:
    """Return whether more than half of a task's guardians, according to one of them, hold checkpoints."""
    holders = {one["agent"] for one in held if one["task_id"] == row["task_id"]}
    return all(2 * len(holders.intersection(agents)) > len(agents) for agents in row["guardians"])


def name_of(row: dict[str, Any]) -> str:
    """Return the name of a checkpoint, `EPOCH@MINTER/NUMBER`."""
    n, minter = row["epoch"]
    return f"{n}@{minter}/{row['no']}"


def story_of(row: dict[str, Any]) -> str:
    """Describe a checkpoint, its age and its holder in a clause."""
    stopped = "" if row["wanted"] == "running" else f", of a task that should be {row['wanted']}"
    if row["age_s"] is None:
        return f"the snapshot of the hand-off {row['epoch'][0]}@{row['epoch'][1]}, held by {row['agent']}{stopped}"
    least = "at least " if row["at_least"] else ""
    return f"checkpoint {name_of(row)}, {least}{row['age_s']:.1f} s old, held by {row['agent']}{stopped}"


def _from_newest(client: Client, name: TaskName, held: Sequence[dict[str, Any]]) -> Revive:
    """Fetch the newest checkpoint, and return the request that starts the task from it.

    Raises:
        ControlRefusedError: no agent holds a checkpoint, or the held ones are of several tasks.
    """
    if not held:
        raise ControlRefusedError(
            f"no agent that answers holds a checkpoint of {name.task}. To start it from scratch on {name.agent}, pass"
            " --config FILE with the configuration of the lost agent"
        )
    ids = sorted({row["task_id"] for row in held})
    if len(ids) > 1:
        raise ControlRefusedError(f"agents hold checkpoints of {' and '.join(ids)}: choose one with --birthplace")
    row = newest(held)
    asked = Checkpoints(name.task, row["task_id"].partition("/")[0], body=True)
    bodies = request(client, row["agent"], asked).result
    body = next((it for it in bodies if (it["epoch"], it["no"]) == (row["epoch"], row["no"])), None)
    if body is None:
        raise ControlRefusedError(f"{row['agent']} holds another checkpoint of {row['task_id']} by now: try again")
    checkpoint = HeldCheckpoint(body["snapshot"], tuple(row["epoch"]), row["no"], story_of(row))
    return Revive(row["task_id"], service=name.service or row["service"], checkpoint=checkpoint)


RESOLVE_COLUMNS: Final = ("agent", "task_id", "epoch", "was", "becomes")
DISPUTED: Final = "disputed"


@click.command()
@a_task
@birthplace_option("Where the task was born, if two tasks have this name.")
@force_option
@dry_run_option
@orders_agents
def resolve(name: TaskName, birthplace: str, force: bool, dry_run: bool, ask: Ask) -> None:
    """Keep the copy on AGENT of a task that two agents own, with its state, and give up the other copy.

    Two agents own a task if a backup was restored, a disk was cloned or emptied, or the task was adopted by mistake.
    They notice it when they are linked: the copy with the lower epoch is paused; if the epochs are equal, both are. The
    copy that is given up stops, its state is lost, and packets for the task go to AGENT.

    \b
    Example:
        pancakes task resolve agent1/ScanTarget --dry-run
        pancakes task resolve agent1/ScanTarget --force
    """
    with ask.client() as client:
        name = resolve_service(client, name)
        agents = client.describe().agents
        here = next((_task(agent, name) for agent in agents if agent["agent"] == name.agent), None)
        if here is None:
            raise ControlRefusedError(f"{name.agent} has no task {name.task}")
        if here["rest"] == "forgotten" or here["rest"].startswith("moved"):
            raise ControlRefusedError(f"{name} is not owned by {name.agent}: {here['rest']}")
        others = [_owner(client, agent["agent"], name, birthplace) for agent in agents if agent["agent"] != name.agent]
        owners = [owner for owner in others if owner is not None]
        is_disputed = here["rest"] == DISPUTED
        if not owners and not is_disputed:
            raise ControlRefusedError(f"{name} is owned only by {name.agent}, as far as the agents that answer know")
        if not owners and not force:
            raise ControlRefusedError(
                f"the other owner of {name} does not answer: {here['reason']}. With --force this copy is kept anyway,"
                " and the other copy is paused when it is back"
            )
        given_up = ", ".join(f"{owner['task_id']} on {owner['agent']}" for owner in owners)
        if owners:
            confirm(f"this keeps {name} and gives up {given_up}, whose state is lost", force, dry_run)
        rows = [_row(owner, "given up") for owner in owners]
        for owner in owners if not dry_run else ():
            if owner["runs"]:
                request(client, owner["agent"], Stop(name.target))
            request(client, owner["agent"], Forget(name.target, birthplace, name.agent))
        kept = {"agent": name.agent, "task_id": rows[0]["task_id"] if rows else "", "epoch": ""}
        if is_disputed:
            reply = request(client, name.agent, Adopt(name.target, True, birthplace, dry_run))
            kept["task_id"] = reply.result["task_id"]
    was = "at rest" if is_disputed else here["state"]
    rows.append({**kept, "was": was, "becomes": "running" if is_disputed else was})
    ask.printer.table([{**row, "done": DRY_RUN if dry_run else "resolved"} for row in rows], (*RESOLVE_COLUMNS, "done"))


def _task(agent: dict[str, Any], name: TaskName) -> dict[str, Any] | None:
    found = [it for it in agent["tasks"] if it["task"] == name.task and it["service"] == name.service]
    return found[0] if found else None


def _owner(client: Client, agent: str, name: TaskName, birthplace: str) -> dict[str, Any] | None:
    """Return an agent's description of a task that it owns too; None if it does not own it."""
    try:
        reply = client.request(agent, Forget(name.target, birthplace, name.agent, dry_run=True))
    except PancakesError:
        return None
    return {**reply.result, "agent": agent} if reply.ok else None


def _row(owner: dict[str, Any], becomes: str) -> dict[str, Any]:
    was = "running" if owner["runs"] else "at rest"
    return {
        "agent": owner["agent"],
        "task_id": owner["task_id"],
        "epoch": owner["epoch"],
        "was": was,
        "becomes": becomes,
    }


FENCE_COLUMNS = ("actuator", "task_id", "seen", "brought_by", "owner", "owner_has", "obeyed", "reason")
"""The epoch of a task that the actuator has seen, and the task's present owner and epoch, or why they are unknown."""


@click.command()
@click.argument("name", metavar="AGENT/ACTUATOR", type=TASK_NAME)
@click.option(
    "--set", "task_id", metavar="BIRTHPLACE/NAME", default="", help="Set the fence for this task to its present epoch."
)
@force_option
@dry_run_option
@orders_agents
def fence(name: TaskName, task_id: str, force: bool, dry_run: bool, ask: Ask) -> None:
    """Show which tasks have commanded an actuator, and whether it obeys their present owners.

    An actuator refuses an epoch of a task that is lower than the highest it has seen, so an old copy of the task
    cannot move it. It accepts a higher epoch only from an agent that is known to have been given the task. If the
    agents that could confirm this are gone, or something brought too high an epoch, the task is refused, and the log
    has the reason.

    With --set the actuator goes to its safe hold, and the fence is set to the epoch under which the task runs now. The
    actuator's agent asks all agents that it is connected to. It refuses if one of them does not answer, or if none of
    them has the task; if two have it, the higher epoch counts. So check first, with `pancakes task list`, that the task
    runs only once. The command asks first; if this is not a terminal, --force is required.
    `pancakes task migrations` lists each change of a fence.

    \b
    Example:
        pancakes task fence agent1/motors
        pancakes task fence agent1/motors --set agent1/ScanTarget --dry-run
        pancakes task fence agent1/motors --set agent1/ScanTarget
    """
    if dry_run and not task_id:
        raise click.UsageError("--dry-run checks what --set would do: pass --set too")
    if force and not task_id:
        raise click.UsageError("--force is for --set: pass --set too")
    if task_id:
        try:
            TaskId.parse(task_id)
        except MigrationError as error:
            raise click.BadParameter(str(error), param_hint="--set") from None
    with ask.client() as client:
        name = resolve_service(client, name)
        if task_id:
            if not (force or dry_run):
                request(client, name.agent, SetFence(name.target, task_id, dry_run=True))
                confirm(f"{name} would go to its safe hold and forget the epoch of {task_id} that it has seen", force)
            reply = request(client, name.agent, SetFence(name.target, task_id, dry_run))
            row = {**reply.result, "done": DRY_RUN if dry_run else "set", "number": reply.number}
            ask.printer.table([row], tuple(row))
            return
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
