"""Stop the agents of a fleet file, those on other hosts too: first those that come after others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from pancakes.client import Client, Where
from pancakes.errors import PancakesError, Unreachable
from pancakes.tools.cli.exit_codes import REFUSED, UNREACHABLE
from pancakes.tools.cli.graceful_stop import GracefulStop, Target
from pancakes.tools.cli.output import DRY_RUN, show_text
from pancakes.tools.launch.fleet_file import Member, make_fleet
from pancakes.tools.launch.remote_hosts import Host, open_hosts, tunnels
from pancakes.tools.launch.ssh import HostError
from pancakes.util.runtime_dir import entries


def end_fleet(stop: GracefulStop, file: Path, names: Sequence[str]) -> None:
    """End those agents of a fleet file that run, or those of them that are named.

    Raises:
        PancakesError: the file is not sound, it has no agent of a name, or a host cannot be reached.
    """
    members = make_fleet([file], (), None, None)
    if unknown := [name for name in names if all(member.name != name for member in members)]:
        raise PancakesError(f"{file} has no agent {unknown[0]!r}, only {', '.join(member.name for member in members)}")
    wanted = [member for member in members if not names or member.name in names]
    here = {(entry.fleet, entry.name): entry for entry in entries()}
    with open_hosts(wanted) as hosts, tunnels(hosts.values()) as ways, ExitStack() as stack:
        running, addresses = [], {}
        for member in wanted:
            key = (member.config.agent.fleet, member.name)
            if hosts[member.host].runs(member) if member.host else key in here:
                running.append(member)
                listen = here[key].listen if not member.host else ()
                addresses[member.name] = ways[member.name] if member.host else next(iter(listen), "")
        if not running:
            show_text(f"nothing of {file} runs", err=True)
        clients = {
            fleet: stack.enter_context(Client(Where(_reached(running, addresses, fleet), fleet), stop.timeout_s))
            for fleet in dict.fromkeys(member.config.agent.fleet for member in running)
        }
        for wave in waves(running):
            _end(stop, wave, clients, hosts)


def waves(members: Sequence[Member]) -> list[list[Member]]:
    """Return agents in the order in which they end: each once those that come after it have ended."""
    left, found = list(members), []
    while left:
        needed = {other for member in left for other in member.after}
        wave = [member for member in reversed(left) if member.name not in needed] or left
        found.append(wave)
        left = [member for member in left if member not in wave]
    return found


def _reached(members: Sequence[Member], addresses: Mapping[str, str], fleet: str) -> tuple[str, ...]:
    return tuple(addresses[it.name] for it in members if it.config.agent.fleet == fleet and addresses[it.name])


def _end(stop: GracefulStop, wave: Sequence[Member], clients: Mapping[str, Client], hosts: Mapping[str, Host]) -> None:
    for fleet, client in clients.items():
        ours = {member.name: member for member in wave if member.config.agent.fleet == fleet}
        if not ours:
            continue
        try:
            survey = client.survey(*ours)
            described, silent = {told["agent"] for told in survey.agents}, survey.silent
        except Unreachable as error:
            described, silent = set(), str(error).splitlines()
        for sentence in silent:
            show_text(sentence, err=True)
        targets = [Target(it.name, fleet, it.config.agent.role, None, it.host) for it in ours.values()]
        stop.end_some(client, [target for target in targets if target.name in described])
        for target in targets:
            if target.name not in described:
                _end_process(stop, target, hosts)


def _end_process(stop: GracefulStop, target: Target, hosts: Mapping[str, Host]) -> None:
    """End an agent that does not answer: by a signal to its process."""
    if not target.host:
        stop.fail(f"{target.name} does not answer: pancakes down {target.name} ends its process", UNREACHABLE)
        return
    if stop.dry_run:
        stop.done(target, DRY_RUN)
        return
    try:
        gone = hosts[target.host].link.obtain(
            "end_process", fleet=target.fleet, name=target.name, within=stop.timeout_s
        )
    except HostError as error:
        stop.fail(str(error), REFUSED)
        return
    if gone:
        stop.done(target, "ended")
    else:
        sentence = f"{target.name} has not ended on {target.host} within {stop.timeout_s:g} s"
        stop.fail(sentence, UNREACHABLE)
