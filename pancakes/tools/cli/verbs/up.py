"""`pancakes up`: run and supervise the agents of a fleet, on this machine and on others."""

from __future__ import annotations

import os
import selectors
import shlex
import sys
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NoReturn

import click
from msgspec import to_builtins

from pancakes.tools.cli.agent_process import SHOW_TRACEBACKS
from pancakes.tools.cli.agent_requests import confirm, yes_option
from pancakes.tools.cli.exit_codes import forget_output
from pancakes.tools.cli.options import FileOrFolder, agent_sets_option, format_option
from pancakes.tools.cli.output import Printer, show_text
from pancakes.util.codecs import encode_json
from pancakes.util.text import printable_data

if TYPE_CHECKING:
    from pancakes.client import Client
    from pancakes.supervision.restart import Policy
    from pancakes.tools.launch.fleet_file import Member
    from pancakes.tools.launch.remote_hosts import Host, HostAgents, HostStart
    from pancakes.tools.launch.supervisor import LaunchReporter

COUNTDOWN_S: Final = 0.25
"""How long before a mission begins its agents get the request, so that all begin at the same moment."""
REACH_S: Final = 10.0
"""The time limit for reaching an agent to release its mission."""
COLOURS: Final = ("cyan", "green", "yellow", "magenta", "blue", "bright_cyan", "bright_green", "bright_magenta")


@click.command()
@click.argument("paths", metavar="FILE|DIR...", nargs=-1, required=True, type=FileOrFolder())
@agent_sets_option
@click.option(
    "--restart",
    "policy",
    type=click.Choice(["no", "on-failure", "always"]),
    help="When to restart an agent that ends by itself. [default: as in the fleet file, or on-failure]",
)
@click.option("--only", metavar="AGENT", multiple=True, help="Run only this agent of the fleet. Repeatable.")
@click.option("-d", "--detach", is_flag=True, help="Return when all agents are ready, and run them in the background.")
@click.option("--hold", is_flag=True, help="Do not release held mission clocks when all agents are ready.")
@click.option("--traceback", is_flag=True, help="Show failures of tasks with their whole tracebacks.")
@click.option(
    "--fresh",
    is_flag=True,
    help="Begin from scratch: delete the saved state of the agents, with the state of their tasks and where they are."
    " Refused while another agent of the fleet runs.",
)
@yes_option
@click.option("--local", is_flag=True, help="Let the agents talk only within this machine, by local://, without ports.")
@click.option(
    "--dry-run",
    is_flag=True,
    help="Check everything, and show what would be started, and with --fresh, deleted.",
)
@format_option
def up(
    paths: tuple[Path, ...],
    sets: tuple[str, ...],
    policy: Policy | None,
    only: tuple[str, ...],
    detach: bool,
    hold: bool,
    traceback: bool,
    fresh: bool,
    force: bool,
    local: bool,
    dry_run: bool,
    printer: Printer,
) -> None:
    """Run the agents of a fleet, each in its own process, until Ctrl-C or `pancakes down FILE`.

    A FILE is an agent's configuration, or a fleet file that names several (docs/configuration.md). A DIR stands for its
    fleet.toml, or if it has none, for all of its *.toml files. All files are checked before an agent starts. The output
    of each agent is prefixed with its name; starts, restarts and ends are reported on standard error. With --format
    json each line is a JSON object.

    An agent that has a host in the fleet file runs there, over ssh, with the Pancakes that `pancakes deploy` or you
    installed there (docs/deployment.md). It ends with this command.

    With --detach the command returns when all agents are ready and their mission has begun. They run in the background
    then, and what they print is in a log file, which is named.

    Agents continue from their saved state: a task that migrated away, was stopped or failed does not start again. Each
    such task is listed, with the reason. With --fresh all tasks begin as the files say. If that deletes state, the
    command asks first; if this is not a terminal, --yes is required.

    An agent that fails is restarted, by default at most three times within a minute.
    SIGINT or SIGTERM stops all agents gracefully; a second one ends them at once. The exit code is 0 if all agents were
    stopped or ended by themselves without an error, 1 if one was given up or cannot run, 4 if a configuration is bad.

    \b
    Example:
        pancakes up configs/encirclement
        pancakes up world.toml robot.toml --set robot:agent.seed=7
        pancakes up configs/encirclement --dry-run
        pancakes up configs/encirclement --detach
        pancakes up configs/encirclement --only agent2
    """
    from pancakes.tools.launch.fleet_file import chosen, make_fleet, unlinked
    from pancakes.util.plugins import Plugins

    if traceback:
        sets = (*sets, SHOW_TRACEBACKS)
    whole = make_fleet(paths, sets, policy, Plugins(), local=local)
    members = chosen(whole, only)
    alone = ", ".join(unlinked(whole))
    warning = f"warning: {alone} will not be linked: no agent has the address of another in `peers`" if alone else ""
    reporter: LaunchReporter = _Objects() if printer.is_json else _Prefixed([member.name for member in members])
    if dry_run or detach:
        with _checked(members, only, fresh, force, dry_run):
            pass
    if warning and dry_run:
        show_text(warning, err=True)
    elif warning and detach:
        reporter.told("", "unlinked", warning)
    if dry_run:
        _show(members, fresh, printer)
    elif detach:
        _detach(paths, only, members, hold, fresh, reporter, printer)
    else:
        from pancakes.tools.launch.detached import registered

        with registered(paths, only, any(it.host for it in members)), _checked(members, only, fresh, force) as hosts:
            if warning:
                reporter.told("", "unlinked", warning)
            sys.exit(_run(members, hosts, hold, fresh, reporter))


@contextmanager
def _checked(
    members: Sequence[Member], only: Sequence[str], fresh: bool, force: bool, dry_run: bool = False
) -> Iterator[Mapping[str, Host]]:
    """Check that a fleet can run, and let the person confirm what is lost; yield the hosts of its agents.

    Raises:
        PancakesError: it cannot run, or the person declines.
    """
    from pancakes.tools.launch.clear_state import check_alone, saved_state
    from pancakes.tools.launch.fleet_file import check_free
    from pancakes.tools.launch.remote_hosts import open_hosts

    with ExitStack() as stack:
        stack.callback(check_free(members, claims=not only).release)
        if only:
            _check_keys(members)
        hosts = stack.enter_context(open_hosts(members))
        check_hosts(members, hosts, fresh)
        if fresh:
            check_alone(member.config for member in members)
            losing = [member.name for member in members if member.host or saved_state(member.config)]
            if losing:
                confirm(f"the saved state of the tasks of {', '.join(losing)} is lost", force, dry_run)
        yield hosts


def _check_keys(members: Sequence[Member]) -> None:
    """Check that agents which join a fleet that runs here will have keys of that fleet.

    Raises:
        PancakesError: the fleet runs with keys that were made for its run.
    """
    from pancakes.errors import PancakesError
    from pancakes.tools.launch.temporary_keys import without_keys
    from pancakes.util.runtime_dir import entries

    running = {entry.fleet for entry in entries() if entry.role != "client"}
    for name in without_keys({member.name: member.config for member in members if not member.host}):
        fleet = next(member.config.agent.fleet for member in members if member.name == name)
        if fleet in running:
            raise PancakesError(
                f"the fleet {fleet} runs with keys that were made for its run, so {name} would not be linked. Start"
                " all of it again (pancakes down, then pancakes up), or give it keys that stay:"
                f" pancakes keys init {fleet}"
            )


def _detach(
    paths: Sequence[Path],
    only: Sequence[str],
    members: Sequence[Member],
    hold: bool,
    fresh: bool,
    reporter: LaunchReporter,
    printer: Printer,
) -> NoReturn:
    """Run a fleet, whose start the person has confirmed, in the background, and exit when it is ready."""
    from pancakes.tools.launch.detached import registered, run_detached

    def run(reporter: LaunchReporter) -> int:
        with (
            registered(paths, only, any(it.host for it in members)),
            _checked(members, only, fresh, force=True) as hosts,
        ):
            return _run(members, hosts, hold, fresh, reporter)

    begins = not hold and any(member.config.clock.hold for member in members)
    found = run_detached(paths, only, [member.name for member in members], begins, reporter, run)
    if isinstance(found, int):
        sys.exit(found)
    if printer.is_json:
        show_text(printable_data(encode_json({"event": "detached", **to_builtins(found)}).decode()))
        sys.exit(1 if found.given_up else 0)
    files = " ".join(map(shlex.quote, map(str, paths)))
    lost = f" {', '.join(found.given_up)} did not start, and the others run on." if found.given_up else ""
    verb = "run" if len(found.ready) > 1 else "runs"
    said = f"{', '.join(found.ready)} {verb} in the background (process {found.process}).{lost}"
    show_text(f"{said}\nLog: {found.log}\nTo stop: pancakes down {files}")
    sys.exit(1 if found.given_up else 0)


def check_hosts(members: Sequence[Member], hosts: Mapping[str, Host], fresh: bool) -> None:
    """Check that agents can be started on other hosts.

    Raises:
        PancakesError: one of them runs there already, or Pancakes is missing there; or, with `fresh`, another agent of
            the fleet runs.
    """
    from pancakes.errors import PancakesError

    problems = []
    for member in (it for it in members if it.host):
        host, agent = hosts[member.host], member.config.agent
        if pid := host.runs(member):
            advice = "end it with pancakes down FILE"
            runs = f"the agent {agent.name} of the fleet {agent.fleet} already runs on {host.name} (process {pid})"
            problems.append(f"{runs}: {advice}")
        elif not host.agent(member.name)["python"]:
            problems.append(f"{host.name} has no Pancakes to run {member.name} with: install it with pancakes deploy")
    fleets = {member.config.agent.fleet for member in members}
    for host in hosts.values() if fresh else ():
        for it in host.is_["running"]:
            if it["role"] == "agent" and it["fleet"] in fleets and it["name"] not in host.is_["agents"]:
                outside = f"{it['name']} of the fleet {it['fleet']} runs outside this launch on {host.name}"
                problems.append(f"{outside}, and may have tasks that migrated there: with --fresh they would run twice")
    if problems:
        raise PancakesError("\n".join(problems))


def _show(members: Sequence[Member], fresh: bool, printer: Printer) -> None:
    rows: list[dict[str, Any]] = [
        {
            "agent": member.name,
            "fleet": member.config.agent.fleet,
            "role": member.config.agent.role,
            "host": member.host,
            "config": str(member.path),
            "set": list(member.sets),
            "listen": member.config.agent.addresses,
            "after": list(member.after),
            "restart": member.restart.policy,
            **({"deletes": _would_delete(member)} if fresh else {}),
        }
        for member in members
    ]
    printer.table(rows, tuple(rows[0]))


def _would_delete(member: Member) -> str:
    """Return what `--fresh` deletes of an agent: its state directory, or that on its host; empty: there is nothing."""
    from pancakes.tools.launch.clear_state import saved_state

    if member.host:
        return f"its saved state on {member.host}"
    return str(saved_state(member.config) or "")


def _run(
    members: Sequence[Member], hosts: Mapping[str, Host], hold: bool, fresh: bool, reporter: LaunchReporter
) -> int:
    from pancakes.tools.launch.clear_state import empty_state
    from pancakes.tools.launch.supervisor import LaunchPlan, Runner
    from pancakes.tools.launch.temporary_keys import keys_of_run, set_keys

    away = [member for member in members if member.host]
    for member in members if fresh else ():
        if member.host:
            continue
        directory = empty_state(member.config)
        if directory is not None:
            reporter.told(member.name, "fresh", f"begins from scratch: its saved state in {directory} was deleted")
    there = {member.name: bool(hosts[member.host].agent(member.name)["keys"]) for member in away}
    with keys_of_run({member.name: member.config for member in members}, there) as keys:
        starts = {member.name: host_start(member, keys.get(member.name), fresh) for member in away}
        members = [
            member if member.host else replace(member, sets=(*member.sets, *set_keys(keys.get(member.name))))
            for member in members
        ]
        elsewhere = partial(_elsewhere, away, starts, hosts) if away else None
        begin = partial(let_begin, members=members, hosts=hosts)
        code = Runner(members, LaunchPlan(members, begin=not hold), reporter, begin, elsewhere).run()
    try:
        sys.stdout.flush()
    except OSError:
        forget_output()
    return code


def host_start(member: Member, keys: Path | None, fresh: bool) -> HostStart:
    """Return what an agent's host needs to start it."""
    from pancakes.config.toml_reader import self_contained
    from pancakes.tools.launch.remote_hosts import HostStart

    files = sorted(keys.iterdir()) if keys is not None else ()
    key_files = {path.name: b64encode(path.read_bytes()).decode() for path in files}
    return HostStart(self_contained(str(member.path)), member.sets, key_files, fresh)


def _elsewhere(
    members: Sequence[Member],
    starts: Mapping[str, HostStart],
    hosts: Mapping[str, Host],
    selector: selectors.BaseSelector,
    now: Callable[[], float],
) -> HostAgents:
    from pancakes.tools.launch.remote_hosts import HostAgents

    return HostAgents(members, starts, {name: host.link for name, host in hosts.items()}, selector, now)


def let_begin(pids: Mapping[str, int], members: Sequence[Member], hosts: Mapping[str, Host]) -> list[str]:
    """Release the mission clocks of agents, all at the same moment.

    Args:
        pids: the processes of the agents, by name.
        members: all agents of the launch.
        hosts: the hosts of the agents that run elsewhere.

    Returns:
        A sentence for each agent that could not be reached.
    """
    from pancakes.errors import PancakesError
    from pancakes.tools.launch.remote_hosts import tunnels

    held = [member for member in members if member.name in pids]
    try:
        with ExitStack() as stack:
            tunnel_of = stack.enter_context(tunnels(hosts[name] for name in {it.host for it in held if it.host}))
            return _begin(stack, held, pids, tunnel_of)
    except PancakesError as error:
        return [str(error)]


def _begin(
    stack: ExitStack, held: Sequence[Member], pids: Mapping[str, int], tunnel_of: Mapping[str, str]
) -> list[str]:
    from pancakes.client import Client, Target
    from pancakes.control import Begin
    from pancakes.util.clock import MonotonicClock
    from pancakes.util.runtime_dir import entries

    now = MonotonicClock().now
    here = {entry.pid: next(iter(entry.listen), "") for entry in entries()}
    addresses = {it.name: tunnel_of.get(it.name, "") if it.host else here.get(pids[it.name], "") for it in held}
    problems = [
        f"the mission clock of {name} is still held at 0: {name} cannot be reached from here"
        for name in addresses
        if not addresses[name]
    ]
    clients: dict[str, Client] = {}
    for fleet in dict.fromkeys(it.config.agent.fleet for it in held if addresses[it.name]):
        names = [it.name for it in held if it.config.agent.fleet == fleet and addresses[it.name]]
        client = stack.enter_context(Client(Target(tuple(addresses[name] for name in names), fleet), REACH_S))
        client.describe(*names)
        clients.update(dict.fromkeys(names, client))
    begin_s = now() + COUNTDOWN_S
    for name, client in clients.items():
        reply = client.request(name, Begin(max(0.0, begin_s - now())))
        if not reply.ok:
            problems.append(f"the mission of {name} does not begin: {reply.reason}")
    return problems


class _Prefixed:
    """Print lines with the agent's coloured name in front; events of agents go to standard error."""

    def __init__(self, names: Sequence[str]) -> None:
        plain = "NO_COLOR" in os.environ
        width = max(map(len, names))
        self._heads = {
            name: f"{name:{width}} | " if plain else click.style(f"{name:{width}} | ", fg=colour)
            for name, colour in zip(names, cycle(COLOURS), strict=False)
        }

    def line(self, agent: str, text: str) -> None:
        """See `LaunchReporter`."""
        show_text(text, head=self._heads[agent])

    def told(self, agent: str, event: str, text: str) -> None:
        """See `LaunchReporter`."""
        show_text(f"{agent} {text}" if agent else text, err=True)


class _Objects:
    """Print one JSON object per line: `{agent, line}`, or `{agent, event, text}`."""

    def line(self, agent: str, text: str) -> None:
        """See `LaunchReporter`."""
        self._print({"agent": agent, "line": text})

    def told(self, agent: str, event: str, text: str) -> None:
        """See `LaunchReporter`."""
        self._print({"agent": agent or None, "event": event, "text": text})

    def _print(self, value: dict[str, Any]) -> None:
        import json

        show_text(printable_data(json.dumps(value, ensure_ascii=False)))
