"""`pancakes deploy`: install a fleet on its hosts, and keep it running there."""

from __future__ import annotations

import signal
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pancakes.tools.cli.options import Duration, agent_sets_option, format_option
from pancakes.tools.cli.output import Printer, show_text
from pancakes.tools.cli.streaming import event_at

if TYPE_CHECKING:
    from pancakes.security.authority import Authority
    from pancakes.tools.deploy.deployment import Need
    from pancakes.tools.deploy.drain import TaskMoves
    from pancakes.tools.deploy.plan import DeploymentPlan
    from pancakes.tools.launch.fleet_file import Member
    from pancakes.tools.launch.remote_hosts import Host

COLUMNS = ("agent", "host", "what", "from", "to", "changed", "keys", "environment", "brought_mb", "manager", "tasks")


@click.command()
@click.argument("paths", metavar="FLEET...", nargs=-1, required=True, type=click.Path(path_type=Path))
@agent_sets_option
@click.option(
    "--wheels",
    metavar="FILE|DIR",
    multiple=True,
    type=click.Path(exists=True, path_type=Path),
    help="Install these wheels of Pancakes and of plug-ins, instead of the versions installed here. Repeatable.",
)
@click.option(
    "--extra", "extras", metavar="NAME", multiple=True, help="Also install this extra of Pancakes. Repeatable."
)
@click.option("--upgrade", is_flag=True, help="Look for newer libraries. Without it, a fleet keeps its present ones.")
@click.option(
    "--calm",
    "calm_s",
    type=Duration(),
    default="3s",
    show_default=True,
    help="How long the tasks of an agent must run before the next agent is switched.",
)
@click.option(
    "--only",
    metavar="AGENT",
    multiple=True,
    help="Deploy only to this agent, and leave the others and their hosts alone. Repeatable.",
)
@click.option("--enrol", is_flag=True, help="Issue keys to agents that need them, if their fleet was founded here.")
@click.option("--dry-run", is_flag=True, help="Check, and show what would be done on which host.")
@format_option
def deploy(
    paths: tuple[Path, ...],
    sets: tuple[str, ...],
    wheels: tuple[Path, ...],
    extras: tuple[str, ...],
    upgrade: bool,
    calm_s: float,
    only: tuple[str, ...],
    enrol: bool,
    dry_run: bool,
    printer: Printer,
) -> None:
    """Install wheels, plug-ins and configurations of a fleet on its hosts, and keep its agents running there.

    A FLEET is a fleet file whose agents name hosts, or a folder with one. Each host is reached over ssh.
    All hosts are prepared before a running agent is touched: wheels are copied and installed in a new environment, and
    each configuration is checked in it. Then, one agent at a time, the agent's tasks migrate to neighbours, the agent
    is stopped, switched to the new version and started, and its tasks migrate back. If an agent does not become ready,
    or its tasks do not run, all agents go back to their previous versions, and the exit code is 1.

    Configurations are checked here first, with the plug-ins of the wheels. Files that were edited by hand on a host are
    reported and replaced. Extras of Pancakes that the configurations need are installed, too.

    The systemd of the user keeps an agent running, or a supervisor of Pancakes if the host has no systemd.

    \b
    Example:
        pancakes deploy field.toml --dry-run
        pancakes deploy field.toml --wheels dist --extra record
        pancakes deploy field.toml --enrol
    """
    from pancakes.errors import PancakesError
    from pancakes.tools.deploy.deployment import Deployment, check_keys, keys_needed
    from pancakes.tools.deploy.deployment import enrol as give_keys
    from pancakes.tools.deploy.plan import check_configs, plan_of
    from pancakes.tools.deploy.wheels import given_wheels, installed_wheels
    from pancakes.tools.launch.fleet_file import make_fleet
    from pancakes.tools.launch.remote_hosts import tunnels
    from pancakes.util.plugins import Plugins

    fleet = make_fleet(paths, sets, None, Plugins(), check_hosts=not wheels)
    members = [member for member in fleet if member.host]
    if not members:
        raise PancakesError(f'no agent of {paths[0]} has a host: add host = "pi@robot1" to its table')
    members = _only(members, only)
    with ExitStack() as stack:
        hosts = stack.enter_context(_reached(members, bool(only)))
        if not dry_run:
            for host in hosts.values():
                host.link.obtain("lock")
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="pancakes-wheels-")))
        own = given_wheels(wheels) if wheels else installed_wheels(folder)
        if unchecked := check_configs(members, own):
            show_text(f"the configurations were not checked on this machine: {unchecked}", err=True)
        keys = keys_needed(members, hosts)
        if not enrol:
            check_keys(members, keys)
        plan = plan_of(members, hosts, own, extras, upgrade)
        addresses = {**_here(fleet), **stack.enter_context(tunnels(hosts.values()))}
        moves = _moves(fleet, addresses)
        for supply in plan.supplies.values():
            if supply.damaged:
                text = f"has files that were changed there by hand ({', '.join(supply.damaged)}): they are replaced"
                _tell(supply.host.name, text)
        for change in plan.changes:
            if change.edited:
                _tell(
                    change.name,
                    f"{change.edited}: it will run the deployed version; the edit is kept as the previous version",
                )
        if dry_run:
            printer.table(_rows(plan, hosts, moves, keys), COLUMNS)
            return
        for member in fleet:
            if not member.host:
                _tell(member.name, "has no host, and is not changed")
        authorities = _authorities(members, keys)
        interrupted = event_at(signal.SIGINT, signal.SIGTERM, signal.SIGHUP).is_set
        deployment = Deployment(plan.supplies, plan.changes, moves, _tell, calm_s, interrupted)
        deployment.prepare()
        give_keys(members, keys, hosts, authorities, _tell)
        deployment.switch()


def _only(members: Sequence[Member], only: Sequence[str]) -> list[Member]:
    from pancakes.util.text import hint_of

    names = [member.name for member in members]
    for name in only:
        if name not in names:
            raise click.UsageError(f"no agent {name!r} has a host{hint_of(name, names)}: {', '.join(names)}")
    return [member for member in members if not only or member.name in only]


@contextmanager
def _reached(members: Sequence[Member], only: bool) -> Iterator[dict[str, Host]]:
    from pancakes.errors import PancakesError
    from pancakes.tools.launch.remote_hosts import open_hosts

    with ExitStack() as stack:
        try:
            hosts = stack.enter_context(open_hosts(members))
        except PancakesError as error:
            rest = "" if only else "\nNothing was changed. To deploy to some agents only, name them with --only"
            raise PancakesError(f"{error}{rest}") from None
        yield hosts


def _authorities(members: Sequence[Member], keys: Mapping[str, Need]) -> dict[str, Authority]:
    """Open the authorities of the fleets in which agents are enrolled, so that passwords are asked for now."""
    from pancakes.tools.cli.verbs.keys_authority import opened

    fleets = dict.fromkeys(it.config.agent.fleet for it in members if keys[it.name] == "needs")
    return {fleet: opened(fleet) for fleet in fleets}


def _tell(name: str, text: str) -> None:
    show_text(f"{name} {text}", err=True)


def _here(fleet: Sequence[Member]) -> dict[str, str]:
    """Return the addresses of the agents that run on this machine."""
    from pancakes.util.runtime_dir import entries

    here = {(it.fleet, it.name): next(iter(it.listen), "") for it in entries()}
    found = {it.name: here.get((it.config.agent.fleet, it.name), "") for it in fleet if not it.host}
    return {name: address for name, address in found.items() if address}


def _moves(fleet: Sequence[Member], addresses: Mapping[str, str]) -> dict[str, TaskMoves]:
    from pancakes.tools.deploy.drain import TaskMoves

    moves: dict[str, TaskMoves] = {}
    for name in dict.fromkeys(member.config.agent.fleet for member in fleet):
        members = [it for it in fleet if it.config.agent.fleet == name and it.name in addresses]
        moves[name] = TaskMoves({it.name: addresses[it.name] for it in members}, name, partial(_tell))
    return moves


def _rows(
    plan: DeploymentPlan, hosts: Mapping[str, Host], moves: Mapping[str, TaskMoves], keys: Mapping[str, Need]
) -> list[dict[str, Any]]:
    rows = []
    for change in plan.changes:
        supply = plan.supplies[change.host]
        bids = moves[change.fleet].movable(change.name) if change.ran and change.what == "switch" else ()
        rows.append(
            {
                "agent": change.name,
                "host": change.host,
                "what": change.what,
                "from": change.was,
                "to": change.version,
                "changed": list(change.changed),
                "keys": {"has": "there", "needs": "given out", "none": "-"}[keys[change.name]],
                "environment": supply.environment,
                "brought_mb": round(supply.brought_bytes / 1e6, 1),
                "manager": "systemd" if hosts[change.host].is_["systemd"] else "supervisor",
                "tasks": [f"{task} → {winner}" if winner else f"{task} stays" for task, winner in bids],
            }
        )
    return rows
