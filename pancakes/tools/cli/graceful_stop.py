"""Stop agents gracefully: ask each to end, wait until it is gone, and send a signal to those that do not answer.

`GracefulStop` ends agents group by group: simulated worlds last, and the agents of a fleet file in reverse order of
their `after`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pancakes.client import Client, Target
from pancakes.control import Shutdown
from pancakes.errors import PancakesError, UnreachableError
from pancakes.tools.cli.exit_codes import OK, REFUSED, UNREACHABLE
from pancakes.tools.cli.output import DRY_RUN, show_text
from pancakes.util.clock import MonotonicClock
from pancakes.util.runtime_dir import RunningAgent, entries

if TYPE_CHECKING:
    import psutil

    from pancakes.tools.launch.fleet_file import Member
    from pancakes.tools.launch.remote_hosts import Host


ENDING_S: Final = 1.0
"""How long an agent that does not answer may take to end, if something else has told it to, in seconds."""

HOST: Final = MonotonicClock()
"""Processes are timed in host time."""
_LOOK_S: Final = 0.05
"""How often a process is looked at until it has ended, in seconds."""


@dataclass
class _Stopped:
    """One agent that has to end.

    Attributes:
        process: its process, if that is on this machine.
        host: the other host on which it runs; None: this machine, or unknown.
        gone: whether it has ended.
    """

    name: str
    fleet: str
    role: str
    process: psutil.Process | None
    host: Host | None = None
    gone: bool = False


class GracefulStop:
    """End agents of one fleet after the other.

    Args:
        timeout_s: how long an agent may take to answer, and to end.
        dry_run: whether to ask only whether each agent would end.

    Attributes:
        timeout_s, dry_run: the same.
        rows: what was done.
        code: the exit code so far.
    """

    def __init__(self, timeout_s: float, dry_run: bool) -> None:
        self.timeout_s = timeout_s
        self.dry_run = dry_run
        self.rows: list[dict[str, Any]] = []
        self.code = OK
        self._refused = False

    def end_all(self, here: Mapping[tuple[str, str], RunningAgent], fleet: str) -> None:
        """End the agents of this machine, or only those of one fleet. Agents on other machines keep running."""
        from pancakes.tools.launch.detached import launchers_of

        launchers = launchers_of([entry.pid for entry in here.values()], here_only=True)
        reached = list(here.values())
        names = [entry.name for entry in reached]
        if len(set(names)) < len(names):
            # Agents of several fleets have the same name: their addresses tell them apart.
            for entry in sorted(reached, key=lambda entry: (entry.role == "environment", entry.fleet, entry.name)):
                self.end_named(Target(entry.listen[:1], entry.fleet), [entry.name], here)
        elif names:
            self.end_named(Target(fleet=fleet), names, here)
        self._end_launchers(launchers)

    def end_named(self, at: Target, names: Sequence[str], here: Mapping[tuple[str, str], RunningAgent]) -> None:
        """End agents that are found at some addresses; without addresses, on this machine."""
        with Client(at, self.timeout_s) as client:
            described, sentences = _described(client, names)
            answered = {(it["fleet"], it["agent"]) for it in described}
            # With an address, a named agent may be on another machine: an agent of that name here is a different one.
            silent = (
                [] if at.addresses else [it for key, it in here.items() if it.name in names and key not in answered]
            )
            if len(sentences) > len(silent):
                self.code = UNREACHABLE
            targets = [_target(it, here) for it in described]
            worlds = [target for target in targets if target.role == "environment"]
            self._end_group(client, [it for it in targets if it not in worlds], [_target_of(entry) for entry in silent])
            self._end_group(client, worlds)

    def end_fleet(self, files: Sequence[Path], names: Sequence[str]) -> None:
        """End the agents of a fleet's files that run, or only those that are named.

        Raises:
            PancakesError: a file is invalid, or they lack a named agent.
        """
        from pancakes.tools.launch.detached import launchers_of, process_of
        from pancakes.tools.launch.fleet_file import make_fleet
        from pancakes.tools.launch.remote_hosts import open_hosts, tunnels

        members = make_fleet(files, (), None, None)
        if unknown := [name for name in names if all(member.name != name for member in members)]:
            known = ", ".join(member.name for member in members)
            raise PancakesError(f"{' '.join(map(str, files))} has no agent {unknown[0]!r}. It has {known}")
        wanted = [member for member in members if not names or member.name in names]
        here = {(entry.fleet, entry.name): entry for entry in entries()}
        launchers: list[int] = []

        def unreached(problem: str) -> None:
            self._fail(problem, UNREACHABLE)  # the agents on other hosts end nevertheless

        with open_hosts(wanted, unreached) as hosts, tunnels(hosts.values()) as tunnel_of, ExitStack() as stack:
            targets: dict[str, _Stopped] = {}
            addresses: dict[str, list[str]] = {}
            for member in wanted:
                fleet, role = member.config.agent.fleet, member.config.agent.role
                entry = None if member.host else here.get((fleet, member.name))
                if member.host in hosts and hosts[member.host].runs(member):
                    targets[member.name] = _Stopped(member.name, fleet, role, None, hosts[member.host])
                    addresses.setdefault(fleet, []).append(tunnel_of[member.name])
                elif entry is not None:
                    targets[member.name] = _target_of(entry)
                    addresses.setdefault(fleet, []).extend(entry.listen[:1])
            if not targets and self.code == OK:
                show_text(f"no agent of {' '.join(map(str, files))} runs", err=True)
            if not names:
                # Before the agents end: then their parents are known.
                running = [it.process.pid for it in targets.values() if it.process is not None]
                launchers = launchers_of(running, here_only=not any(member.host for member in wanted))
            clients = {
                fleet: stack.enter_context(Client(Target(tuple(at), fleet), self.timeout_s))
                for fleet, at in addresses.items()
            }
            for wave in waves([member for member in wanted if member.name in targets]):
                for fleet, client in clients.items():
                    group = [targets[member.name] for member in wave if member.config.agent.fleet == fleet]
                    described, _ = _described(client, [target.name for target in group]) if group else ([], [])
                    names_described = {it["agent"] for it in described}
                    answering = [it for it in group if it.name in names_described]
                    self._end_group(client, answering, [it for it in group if it.name not in names_described])

        if not names and (pid := process_of(files)) is not None:
            launchers.append(pid)
        self._end_launchers(launchers)

    def _end_launchers(self, pids: Sequence[int]) -> None:
        """End the processes that run the agents which have ended: with the policy always, they restart them."""
        import psutil

        if self.dry_run or self._refused:
            return
        for pid in dict.fromkeys(pids):
            process = _process(pid)
            if process is None:
                continue
            # It ends by itself, with the code of its agents, unless it restarts them.
            if _ends_within(process, ENDING_S):
                continue
            with suppress(psutil.NoSuchProcess):
                process.terminate()
            if not _ends_within(process, self.timeout_s):
                self._fail(f"pancakes up (process {pid}) has not ended within {self.timeout_s:g} s", UNREACHABLE)

    def _end_group(self, client: Client, answering: Sequence[_Stopped], silent: Sequence[_Stopped] = ()) -> None:
        """End agents at the same time, and wait until they are gone. Silent ones are ended by a signal."""
        ending = [target for target in silent if self._signal(target)]
        ending += [target for target in answering if self._ask(client, target)]

        def all_gone() -> bool:
            for target in ending:
                # Keep the first "gone": a launcher may start the agent again meanwhile.
                target.gone = target.gone or _is_gone(client, target)
            return all(target.gone for target in ending)

        client.wait(all_gone, self.timeout_s)
        for target in ending:
            if target.gone:
                self._done(target, "ended")
            else:
                process = f" (process {target.process.pid})" if target.process is not None else ""
                self._fail(f"{target.name}{process} has not ended within {self.timeout_s:g} s", UNREACHABLE)

    def _ask(self, client: Client, target: _Stopped) -> bool:
        """Ask an agent to end; return whether it will end."""
        try:
            reply = client.request(target.name, Shutdown(self.dry_run))
        except UnreachableError as error:
            # Its launcher may be about to end it, because others of its fleet have ended.
            if target.process is not None and client.wait(lambda: _is_gone(client, target), ENDING_S):
                return True
            self._fail(str(error), UNREACHABLE)
            return False
        if not reply.ok:
            self._fail(f"{target.name} does not end: {reply.reason}", REFUSED)
            return False
        if self.dry_run:
            self._done(target, DRY_RUN)
        return not self.dry_run

    def _signal(self, target: _Stopped) -> bool:
        """End an agent that does not answer, such as one whose network sleeps; return whether to wait for it."""
        if self.dry_run:
            self._done(target, DRY_RUN)
            return False
        if target.host is not None:
            self._end_there(target, target.host)
            return False
        import psutil

        if target.process is None:
            target.gone = True
            return True
        pid = target.process.pid
        try:
            target.process.terminate()
        except psutil.NoSuchProcess:
            target.gone = True
            return True
        except psutil.AccessDenied:
            self._fail(f"{target.name} (process {pid}) belongs to another user", REFUSED)
            return False
        show_text(f"{target.name} does not answer: sent a signal to its process {pid}", err=True)
        return True

    def _end_there(self, target: _Stopped, host: Host) -> None:
        from pancakes.tools.launch.ssh import HostError

        try:
            gone = host.link.obtain("end_process", fleet=target.fleet, name=target.name, within=self.timeout_s)
        except HostError as error:
            self._fail(str(error), REFUSED)
            return
        if gone:
            self._done(target, "ended")
        else:
            self._fail(f"{target.name} has not ended on {host.name} within {self.timeout_s:g} s", UNREACHABLE)

    def _done(self, target: _Stopped, done: str) -> None:
        host = target.host.name if target.host is not None else ""
        row = {"agent": target.name, "fleet": target.fleet, "role": target.role, "host": host, "done": done}
        self.rows.append(row)

    def _fail(self, sentence: str, code: int) -> None:
        show_text(sentence, err=True)
        self.code = max(self.code, code)
        self._refused = self._refused or code == REFUSED


def waves(members: Sequence[Member]) -> Iterator[list[Member]]:
    """Yield agents in the order in which they end: an agent ends only after those that start after it."""
    left = list(members)
    while left:
        needed = {other for member in left for other in member.after}
        wave = [member for member in reversed(left) if member.name not in needed] or left
        yield wave
        left = [member for member in left if member not in wave]


def _described(client: Client, names: Sequence[str]) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the descriptions of agents, and print a sentence for each that does not answer; return both."""
    found, silent = _survey(client, names)
    for sentence in silent:
        show_text(sentence, err=True)
    return found, silent


def _survey(client: Client, names: Sequence[str]) -> tuple[list[dict[str, Any]], list[str]]:
    try:
        found = client.describe(*names)
    except UnreachableError as error:
        if len(names) < 2:
            return [], str(error).splitlines()
        parts = [_survey(client, [name]) for name in names]
        return [it for part, _ in parts for it in part], [sentence for _, part in parts for sentence in part]
    return list(found.agents), list(found.silent)


def _target(described: dict[str, Any], here: Mapping[tuple[str, str], RunningAgent]) -> _Stopped:
    name, fleet = described["agent"], described["fleet"]
    entry = here.get((fleet, name))
    # Agents of the same name may run here and elsewhere: compare process ids to know which of them answered.
    process = described["process"]
    is_here = entry is not None and process is not None and process["pid"] == entry.pid
    return _Stopped(name, fleet, described["role"], _process(entry.pid) if is_here and entry is not None else None)


def _target_of(entry: RunningAgent) -> _Stopped:
    return _Stopped(entry.name, entry.fleet, entry.role, _process(entry.pid))


def _process(pid: int) -> psutil.Process | None:
    """Return a process, or None if it has ended already."""
    import psutil

    try:
        return psutil.Process(pid)
    except psutil.NoSuchProcess:
        return None


def _is_gone(client: Client, target: _Stopped) -> bool:
    if target.process is None:
        return not client.is_connected(target.name, target.fleet)
    return _has_ended(target.process)


def _ends_within(process: psutil.Process, timeout_s: float) -> bool:
    """Wait for the end of a process; return whether it has ended."""
    import psutil

    until_s = HOST.now() + timeout_s
    while not _has_ended(process):
        if HOST.now() > until_s:
            return False
        with suppress(psutil.NoSuchProcess, psutil.TimeoutExpired):
            process.wait(_LOOK_S)
    return True


def _has_ended(process: psutil.Process) -> bool:
    """Return whether a process has ended, also if its parent has not asked for its exit code."""
    import psutil

    try:
        return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True
