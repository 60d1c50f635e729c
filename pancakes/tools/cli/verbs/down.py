"""`pancakes down`: ends agents in good order, and waits until they are gone."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from pancakes.client import Client, Where
from pancakes.control import Shutdown
from pancakes.errors import NoAnswer, Unreachable
from pancakes.runtime.runtime_dir import RunningAgent, entries
from pancakes.tools.cli.exit_codes import OK, REFUSED, UNREACHABLE
from pancakes.tools.cli.name_types import agents
from pancakes.tools.cli.options import Ask, dry_run_option, orders_agents
from pancakes.tools.cli.output import DRY_RUN, show_text

if TYPE_CHECKING:
    import psutil

COLUMNS = ("agent", "fleet", "role", "done")


@dataclass
class _Target:
    """One agent that is to end.

    Attributes:
        process: its process, where that is one of this machine.
        gone: whether it has ended.
    """

    name: str
    fleet: str
    role: str
    process: psutil.Process | None
    gone: bool = False


@click.command()
@agents
@click.option("--all", "all_", is_flag=True, help="With --at: all agents that are found from there.")
@dry_run_option
@orders_agents
def down(agents: tuple[str, ...], all_: bool, dry_run: bool, ask: Ask) -> None:
    """End agents: those that are named, or else all of this machine (with --fleet, of that fleet), until they are gone.

    Their tasks stop, their actuators hold, and their peers are told. A simulated world ends after the agents that act
    in it. An agent that has not ended within the time limit is named on standard error, and the exit code is then 3.
    A launcher does not start an agent again that was ended in this way, unless it was told to with --restart always.

    \b
    Example:
        pancakes down
        pancakes down agent1 agent2
        pancakes down --fleet field
        pancakes down --at 192.168.1.20:7401 --all --dry-run
    """
    if ask.where.addresses and not agents and not all_:
        raise click.UsageError("name the agents to end, or say --all for those that are found through --at")
    if all_ and (agents or not ask.where.addresses):
        raise click.UsageError("--all goes with --at alone: without both, all agents of this machine end")
    here = {
        (entry.fleet, entry.name): entry
        for entry in entries()
        if entry.role != "client" and ask.where.fleet in ("", entry.fleet)
    }
    ending = _Ending(ask.timeout_s, dry_run)
    if ask.where.addresses or agents:
        ending.end(ask.where, agents, here)
    else:
        if not here:
            of = f" of the fleet {ask.where.fleet}" if ask.where.fleet else ""
            show_text(f"no agent{of} runs on this machine", err=True)
        ending.end_all(here, ask.where.fleet)
    if ending.rows or ask.format_ == "json":
        ask.show(ending.rows, COLUMNS)
    sys.exit(ending.code)


class _Ending:
    """Ends agents of one fleet after the other.

    Attributes:
        rows: what was done.
        code: the exit code so far.
    """

    def __init__(self, timeout_s: float, dry_run: bool) -> None:
        self._timeout_s = timeout_s
        self._dry_run = dry_run
        self.rows: list[dict[str, Any]] = []
        self.code = OK

    def end_all(self, here: dict[tuple[str, str], RunningAgent], fleet: str) -> None:
        """Ends the agents of this machine, or of one fleet on it; those on other machines are left alone."""
        reached = list(here.values())
        names = [entry.name for entry in reached]
        if len(set(names)) < len(names):
            # Agents of several fleets have the same name: their addresses tell them apart.
            for entry in sorted(reached, key=lambda entry: (entry.role == "environment", entry.fleet, entry.name)):
                self.end(Where(entry.listen[:1], entry.fleet), [entry.name], here)
        elif names:
            self.end(Where(fleet=fleet), names, here)

    def end(self, at: Where, names: Sequence[str], here: dict[tuple[str, str], RunningAgent]) -> None:
        """Ends agents that are found from some addresses (none: on this machine)."""
        with Client(at, self._timeout_s) as client:
            try:
                found = client.survey(*names)
                described, silent = found.agents, found.silent
            except Unreachable as error:
                described, silent = [], str(error).splitlines()
            answered = {(told["fleet"], told["agent"]) for told in described}
            # An agent that was named together with an address may be on another machine. Its namesake here is another.
            mute = [] if at.addresses else [it for key, it in here.items() if it.name in names and key not in answered]
            for sentence in silent:
                show_text(sentence, err=True)
            if len(silent) > len(mute):
                self.code = UNREACHABLE
            self._end_processes(client, mute)
            targets = [_target(told, here) for told in described]
            worlds = [target for target in targets if target.role == "environment"]
            for group in ([target for target in targets if target not in worlds], worlds):
                self._await(client, [target for target in group if self._ask(client, target)])

    def _end_processes(self, client: Client, mute: Sequence[RunningAgent]) -> None:
        """Ends agents of this machine that do not answer, such as those whose network sleeps: by their processes."""
        import psutil

        targets = []
        for entry in mute:
            target = _Target(entry.name, entry.fleet, entry.role, None)
            if self._dry_run:
                self._done(target, DRY_RUN)
                continue
            try:
                target.process = psutil.Process(entry.pid)
                target.process.terminate()
            except psutil.NoSuchProcess:
                target.gone = True
            except psutil.AccessDenied:
                self._fail(f"{entry.name} (process {entry.pid}) belongs to another user", REFUSED)
                continue
            show_text(f"{entry.name} is told to end by a signal to its process {entry.pid}", err=True)
            targets.append(target)
        self._await(client, targets)

    def _ask(self, client: Client, target: _Target) -> bool:
        """Asks an agent to end; returns whether it does."""
        try:
            reply = client.request(target.name, Shutdown(self._dry_run))
        except NoAnswer as error:
            self._fail(str(error), UNREACHABLE)
            return False
        if not reply.ok:
            self._fail(f"{target.name} does not end: {reply.reason}", REFUSED)
            return False
        if self._dry_run:
            self._done(target, DRY_RUN)
        return not self._dry_run

    def _await(self, client: Client, targets: Sequence[_Target]) -> None:
        def all_gone() -> bool:
            for target in targets:
                # What was seen to be gone may come back: its launcher may start it again.
                target.gone = target.gone or _is_gone(client, target)
            return all(target.gone for target in targets)

        client.wait(all_gone, self._timeout_s)
        for target in targets:
            if target.gone:
                self._done(target, "ended")
            else:
                process = f" (process {target.process.pid})" if target.process is not None else ""
                self._fail(f"{target.name}{process} has not ended within {self._timeout_s:g} s", UNREACHABLE)

    def _done(self, target: _Target, done: str) -> None:
        self.rows.append({"agent": target.name, "fleet": target.fleet, "role": target.role, "done": done})

    def _fail(self, sentence: str, code: int) -> None:
        show_text(sentence, err=True)
        self.code = max(self.code, code)


def _target(described: dict[str, Any], here: dict[tuple[str, str], RunningAgent]) -> _Target:
    import psutil

    name, fleet = described["agent"], described["fleet"]
    entry = here.get((fleet, name))
    # An agent of this name may run here and another one elsewhere: only its own word says which was asked.
    told = described["process"]
    process = None
    if entry is not None and told is not None and told["pid"] == entry.pid:
        try:
            process = psutil.Process(entry.pid)
        except psutil.NoSuchProcess:  # it has ended already
            process = None
    return _Target(name, fleet, described["role"], process)


def _is_gone(client: Client, target: _Target) -> bool:
    import psutil

    if target.process is None:
        return not client.is_connected(target.name, target.fleet)
    try:
        return not target.process.is_running() or target.process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True
