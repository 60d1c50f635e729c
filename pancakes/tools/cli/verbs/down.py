"""`pancakes down`: stop agents gracefully, and wait until they are gone."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import click

from pancakes.errors import ControlRefusedError
from pancakes.tools.cli.agent_requests import confirm, force_option
from pancakes.tools.cli.graceful_stop import GracefulStop
from pancakes.tools.cli.options import Ask, agents, dry_run_option, orders_agents
from pancakes.tools.cli.output import show_text
from pancakes.util.runtime_dir import RunningAgent, entries, other_fleets, why_none

COLUMNS = ("agent", "fleet", "role", "host", "done")


@click.command()
@agents
@click.option("--all", "all_", is_flag=True, help="With --at: stop all agents that can be found from there.")
@click.option(
    "--fleet-file",
    "file",
    metavar="FILE|DIR",
    type=click.Path(path_type=Path),
    help="Stop the agents of a fleet file, on this machine and on its hosts.",
)
@force_option
@dry_run_option
@orders_agents
def down(agents: tuple[str, ...], all_: bool, file: Path | None, force: bool, dry_run: bool, ask: Ask) -> None:
    """Stop the named agents, or all agents of this machine (with --fleet, of that fleet), and wait until they are gone.

    Their tasks stop, their actuators go to their safe hold, and their peers are notified. A simulated world ends after
    the agents that act in it. If an agent has not ended within the time limit, it is named on standard error, and the
    exit code is 3. A launcher does not restart an agent that was stopped in this way, unless it runs with --restart
    always. Neither does the supervisor of a deployed agent.

    Without names it first lists the agents that it stops. If they belong to several fleets, it asks, or needs --force.

    \b
    Example:
        pancakes down
        pancakes down agent1 agent2
        pancakes down --fleet field
        pancakes down --fleet-file field.toml
        pancakes down --at 192.168.1.20:7401 --all --dry-run
    """
    if file is not None and (ask.where.addresses or ask.where.fleet or all_):
        raise click.UsageError("--fleet-file already names its agents: leave out --at, --fleet and --all")
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
    if file is not None:
        stop.end_fleet(file, agents)
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
