"""`pancakes task ...`: the tasks of agents."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

import click

from pancakes.cli.asking import accepted, order, placed, survey
from pancakes.cli.completing import timers
from pancakes.cli.names import TaskName, a_task, agents
from pancakes.cli.options import FiniteRange, asks_agents, dry_run_option, orders_agents
from pancakes.cli.output import DRY_RUN, show, show_json, show_sections
from pancakes.cli.verbs.migration import adopt, forget, migrate, migrations
from pancakes.client import Client, Where
from pancakes.control import Describe, Reschedule, Restart, Start, Stop
from pancakes.supervision import tries

COLUMNS = ("agent", "service", "task", "type", "state", "rate_hz")
LONG = (*COLUMNS, "incarnation", "ticks", "missed", "lateness_max_s", "dropped", "reason")
DONE = ("agent", "service", "task", "done", "number")
STATES = ("stopped", "starting", "running", "stopping", "stuck", "restarting", "failed")
"""The values of `pancakes.slot.TaskState`, which is not imported for them: a command has to be quick."""


@click.group()
def task() -> None:
    """Tasks that agents have; a device is a task too, and bears the device's name."""


task.add_command(migrate)
task.add_command(migrations)
task.add_command(adopt)
task.add_command(forget)


@task.command("list")
@agents
@click.option("--service", metavar="NAME", default="", help="Only tasks of the service of this name.")
@click.option("--type", "type_", metavar="PATTERN", default="*", help="Only tasks of these types: sim.*")
@click.option("--state", type=click.Choice(STATES), help="Only tasks in this state.")
@click.option("--long", "-l", is_flag=True, help="Also how often they began, what they missed, and why they stopped.")
@asks_agents
def list_(
    agents: tuple[str, ...],
    service: str,
    type_: str,
    state: str | None,
    long: bool,
    format_: str,
    at: Where,
    timeout: float,
) -> None:
    """List the tasks of all agents, or of those that are named.

    Who does not answer in time is named on standard error; the exit code is 3 where nobody answers.

    \b
    Example:
        pancakes task list
        pancakes task list agent1 --format json
        pancakes task list --service device --state running
    """
    rows = [
        row
        for found in survey(at, timeout, *agents)
        for row in found["tasks"]
        if service in ("", row["service"]) and state in (None, row["state"]) and fnmatchcase(row["type"], type_)
    ]
    if format_ == "table":  # for people, the word that says more
        rows = [{**row, "state": row["rest"] or row["state"]} for row in rows]
    show(rows, (*(LONG if long else COLUMNS), *(("rest",) if format_ == "json" else ())), format_)


@task.command()
@a_task
@asks_agents
def info(name: TaskName, format_: str, at: Where, timeout: float) -> None:
    """Show all that is known of a task: its timers, what it reads, its settings, when it is started again, and how it
    failed the last time, with the whole traceback.

    As JSON, it is the answer of its agent as it stands, with the JSON Schema of the settings.

    \b
    Example:
        pancakes task info agent1/ScanTarget
        pancakes task info agent1/pose --format json
    """
    with Client(at, timeout) as client:
        name = placed(client, name)
        found = order(client, name.agent, Describe(name.target))
    if format_ == "json":
        show_json([found])
    else:
        show_sections(_sections(str(name), found))


@task.command()
@a_task
@click.option("--set", "sets", metavar="KEY=VALUE", multiple=True, help="Start it with this setting. Repeatable.")
@dry_run_option
@orders_agents
def start(name: TaskName, sets: tuple[str, ...], dry_run: bool, format_: str, at: Where, timeout: float) -> None:
    """Start a task that stands still, and wait until it runs.

    A value of --set that reads as TOML is taken as such (5, true, [1, 2]), anything else as a string.

    \b
    Example:
        pancakes task start agent1/GoHome
        pancakes task start agent1/ScanTarget --set radius_m=0.8
    """
    settings = _settings(sets) or None
    with Client(at, timeout) as client:
        name = placed(client, name)
        number = accepted(client, name.agent, Start(name.target, settings, dry_run)).number
    _show_done(name, "started", number, dry_run, format_)


@task.command()
@a_task
@dry_run_option
@orders_agents
def stop(name: TaskName, dry_run: bool, format_: str, at: Where, timeout: float) -> None:
    """Stop a task once it has finished what it has in hand, and wait for that.

    It stays stopped, also when its agent is started anew.

    \b
    Example:
        pancakes task stop agent1/ScanTarget
    """
    with Client(at, timeout) as client:
        name = placed(client, name)
        number = accepted(client, name.agent, Stop(name.target, dry_run=dry_run)).number
    _show_done(name, "stopped", number, dry_run, format_)


@task.command()
@a_task
@click.option(
    "--keep-state/--drop-state",
    default=True,
    show_default=True,
    help="Whether it goes on with its state and settings, or begins as its configuration says.",
)
@dry_run_option
@orders_agents
def restart(name: TaskName, keep_state: bool, dry_run: bool, format_: str, at: Where, timeout: float) -> None:
    """Stop a task, start it, and wait until it runs.

    \b
    Example:
        pancakes task restart agent1/ScanTarget --drop-state
    """
    with Client(at, timeout) as client:
        name = placed(client, name)
        number = accepted(client, name.agent, Restart(name.target, keep_state, dry_run)).number
    _show_done(name, "restarted", number, dry_run, format_)


@task.command()
@a_task
@click.argument("rate_hz", metavar="HZ", type=FiniteRange(min=0.0))
@click.option(
    "--timer",
    metavar="METHOD",
    default="",
    shell_complete=timers,
    help="Which of its timers, where it has several.",
)
@dry_run_option
@orders_agents
def rate(name: TaskName, rate_hz: float, timer: str, dry_run: bool, format_: str, at: Where, timeout: float) -> None:
    """Change the rate of a time-driven task to HZ ticks a second, from its next tick on; 0 lets it rest.

    \b
    Example:
        pancakes task rate agent1/ir 2
        pancakes task rate agent1/Discovery 0.2 --timer announce
    """
    with Client(at, timeout) as client:
        name = placed(client, name)
        reply = accepted(client, name.agent, Reschedule(name.target, rate_hz, timer, dry_run))
    _show_done(name, "rate changed", reply.number, dry_run, format_, **reply.result)


def _show_done(name: TaskName, done: str, number: int, dry_run: bool, format_: str, **others: Any) -> None:
    row = {**name._asdict(), "done": DRY_RUN if dry_run else done, "number": number, **others}
    show([row], (*DONE, *others), format_)


def _sections(name: str, found: Mapping[str, Any]) -> dict[str, Any]:
    """All about one task, for people."""
    fence, failure = found["fence"], found["failure"]
    return {
        name: {
            "type": found["type"],
            "state": found["rest"] or found["state"],
            "reason": found["reason"],
            "tries": tries(found),
            "starts": found["incarnation"],
            "requires": found["requires"],
            "on disk": found["durability"],
            "started again": _policy(found["restart"]),
            "epoch": None if fence is None else f"{fence['epoch']} of {fence['task_id']}",
            "packets dropped": found["dropped"],
        },
        "timers": [
            {
                "timer": timer["timer"],
                "rate_hz": timer["rate_hz"],
                "ticks": timer["ticks"],
                "missed": timer["missed"],
                "lateness_mean_ms": 1e3 * timer["lateness_mean_s"],
                "lateness_max_ms": 1e3 * timer["lateness_max_s"],
            }
            for timer in found["timers"]
        ],
        "reads": [
            {
                "channel": row["channel"],
                "types": "all" if row["types"] is None else row["types"],
                "keep": row["keep"],
                "limit": row["limit"],
                "waiting": row["waiting"],
                "dropped": row["dropped"],
            }
            for row in found["reads"]
        ],
        "settings": found["settings"],
        f"last failure, at {failure['t_s']:.3f} s" if failure else "": failure["traceback"] if failure else "",
    }


def _policy(restart: Mapping[str, Any]) -> str:
    """A restart policy in a line."""
    if restart["policy"] == "temporary":
        return "temporary"
    again = f", then each {restart['again_s']:g} s" if restart["again_s"] else ""
    return (
        f"{restart['policy']}, at most {restart['at_most']} times in {restart['within_s']:g} s,"
        f" after {restart['pause_s']:g} s to {restart['pause_max_s']:g} s{again}"
    )


def _settings(sets: Sequence[str]) -> dict[str, Any]:
    from pancakes.config.override import value_of

    settings: dict[str, Any] = {}
    for text in sets:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise click.BadParameter(f"{text!r} is no setting: write it as KEY=VALUE", param_hint="--set")
        settings[key.strip()] = value_of(value.strip())
    return settings
