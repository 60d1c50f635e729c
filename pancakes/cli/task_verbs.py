"""`pancakes task ...`: the tasks of agents."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import click

from pancakes.cli.asking import order, placed, survey
from pancakes.cli.client import Client
from pancakes.cli.errors import sentences
from pancakes.cli.migration_verbs import adopt, migrate, migrations
from pancakes.cli.names import TaskName, a_task
from pancakes.cli.options import asks_agents, orders_agents
from pancakes.cli.output import show
from pancakes.control import Reschedule, Restart, Start, Stop

COLUMNS = ("agent", "service", "task", "type", "state", "rate_hz")
DONE = ("agent", "service", "task", "done")


@click.group()
def task() -> None:
    """Tasks that agents have."""


task.add_command(migrate)
task.add_command(migrations)
task.add_command(adopt)


@task.command("list")
@click.argument("agent", default="")
@asks_agents
@sentences
def list_(agent: str, format_: str, at: tuple[str, ...], timeout: float) -> None:
    """List the tasks of all agents, or of AGENT.

    Who does not answer in time is named on standard error; the exit code is 3 where nobody answers.

    \b
    Example:
        pancakes task list
        pancakes task list agent1 --format json
    """
    show([row for found in survey(at, timeout, agent) for row in found["tasks"]], COLUMNS, format_)


@task.command()
@a_task
@click.option("--set", "sets", metavar="KEY=VALUE", multiple=True, help="Start it with this setting. Repeatable.")
@orders_agents
@sentences
def start(name: TaskName, sets: tuple[str, ...], format_: str, at: tuple[str, ...], timeout: float) -> None:
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
        order(client, name.agent, Start(name.target, settings))
    _show_done(name, "started", format_)


@task.command()
@a_task
@orders_agents
@sentences
def stop(name: TaskName, format_: str, at: tuple[str, ...], timeout: float) -> None:
    """Stop a task once it has finished what it has in hand, and wait for that.

    It stays stopped, also when its agent is started anew.

    \b
    Example:
        pancakes task stop agent1/ScanTarget
    """
    with Client(at, timeout) as client:
        name = placed(client, name)
        order(client, name.agent, Stop(name.target))
    _show_done(name, "stopped", format_)


@task.command()
@a_task
@click.option(
    "--keep-state/--drop-state",
    default=True,
    show_default=True,
    help="Whether it goes on with its state and settings, or begins as its configuration says.",
)
@orders_agents
@sentences
def restart(name: TaskName, keep_state: bool, format_: str, at: tuple[str, ...], timeout: float) -> None:
    """Stop a task, start it, and wait until it runs.

    \b
    Example:
        pancakes task restart agent1/ScanTarget --drop-state
    """
    with Client(at, timeout) as client:
        name = placed(client, name)
        order(client, name.agent, Restart(name.target, keep_state))
    _show_done(name, "restarted", format_)


@task.command()
@a_task
@click.argument("rate_hz", metavar="HZ", type=click.FloatRange(min=0.0))
@click.option("--timer", metavar="METHOD", default="", help="Which of its timers, where it has several.")
@orders_agents
@sentences
def rate(name: TaskName, rate_hz: float, timer: str, format_: str, at: tuple[str, ...], timeout: float) -> None:
    """Change the rate of a time-driven task to HZ ticks a second, from its next tick on; 0 lets it rest.

    \b
    Example:
        pancakes task rate agent1/ir 2
        pancakes task rate agent1/ScanTarget 20 --timer steer
    """
    with Client(at, timeout) as client:
        name = placed(client, name)
        now = order(client, name.agent, Reschedule(name.target, rate_hz, timer))
    _show_done(name, "rate changed", format_, rate_hz=now["rate_hz"])


def _show_done(name: TaskName, done: str, format_: str, **others: Any) -> None:
    row = {**name._asdict(), "done": done, **others}
    show([row], (*DONE, *others), format_)


def _settings(sets: Sequence[str]) -> dict[str, Any]:
    from pancakes.config.override import value_of

    settings: dict[str, Any] = {}
    for text in sets:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise click.BadParameter(f"{text!r} is no setting: write it as KEY=VALUE", param_hint="--set")
        settings[key.strip()] = value_of(value.strip())
    return settings
