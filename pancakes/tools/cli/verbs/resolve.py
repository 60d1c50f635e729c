"""`pancakes task resolve`: two agents own one task, and a person decides which of the two lives."""

from __future__ import annotations

from typing import Any, Final

import click

from pancakes.client import Client
from pancakes.control import Adopt, Forget, Stop
from pancakes.errors import ControlRefused, PancakesError
from pancakes.tools.cli.asking import accepted, placed
from pancakes.tools.cli.consent import force_option, must_be_meant
from pancakes.tools.cli.name_types import AGENT_NAME, TaskName, a_task
from pancakes.tools.cli.options import Ask, dry_run_option, orders_agents
from pancakes.tools.cli.output import DRY_RUN

COLUMNS: Final = ("agent", "task_id", "epoch", "was", "becomes")
DISPUTED: Final = "disputed"


@click.command()
@a_task
@click.option(
    "--birthplace", metavar="AGENT", type=AGENT_NAME, default="", help="Where it was born, if two bear its name."
)
@force_option
@dry_run_option
@orders_agents
def resolve(name: TaskName, birthplace: str, force: bool, dry_run: bool, ask: Ask) -> None:
    """Decide that of a task that two agents own the one on AGENT lives, with its state; the other is given up.

    Two agents own a task after a backup was restored, a disk was cloned or emptied, or a task was adopted by mistake.
    They notice it when they are linked: the one with the lower epoch stands still, with equal epochs both do. The one
    that is given up is stopped, its state is gone, and packets for it go to AGENT.

    \b
    Example:
        pancakes task resolve agent1/ScanTarget --dry-run
        pancakes task resolve agent1/ScanTarget --force
    """
    with ask.client() as client:
        name = placed(client, name)
        agents = client.survey().agents
        here = next((_task(agent, name) for agent in agents if agent["agent"] == name.agent), None)
        if here is None:
            raise ControlRefused(f"{name.agent} has no task {name.task}")
        if here["rest"] == "forgotten" or here["rest"].startswith("moved"):
            raise ControlRefused(f"{name} is not owned by {name.agent}: {here['rest']}")
        others = [_owner(client, agent["agent"], name, birthplace) for agent in agents if agent["agent"] != name.agent]
        owners = [owner for owner in others if owner is not None]
        rests = here["rest"] == DISPUTED
        if not owners and not rests:
            raise ControlRefused(f"{name} is owned by {name.agent} alone, as far as the agents that answer know")
        if not owners and not force:
            raise ControlRefused(
                f"the other owner of {name} does not answer: {here['reason']}. With --force it lives here all the same,"
                " and the other one stands still when it is back"
            )
        given_up = ", ".join(f"{owner['task_id']} on {owner['agent']}" for owner in owners)
        if owners:
            must_be_meant(f"{given_up} is given up, and its state is lost; {name} lives", force, dry_run)
        rows = [_row(owner, "given up") for owner in owners]
        for owner in owners if not dry_run else ():
            if owner["runs"]:
                accepted(client, owner["agent"], Stop(name.target))
            accepted(client, owner["agent"], Forget(name.target, birthplace, name.agent))
        living = {"agent": name.agent, "task_id": rows[0]["task_id"] if rows else "", "epoch": ""}
        if rests:
            reply = accepted(client, name.agent, Adopt(name.target, True, birthplace, dry_run))
            living["task_id"] = reply.result["task_id"]
    was = "at rest" if rests else here["state"]
    rows.append({**living, "was": was, "becomes": "running" if rests else was})
    ask.show([{**row, "done": DRY_RUN if dry_run else "resolved"} for row in rows], (*COLUMNS, "done"))


def _task(agent: dict[str, Any], name: TaskName) -> dict[str, Any] | None:
    found = [it for it in agent["tasks"] if it["task"] == name.task and it["service"] == name.service]
    return found[0] if found else None


def _owner(client: Client, agent: str, name: TaskName, birthplace: str) -> dict[str, Any] | None:
    """Returns what an agent says of a task that it owns too; None: it does not."""
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
