"""Real processes for the tests of the command line: running agents, and `pancakes` commands.

All their files are in the test's own directory, they listen on free ports, and tests wait for their output.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import psutil
from harness.programs import AGENT, PANCAKES, Program, pancakes, run
from keys_in_test import KeysInTest

PATIENCE_S = 20.0
READY = "/kernel: ready"


def is_gone(pid: int) -> bool:
    """Whether a process has ended, with all its threads; it may wait until its parent has asked how.

    While another thread of it ends, the first one is a zombie already, and the process holds its files and locks.
    """
    try:
        ended = psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
        return ended and len(os.listdir(f"/proc/{pid}/task")) <= 1
    except (psutil.NoSuchProcess, FileNotFoundError, ProcessLookupError):  # it may end between these calls
        return True


def wait_until_gone(*pids: int) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while not all(map(is_gone, pids)):
        assert time.monotonic() < until_s
        time.sleep(0.02)


def processes_of_ssh(pid: int, host: str = "") -> list[psutil.Process]:
    """Return the processes of `ssh` (to a host) that a process has started, directly or not."""
    found = []
    for process in psutil.Process(pid).children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):  # it has just ended
            words = process.cmdline()
            if process.name() == "ssh" and (not host or host in words):
                found.append(process)
    return found


class Running:
    """A process, and its lines on standard error; with `whole`, also those on standard output.

    An agent may be `ours`: it ends with this thread. An interrupt at the terminal reaches only the test, which ends it.
    """

    def __init__(
        self,
        command: list[str],
        environment: dict[str, str],
        directory: Path,
        whole: bool = False,
        ours: bool = False,
        true_start: bool = False,
    ) -> None:
        self.process = Program(
            [*command, f"--die-with-parent={os.getpid()}"] if ours else command,
            true_start=true_start,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE if whole else subprocess.DEVNULL,
            stderr=subprocess.STDOUT if whole else subprocess.PIPE,
            env=environment,
            cwd=directory,
            process_group=0 if ours else None,
        )
        self._said_to = self.process.stdout if whole else self.process.stderr
        self.pid = self.process.pid
        self.said: list[str] = []
        self._silent = False
        self._lines: SimpleQueue[str | None] = SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._said_to is not None
        for line in self._said_to:
            self._lines.put(line.rstrip("\n"))
        self._lines.put(None)

    def hear(self, text: str) -> str:
        """Wait for the next line that contains `text`, and return it."""
        until_s = time.monotonic() + PATIENCE_S
        while not self._silent:
            try:
                line = self._next(max(0.0, until_s - time.monotonic()))
            except Empty:
                break
            if line is not None and text in line:
                return line
        raise AssertionError(f"{text!r} was never printed, but:\n" + "\n".join(self.said))

    def everything(self) -> str:
        """Wait until no process holds its standard error open, and return the whole output."""
        while not self._silent:
            self._next(PATIENCE_S)
        return "\n".join(self.said)

    def so_far(self) -> list[str]:
        """Return the output so far, without waiting."""
        while not self._silent and not self._lines.empty():
            self._next(0.0)
        return self.said

    def ended(self) -> int:
        """Wait for its end, and return its exit code."""
        code = self.process.wait(PATIENCE_S)
        self.everything()
        return code

    def _next(self, timeout_s: float) -> str | None:
        line = self._lines.get(timeout=timeout_s)
        if line is None:
            self._silent = True
        else:
            self.said.append(line)
        return line

    def close(self) -> None:
        """Kill the process if it still runs, and release it."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait(PATIENCE_S)
        self._reader.join(PATIENCE_S)
        assert self._said_to is not None
        self._said_to.close()

    def wait_for_file(self, path: Path) -> None:
        """Wait until a file exists, while the process runs."""
        until_s = time.monotonic() + PATIENCE_S
        while not path.exists():
            assert self.process.poll() is None, self.everything()
            assert time.monotonic() < until_s, f"{path} does not exist"
            time.sleep(0.01)

    def signalled(self, number: int) -> tuple[int, float]:
        """Send a signal, and wait for the end; return the exit code and the seconds that it took."""
        began_s = time.monotonic()
        self.process.send_signal(number)
        code = self.process.wait(PATIENCE_S)
        return code, time.monotonic() - began_s


INSECURE = "[service.network]\nsettings = { insecure = true }\n"
"""The configuration of an agent that uses TCP without keys."""


class Rig:
    """Start agents and commands whose files are all in one directory."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.runtime = directory / "runtime"
        self.plugins = directory / "plugins"
        self.plugins.mkdir()
        self.keys = KeysInTest(directory)
        self.environment = {
            **{key: value for key, value in os.environ.items() if not key.startswith("PANCAKES_")},
            "PANCAKES_RUNTIME_DIR": str(self.runtime),
            "XDG_STATE_HOME": str(directory / "state"),
            **self.keys.environment,
            "PYTHONPATH": str(self.plugins),
        }
        self._running: list[Running] = []

    def config(self, name: str, rest: str = "", *, fleet: str = "test", agent: str = "", file: str = "") -> Path:
        """Write the configuration of an agent that listens at a free port, and make its keys unless it is insecure."""
        if "insecure = true" not in rest:
            self.keys.of_agent(fleet, name, "environment" if 'role = "environment"' in agent else "agent")
        text = f'schema = 1\n\n[agent]\nname = "{name}"\nfleet = "{fleet}"\nlisten = "tcp://127.0.0.1:0"\n{agent}\n{rest}\n'
        path = self.directory / (file or f"{name}.toml")
        path.write_text(text)
        return path

    def install(self, name: str, entry_points: str, source: str) -> None:
        """Install a distribution with one module, `plugin_NAME`, as pip would leave it on disk."""
        information = self.plugins / f"{name}-1.0.dist-info"
        information.mkdir()
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (information / "entry_points.txt").write_text(entry_points)
        (self.plugins / f"plugin_{name}.py").write_text(source)

    def run(self, *command: str, whole: bool = False, ours: bool = False, true_start: bool = False) -> Running:
        """Start a Python process; see `Running` for `whole` and `ours`, `Program` for `true_start`."""
        running = Running([sys.executable, *command], self.environment, self.directory, whole, ours, true_start)
        self._running.append(running)
        return running

    def agent(self, config: Path | str, *options: str, ours: bool = False, true_start: bool = False) -> Running:
        """Start `pancakes-agent`; see `run`."""
        return self.run("-m", AGENT, "--config", str(config), *options, ours=ours, true_start=true_start)

    def ready(self, name: str, rest: str = "", *options: str, fleet: str = "test", agent: str = "") -> Running:
        """Start an agent, and wait until it is ready."""
        running = self.agent(self.config(name, rest, fleet=fleet, agent=agent), *options)
        running.hear(READY)
        self.entry(running.pid)
        return running

    def launch(self, *arguments: str | Path) -> Running:
        """Start `pancakes up`."""
        return self.run("-m", PANCAKES, "up", *map(str, arguments), whole=True)

    def entry(self, pid: int) -> dict[str, Any]:
        """Wait for a process's entry in the runtime directory, and return it."""
        until_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < until_s:
            for path in self.runtime.glob(f"*.{pid}.json"):
                found: dict[str, Any] = json.loads(path.read_text())
                return found
        raise AssertionError(f"the process {pid} is not in the runtime directory")

    def wait_until_gone(self, pid: int) -> None:
        """Wait until a process has removed its entry."""
        until_s = time.monotonic() + PATIENCE_S
        while any(self.runtime.glob(f"*.{pid}.json")):
            assert time.monotonic() < until_s, f"the process {pid} is still in the runtime directory"

    def address(self, running: Running) -> str:
        """Return the address at which an agent listens for other machines."""
        return self.addresses(running)[-1]

    def addresses(self, running: Running) -> list[str]:
        """Return all addresses at which an agent listens; the command line uses the first one."""
        listen: list[str] = self.entry(running.pid)["listen"]
        return listen

    def port(self, running: Running) -> int:
        """Return the port at which an agent listens."""
        return int(self.address(running).rpartition(":")[2])

    def pancakes(
        self, *arguments: str, true_start: bool = False, given: str = "", **changed: str
    ) -> subprocess.CompletedProcess[str]:
        """Run a command to its end.

        Args:
            arguments: its command line.
            true_start: whether to start a new Python, because the test is about that.
            given: its standard input.
            changed: environment variables that differ from the rig's.
        """
        return run(
            pancakes(*arguments),
            timeout_s=PATIENCE_S,
            true_start=true_start,
            given=given,
            env=self.environment | changed,
            cwd=self.directory,
        )

    def listed(self, *arguments: str) -> list[dict[str, Any]]:
        """Run a command that must succeed, and return its JSON output."""
        result = self.pancakes(*arguments, "--format", "json")
        assert result.returncode == 0, result.stderr
        rows: list[dict[str, Any]] = json.loads(result.stdout)
        return rows

    def close(self) -> None:
        """End all running processes."""
        for running in self._running:
            running.close()


def recovered(rig: Rig, *words: str) -> tuple[int, dict[str, Any], str]:
    """Run `pancakes task recover`; return its exit code, its one row, and its standard error."""
    result = rig.pancakes("task", "recover", *words, "--format", "json")
    rows = json.loads(result.stdout) if result.stdout else [{}]
    return result.returncode, rows[0], result.stderr


def troubles(rig: Rig) -> dict[str, str]:
    """Return the tasks that `pancakes task recover` lists, with what happened to each."""
    result = rig.pancakes("task", "recover", "--format", "json")
    found = {row["task_id"]: row["trouble"] for row in json.loads(result.stdout)}
    assert result.returncode == (1 if found else 0)
    return found
