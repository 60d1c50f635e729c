"""`pancakes task revive`: a task whose agent is gone for good runs again on another."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import click
import msgspec

from pancakes.client import Client
from pancakes.control import Checkpoints, HeldCheckpoint, Reschedule, Revive
from pancakes.errors import ControlRefused, PancakesError
from pancakes.tools.cli.asking import accepted, meant
from pancakes.tools.cli.consent import accepted_if_meant, force_option
from pancakes.tools.cli.name_types import AGENT_NAME, TaskName, a_task
from pancakes.tools.cli.options import Ask, dry_run_option, orders_agents
from pancakes.tools.cli.output import DRY_RUN

if TYPE_CHECKING:
    from pancakes.runtime.config.tables import TaskConfig

RUNS = ("running", "starting", "restarting", "stuck")


@click.command()
@a_task
@click.option(
    "--config", "path", metavar="FILE", default="", help="Begin anew, as FILE says: the lost agent's configuration."
)
@click.option(
    "--set", "sets", metavar="KEY=VALUE", multiple=True, help="Put VALUE in place of what FILE has. Repeatable."
)
@click.option(
    "--birthplace",
    metavar="AGENT",
    type=AGENT_NAME,
    default="",
    help="Where it was born, if checkpoints of two of its name are held. [with --config: FILE's agent]",
)
@force_option
@dry_run_option
@orders_agents
def revive(
    name: TaskName, path: str, sets: tuple[str, ...], birthplace: str, force: bool, dry_run: bool, ask: Ask
) -> None:
    """Run a task on AGENT whose own agent is gone for good: from the newest checkpoint that any agent holds of it.

    Guardians hold checkpoints of guarded tasks, and agents whose hand-off is in doubt hold that of any task. Where no
    agent holds one, --config says with what it begins anew: its state is lost then.

    It runs under an epoch above all that can be known of it, so actuators obey it, and packets for it come to AGENT.
    Where the lost agent comes back, its copy stands still once the two are linked. It is said which checkpoint it would
    go on from, and what it may cost, and asked; if this is no terminal, nothing is done without --force, and the exit
    code is 1.

    A guarded task that stands still on AGENT, because more than half of its guardians are gone for good, goes on as it
    stands. Where more than half are there, see `pancakes task take`.

    \b
    Example:
        pancakes task revive agent2/ScanTarget
        pancakes task revive agent2/ScanTarget --force
        pancakes task revive agent2/ScanTarget --config agent1.toml --force
    """
    if sets and not path:
        raise click.UsageError("--set changes what FILE has: say --config FILE too")
    with ask.client() as client:
        name = meant(client, name)
        body, rate_hz = _configured(path, sets, name, birthplace) if path else (None, None)
        birthplace = body.task_id.partition("/")[0] if body is not None else birthplace
        held = _held(client, Checkpoints(name.task, birthplace))
        services = {name.service} if name.service else {body.service} if body else {row["service"] for row in held}
        here = _must_be_lost(client, name, services, held)
        body = body or (Revive(here) if here and not held else _from_newest(client, name, held))
        seen = max((row["seen"] for row in held), default=0)
        made = msgspec.structs.replace(body, seen=seen)
        reply = accepted_if_meant(
            client,
            name.agent,
            lambda forced, dry: msgspec.structs.replace(made, force=forced or dry, dry_run=dry),
            force,
            dry_run,
        )
        if rate_hz is not None and not dry_run:
            accepted(client, name.agent, Reschedule(f"{body.service}/{name.task}", rate_hz))
    done = {"task_id": reply.result["task_id"], "done": DRY_RUN if dry_run else "revived", "number": reply.number}
    goes_on_from = name_of(newest(held)) if body.checkpoint is not None else ""
    ask.show([{"agent": name.agent, **done, "from": goes_on_from}], ("agent", *done, "from"))


def _configured(path: str, sets: Sequence[str], name: TaskName, birthplace: str) -> tuple[Revive, float | None]:
    """Returns how the task begins anew, and at what rate; None: as its class says."""
    from pancakes.runtime.config import load
    from pancakes.runtime.plugins import Plugins

    config = load(path, sets, Plugins())
    task: TaskConfig | None = config.tasks.get(name.task)
    if task is None:
        raise PancakesError(f"{config.path} has no [task.{name.task}]: it has {', '.join(config.tasks) or 'no task'}")
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
    replies = client.ask_each(asked).replies
    return [row for _, reply in replies if reply.ok for row in reply.result]


def _must_be_lost(client: Client, name: TaskName, services: set[str], held: Sequence[dict[str, Any]]) -> str:
    """Looks whether the task runs, or is about to be taken over.

    Args:
        client: asks the agents.
        name: the task.
        services: those that may look after it; empty: any.
        held: the checkpoints of it that agents hold.

    Returns:
        Its id, where it stands still on the agent that is to go on with it; else an empty text.

    Raises:
        ControlRefused: it does.
    """
    for agent in client.survey().agents:
        for row in agent["tasks"]:
            meant_here = row["task"] == name.task and row["service"] in (services or {row["service"]})
            if not meant_here or row["state"] not in RUNS:
                continue
            if row.get("guarding") is None or row["guarding"]["permit_s"]:
                raise ControlRefused(f"{name.task} is {row['state']} on {agent['agent']}: it is not lost")
            if agent["agent"] != name.agent:
                raise ControlRefused(
                    f"{name.task} stands still on {agent['agent']}, with its state: `pancakes task revive"
                    f" {agent['agent']}/{name.task}` has it go on there without its guardians"
                )
            return str(row["guarding"]["task_id"])
    guarding = [row for row in held if row["guardians"]]
    if guarding and has_quorum(newest(guarding), guarding):
        row = newest(guarding)
        raise ControlRefused(
            f"more than half of the guardians of {row['task_id']} answer, so it is not lost: they have another agent go"
            f" on with it by themselves, or at `pancakes task take {row['agent']}/{name.task}`"
        )
    return ""


def newest(held: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Returns the newest of some checkpoints."""
    return max(held, key=lambda row: (row["epoch"], row["no"], row["agent"]))


def has_quorum(row: dict[str, Any], held: Iterable[dict[str, Any]]) -> bool:
    """Returns whether more than half of the guardians of a task, as one of them knows them, hold checkpoints."""
    there = {one["agent"] for one in held if one["task_id"] == row["task_id"]}
    return all(2 * len(there.intersection(agents)) > len(agents) for agents in row["guardians"])


def name_of(row: dict[str, Any]) -> str:
    """Returns how a checkpoint is called."""
    n, minter = row["epoch"]
    return f"{n}@{minter}/{row['no']}"


def story_of(row: dict[str, Any]) -> str:
    """Returns which checkpoint it is, how old it is and where it is held, as a clause."""
    stopped = "" if row["wanted"] == "running" else f", of a task that was to be {row['wanted']}"
    if row["age_s"] is None:
        return f"the snapshot of the hand-off {row['epoch'][0]}@{row['epoch'][1]}, held by {row['agent']}{stopped}"
    least = "at least " if row["at_least"] else ""
    return f"checkpoint {name_of(row)}, {least}{row['age_s']:.1f} s old, held by {row['agent']}{stopped}"


def _from_newest(client: Client, name: TaskName, held: Sequence[dict[str, Any]]) -> Revive:
    """Fetches the newest checkpoint, and returns how the task goes on from it.

    Raises:
        ControlRefused: no agent holds one, or those of several tasks can be meant.
    """
    if not held:
        raise ControlRefused(
            f"no agent that answers holds a checkpoint of {name.task}: with --config FILE, where FILE is the"
            f" configuration of the agent that is lost, it begins anew on {name.agent}"
        )
    ids = sorted({row["task_id"] for row in held})
    if len(ids) > 1:
        raise ControlRefused(f"checkpoints of {' and '.join(ids)} are held: say which --birthplace is meant")
    row = newest(held)
    asked = Checkpoints(name.task, row["task_id"].partition("/")[0], body=True)
    bodies = accepted(client, row["agent"], asked).result
    body = next((it for it in bodies if (it["epoch"], it["no"]) == (row["epoch"], row["no"])), None)
    if body is None:
        raise ControlRefused(f"{row['agent']} holds another checkpoint of {row['task_id']} by now: ask again")
    checkpoint = HeldCheckpoint(body["snapshot"], tuple(row["epoch"]), row["no"], story_of(row))
    return Revive(row["task_id"], service=name.service or row["service"], checkpoint=checkpoint)
