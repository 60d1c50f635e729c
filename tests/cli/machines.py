"""Machines for tests of fleets: each has its own home and address, and shares nothing with the others."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from cli.processes import PATIENCE_S, Running
from harness.programs import run
from torture.live import free_ports
from torture.namespaces import Namespaces, NoNamespaces, check

PANCAKES = ("-m", "pancakes.tools.cli.main")
AGENT = ("-m", "pancakes.tools.cli.agent_command")
PASSWORD = "a long way home"


class Machine:
    """One machine.

    Args:
        home: the home of its user.
        host: its address.
        port: the port of its agent.
        command: the prefix of each command that runs there.
        true_start: whether to start a new Python for each command, because a fork server has another network.
    """

    def __init__(self, home: Path, host: str, port: int, command: Sequence[str] = (), true_start: bool = False) -> None:
        self.home, self.host, self.port = home, host, port
        self.command = [*command, sys.executable]
        self.address = f"{host}:{port}"
        self.true_start = true_start
        home.mkdir(mode=0o700)
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("PANCAKES_", "XDG_"))}
        self.environment = {**kept, "HOME": str(home), "PANCAKES_RUNTIME_DIR": str(home / "run")}
        self._running: list[Running] = []

    def pancakes(self, *arguments: str, typed: str = "") -> subprocess.CompletedProcess[str]:
        """Run a command to its end, without a terminal; `typed` is its standard input."""
        return run(
            [*self.command, *PANCAKES, *arguments],
            given=typed,
            timeout_s=PATIENCE_S,
            true_start=self.true_start,
            env=self.environment,
            cwd=self.home,
            start_new_session=True,
        )

    def said(self, *arguments: str, typed: str = "") -> str:
        """Run a command that must succeed, and return its output."""
        ended = self.pancakes(*arguments, typed=typed)
        assert ended.returncode == 0, ended.stderr
        return ended.stdout

    def begin(self, *arguments: str, typed: str = "") -> Running:
        """Start a command that keeps running."""
        lines = self.home / "typed"
        lines.write_text(typed)
        return self._run(["sh", "-c", 'exec "$@" < typed', "sh", *self.command, *PANCAKES, *arguments], whole=True)

    def agent(self, name: str, peers: Sequence[str] = (), rest: str = "") -> Running:
        """Start an agent of the fleet garage."""
        config = self.home / f"{name}.toml"
        config.write_text(
            f'schema = 1\ndevice.load = {{ driver = "host.load", rate_hz = 2 }}\n[agent]\nname = "{name}"\n'
            f'fleet = "garage"\nlisten = "tcp://{self.address}"\npeers = {list(peers)}\n{rest}\n'
        )
        return self._run([*self.command, *AGENT, "--config", str(config)])

    def _run(self, command: list[str], whole: bool = False) -> Running:
        running = Running(command, self.environment, self.home, whole, true_start=self.true_start)
        self._running.append(running)
        return running

    def bring(self, folder: str, other: Machine) -> None:
        """Move a folder from this home to that of another machine, as with a memory stick."""
        shutil.move(self.home / folder, other.home / folder)

    def close(self) -> None:
        """End all running commands."""
        for running in self._running:
            running.close()


@contextmanager
def machines(directory: Path, names: Sequence[str], kind: str) -> Iterator[list[Machine]]:
    """Yield machines: `homes` on the loopback interface, or `namespaces` with a network each.

    Machines in namespaces need root; if they are not available, the test is skipped, with the reason.
    """
    made: list[Machine] = []
    try:
        if kind == "homes":
            made += [
                Machine(directory / name, "127.0.0.1", port)
                for name, port in zip(names, free_ports(len(names)), strict=True)
            ]
            yield made
            return
        try:
            check()
        except NoNamespaces as error:
            pytest.skip(str(error))
        with Namespaces() as spaces:  # the first one is that of this thread and its children
            places = [*spaces.places, *(spaces.add() for _ in names[1:])]
            for name, place in zip(names, places, strict=True):
                command = () if place is places[0] else place.command
                made.append(Machine(directory / name, place.host, 7401, command, true_start=True))
            yield made
    finally:
        for machine in made:
            machine.close()
