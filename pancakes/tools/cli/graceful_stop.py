"""Stop agents in good order: ask them, wait until they are gone, and end by a signal those that do not answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pancakes.client import Client, Where
from pancakes.control import Shutdown
from pancakes.errors import NoAnswer, Unreachable
from pancakes.tools.cli.exit_codes import OK, REFUSED, UNREACHABLE
from pancakes.tools.cli.output import DRY_RUN, show_text
from pancakes.util.runtime_dir import RunningAgent

if TYPE_CHECKING:
    import psutil


@dataclass
class Target:
    """One agent that is to end.

    Attributes:
        process: its process, where that is one of this machine.
        host: the other host on which it runs; empty: this machine, or it is not known.
        gone: whether it has ended.
    """

    name: str
    fleet: str
    role: str
    process: psutil.Process | None
    host: str = ""
    gone: bool = False


class GracefulStop:
    """End agents of one fleet after the other.

    Args:
        timeout_s: how long an agent may take to answer, and to end.
        dry_run: whether it is only asked.

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

    def end_all(self, here: dict[tuple[str, str], RunningAgent], fleet: str) -> None:
        """End the agents of this machine, or of one fleet on it; those on other machines are left alone."""
        reached = list(here.values())
        names = [entry.name for entry in reached]
        if len(set(names)) < len(names):
            # Agents of several fleets have the same name: their addresses tell them apart.
            for entry in sorted(reached, key=lambda entry: (entry.role == "environment", entry.fleet, entry.name)):
                self.end(Where(entry.listen[:1], entry.fleet), [entry.name], here)
        elif names:
            self.end(Where(fleet=fleet), names, here)

    def end(self, at: Where, names: Sequence[str], here: dict[tuple[str, str], RunningAgent]) -> None:
        """End agents that are found from some addresses (none: on this machine)."""
        with Client(at, self.timeout_s) as client:
            described, silent = _described(client, names)
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
                self.end_some(client, group)

    def _end_processes(self, client: Client, mute: Sequence[RunningAgent]) -> None:
        """End agents of this machine that do not answer, such as those whose network sleeps: by their processes."""
        import psutil

        targets = []
        for entry in mute:
            target = Target(entry.name, entry.fleet, entry.role, None)
            if self.dry_run:
                self.done(target, DRY_RUN)
                continue
            try:
                target.process = psutil.Process(entry.pid)
                target.process.terminate()
            except psutil.NoSuchProcess:
                target.gone = True
            except psutil.AccessDenied:
                self.fail(f"{entry.name} (process {entry.pid}) belongs to another user", REFUSED)
                continue
            show_text(f"{entry.name} is told to end by a signal to its process {entry.pid}", err=True)
            targets.append(target)
        self._await(client, targets)

    def end_some(self, client: Client, targets: Sequence[Target]) -> None:
        """End agents that a client reaches, and wait until they are gone."""
        self._await(client, [target for target in targets if self._ask(client, target)])

    def _ask(self, client: Client, target: Target) -> bool:
        """Ask an agent to end; return whether it does."""
        try:
            reply = client.request(target.name, Shutdown(self.dry_run))
        except NoAnswer as error:
            self.fail(str(error), UNREACHABLE)
            return False
        if not reply.ok:
            self.fail(f"{target.name} does not end: {reply.reason}", REFUSED)
            return False
        if self.dry_run:
            self.done(target, DRY_RUN)
        return not self.dry_run

    def _await(self, client: Client, targets: Sequence[Target]) -> None:
        def all_gone() -> bool:
            for target in targets:
                # What was seen to be gone may come back: its launcher may start it again.
                target.gone = target.gone or _is_gone(client, target)
            return all(target.gone for target in targets)

        client.wait(all_gone, self.timeout_s)
        for target in targets:
            if target.gone:
                self.done(target, "ended")
            else:
                process = f" (process {target.process.pid})" if target.process is not None else ""
                self.fail(f"{target.name}{process} has not ended within {self.timeout_s:g} s", UNREACHABLE)

    def done(self, target: Target, done: str) -> None:
        """An agent has ended, or would."""
        row = {"agent": target.name, "fleet": target.fleet, "role": target.role, "host": target.host, "done": done}
        self.rows.append(row)

    def fail(self, sentence: str, code: int) -> None:
        """Something went wrong, which the exit code tells."""
        show_text(sentence, err=True)
        self.code = max(self.code, code)


def _described(client: Client, names: Sequence[str]) -> tuple[list[dict[str, Any]], list[str]]:
    """Return what agents say of themselves, and a sentence for each that says nothing; one hides no other."""
    try:
        found = client.survey(*names)
    except Unreachable as error:
        if len(names) < 2:
            return [], str(error).splitlines()
        parts = [_described(client, [name]) for name in names]
        return [told for part, _ in parts for told in part], [sentence for _, part in parts for sentence in part]
    return list(found.agents), list(found.silent)


def _target(described: dict[str, Any], here: dict[tuple[str, str], RunningAgent]) -> Target:
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
    return Target(name, fleet, described["role"], process)


def _is_gone(client: Client, target: Target) -> bool:
    import psutil

    if target.process is None:
        return not client.is_connected(target.name, target.fleet)
    try:
        return not target.process.is_running() or target.process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True
