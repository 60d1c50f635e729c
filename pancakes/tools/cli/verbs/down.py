"""`pancakes down`: stop agents gracefully, and wait until they are gone."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from pancakes.errors import ControlRefusedError
from pancakes.tools.cli.agent_requests import confirm, yes_option
from pancakes.tools.cli.graceful_stop import GracefulStop
from pancakes.tools.cli.options import AGENT_NAME, NO_FILE, Ask, dry_run_option, orders_agents
from pancakes.tools.cli.output import show_text
from pancakes.util.runtime_dir import RunningAgent, entries, other_fleets, why_none

COLUMNS = ("agent", "fleet", "role", "host", "done")


class AgentOrFile(click.ParamType):
    """The name of an agent, or a file or folder that `pancakes up` takes."""

    name = "AGENT|FILE|DIR"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str | Path:
        text = str(value)
        if not text:
            self.fail(NO_FILE, param, ctx)
        if text.endswith(".toml") or text.startswith((".", "/")):
            return Path(text)
        runs_here = any(text in (entry.name, f"{entry.fleet}/{entry.name}") for entry in entries())
        if runs_here or not Path(text).is_dir():
            return str(AGENT_NAME.convert(value, param, ctx))
        return Path(text)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType`."""
        return [*AGENT_NAME.shell_complete(ctx, param, incomplete), CompletionItem(incomplete, type="file")]


@click.command()
@click.argument("named", metavar="[AGENT|FILE|DIR]...", nargs=-1, type=AgentOrFile())
@click.option("--all", "all_", is_flag=True, help="With --at: stop all agents that can be found from there.")
@yes_option
@dry_run_option
@orders_agents
def down(named: tuple[str | Path, ...], all_: bool, force: bool, dry_run: bool, ask: Ask) -> None:
    """Stop the named agents, those of a fleet's files, or all agents of this machine, and wait until they are gone.

    A FILE or DIR is what `pancakes up` or `pancakes deploy` started, on this machine and on its hosts; write ./NAME if
    an agent of that name runs. Agents that are named with it are agents of that fleet: then only they stop. With
    --fleet, all agents of that fleet on this machine stop.

    Their tasks stop, their actuators go to their safe hold, and their peers are notified. A simulated world ends after
    the agents that act in it. If an agent has not ended within the time limit, or a host cannot be reached, it is named
    on standard error, and the exit code is 3. `pancakes up` does not restart an agent that was stopped in this way,
    unless it runs with --restart always and you name only some of its agents. Neither does the supervisor of a deployed
    agent.

    Without names it first lists the agents that it stops. If they belong to several fleets, it asks, or needs --yes.

    \b
    Example:
        pancakes down
        pancakes down agent1 agent2
        pancakes down --fleet field
        pancakes down configs/encirclement
        pancakes down --at 192.168.1.20:7401 --all --dry-run
    """
    files = [it for it in named if isinstance(it, Path)]
    agents = [it for it in named if isinstance(it, str)]
    if files and (ask.where.addresses or ask.where.fleet or all_):
        raise click.UsageError(f"{files[0]} names its agents already: leave out --at, --fleet and --all")
    if ask.where.addresses and not agents and not all_:
        raise click.UsageError("name the agents to stop, or pass --all for all that can be found through --at")
    if all_ and (agents or not ask.where.addresses):
        raise click.UsageError("--all needs --at: without both, all agents of this machine stop")
    here = {
        (entry.fleet, entry.name): entry
        for entry in entries()
        if entry.role != "client" and ask.where.fleet in ("", entry.fleet)
    }
    stop = GracefulStop(ask.timeout_s, dry_run)
    if files:
        stop.end_fleet(files, agents)
    elif ask.where.addresses or agents:
        stop.end_named(ask.where, agents, here)
    else:
        if not here:
            fleet = ask.where.fleet
            if fleet and other_fleets(fleet):
                raise ControlRefusedError(why_none(fleet))
            show_text(f"no agent{f' of the fleet {fleet}' if fleet else ''} runs on this machine", err=True)
        elif not ask.where.fleet:
            fleets = sorted({entry.fleet for entry in here.values()})
            of_each = "; ".join(f"{', '.join(_names(here, fleet))} of the fleet {fleet}" for fleet in fleets)
            if len(fleets) > 1:
                confirm(f"this stops {of_each}. To choose one fleet, pass --fleet", force, dry_run)
            elif not dry_run:
                show_text(f"stopping {of_each}", err=True)
        stop.end_all(here, ask.where.fleet)
    if stop.rows or ask.printer.is_json:
        ask.printer.table(stop.rows, COLUMNS)
    sys.exit(stop.code)


def _names(here: Mapping[tuple[str, str], RunningAgent], fleet: str) -> list[str]:
    """Return the names of the agents of a fleet on this machine."""
    return sorted(entry.name for entry in here.values() if entry.fleet == fleet)
