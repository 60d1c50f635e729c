"""`pancakes halt`: bring all actuators of a fleet to their safe hold, until a person ends that."""

from __future__ import annotations

import secrets
import sys
from typing import Any

import click

from pancakes.client import Client
from pancakes.control import EndHalt, Halt, Reply
from pancakes.tools.cli.agent_requests import confirm, yes_option
from pancakes.tools.cli.exit_codes import OK, REFUSED, UNREACHABLE
from pancakes.tools.cli.options import Ask, agents, asks_agents, dry_run_option
from pancakes.tools.cli.output import DRY_RUN, show_text

COLUMNS = ("agent", "done", "stopped", "late", "by", "reason")


@click.command()
@agents
@click.option("--reason", metavar="TEXT", default="", help="Why, for everybody who looks.")
@click.option("--end", "ends", is_flag=True, help="End it: the actuators may move again.")
@yes_option
@dry_run_option
@asks_agents
def halt(agents: tuple[str, ...], reason: str, ends: bool, force: bool, dry_run: bool, ask: Ask) -> None:
    """Bring all actuators of all agents to their safe hold at once, and keep them there.

    Each agent that hears of it tells its neighbours, so it also reaches agents that this command cannot. From then on
    every command is refused. Tasks keep running. It survives a restart of an agent, and an agent that comes later halts
    too. Only a person ends it, with --end. With names it is only for those agents, and they tell nobody.

    --end asks first, because what tasks command is carried out at once; if this is not a terminal, --yes is required.
    It reaches only agents that answer: repeat it for the others.

    The exit code is 1 if an actuator does not stand yet or an agent refuses, and 3 if an agent does not answer.

    \b
    Example:
        pancakes halt --reason "a child on the field"
        pancakes halt agent1
        pancakes halt --end
    """
    if ends and reason:
        raise click.UsageError("--reason is for a halt, not for its end")
    with ask.client() as client:
        if ends:
            replies, silent = _end(client, agents, force, dry_run)
        else:
            found = client.request_all(Halt(reason, not agents, dry_run, secrets.token_hex(8)), *agents)
            replies, silent = found.replies, found.silent
    rows, refused = [], []
    for agent, reply in replies:
        if not reply.ok:
            refused.append(f"{agent} refused: {reply.reason}" if agent not in reply.reason else reply.reason)
            continue
        rows.append(_row(agent, reply.result, DRY_RUN if dry_run else "ended" if ends else "halted"))
        if why := reply.result["not_on_disk"]:
            what = "is halted again" if ends else "may move again"
            show_text(f"{agent} {what} if it is restarted: that is not on its disk ({why})", err=True)
    ask.printer.table(rows, COLUMNS)
    for sentence in (*refused, *silent):
        show_text(sentence, err=True)
    late = not ends and not dry_run and any(row["late"] for row in rows)
    sys.exit(UNREACHABLE if silent else REFUSED if refused or late else OK)


def _end(
    client: Client, agents: tuple[str, ...], force: bool, dry_run: bool
) -> tuple[list[tuple[str, Reply]], list[str]]:
    """End the halts that last now, and none that begins while the person is asked.

    Returns:
        What each agent has replied, and a sentence for each that did not.
    """
    described = client.describe(*agents)
    halted = {it["agent"]: it["halt"]["id"] for it in described.agents if it.get("halt")}
    if not halted:
        found = client.request_all(EndHalt(dry_run), *agents)
        return found.replies, found.silent
    if not (force or dry_run):
        confirm(f"the actuators of {', '.join(halted)} may move at once", force)
    asked = [(id, [name for name, its in halted.items() if its == id]) for id in dict.fromkeys(halted.values())]
    if others := [it["agent"] for it in described.agents if agents and it["agent"] not in halted]:
        asked.append(("", others))
    answers = [client.request_all(EndHalt(dry_run, id), *names) for id, names in asked]
    silent = dict.fromkeys((*described.silent, *(text for it in answers for text in it.silent)))
    return sorted((row for it in answers for row in it.replies), key=lambda row: row[0]), list(silent)


def _row(agent: str, result: dict[str, Any], done: str) -> dict[str, Any]:
    halted = result["halt"] or {}
    return {
        "agent": agent,
        "done": done,
        "stopped": result["actuators"],
        "late": result["late"],
        "by": halted.get("by", "").partition("/")[0],
        "reason": halted.get("reason", ""),
    }
