"""Starts `pancakes` and `pancakes-agent` for tests by a fork server, in a tenth of the time that a new Python takes.

What is forked is a child of the test: `Program` is a `subprocess.Popen`, with environment, folder, files, session and
exit code as that has them. Only the start of Python itself is missing: modules are loaded already. A test that is about
the start says `true_start=True`.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgpack

from pancakes.tools.launch.process import ForkServer

PANCAKES = "pancakes.tools.cli.main"
AGENT = "pancakes.tools.cli.agent_command"
EXAMPLES = "examples."
TESTS = Path(__file__).resolve().parents[1]

_lock = threading.Lock()
_servers: list[ForkServer] = []


class Program(subprocess.Popen[str]):
    """A process; its pipes carry text.

    Args:
        command: what to run. `[sys.executable, "-m", PANCAKES or AGENT, ...]` and examples are forked, all else starts
            as always.
        true_start: whether a new Python starts all the same, because the test is about that.
        options: as those of `subprocess.Popen`.
    """

    def __init__(self, command: Sequence[str], *, true_start: bool = False, **options: Any) -> None:
        is_ours = command[:2] == [sys.executable, "-m"] and command[2].startswith((PANCAKES, AGENT, EXAMPLES))
        self._is_forked = is_ours and not true_start and sys.platform.startswith("linux")
        super().__init__(command, text=True, **options)

    # The one place of subprocess at which a child can be made in another way while all else stays as it is.
    def _execute_child(
        self, args, executable, preexec_fn, close_fds, pass_fds, cwd, env, startupinfo, creationflags, shell,
        p2cread, p2cwrite, c2pread, c2pwrite, errread, errwrite,
        restore_signals, gid, gids, uid, umask, start_new_session, process_group,
    ) -> None:  # fmt: skip
        if not self._is_forked:
            super()._execute_child(  # type: ignore[misc]
                args, executable, preexec_fn, close_fds, pass_fds, cwd, env, startupinfo, creationflags, shell,
                p2cread, p2cwrite, c2pread, c2pwrite, errread, errwrite,
                restore_signals, gid, gids, uid, umask, start_new_session, process_group,
            )  # fmt: skip
            return
        files = {0: p2cread, 1: c2pwrite, 2: errwrite} | {number: number for number in pass_fds}
        files = {number: number if file == -1 else file for number, file in files.items()}
        environment = dict(os.environ if env is None else env)
        check_environment(environment)
        group = None if process_group == -1 else process_group
        order = [*args[2:3], args[3:], environment, os.fspath(cwd or os.getcwd()), start_new_session, group]
        message = msgpack.packb([*order, list(files)])
        try:
            with _lock:
                self.pid = _server().fork_for(message, list(files.values()))
        finally:
            self._close_pipe_fds(p2cread, p2cwrite, c2pread, c2pwrite, errread, errwrite)  # type: ignore[attr-defined]
        self._child_created = True


def run(
    command: Sequence[str], *, timeout_s: float, true_start: bool = False, given: str = "", **options: Any
) -> subprocess.CompletedProcess[str]:
    """Runs a command to its end; returns what it printed. It reads `given` on its standard input."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | options
    with Program(command, true_start=true_start, **pipes) as process:
        try:
            out, err = process.communicate(given, timeout_s)
        except BaseException:
            process.kill()
            raise
    return subprocess.CompletedProcess(command, process.returncode, out, err)


def pancakes(*arguments: str) -> list[str]:
    """Returns the command that runs `pancakes`."""
    return [sys.executable, "-m", PANCAKES, *arguments]


def check_environment(environment: dict[str, str]) -> None:
    """Raises an `AssertionError` if Python would look at another environment at its start than it has here."""

    def of_start(variables: Any) -> dict[str, str]:
        found = {name: value for name, value in variables.items() if name.startswith(("PYTHON", "LC_", "LANG", "LD_"))}
        return {name: value for name, value in found.items() if name not in ("PYTHONPATH", "PYTHONUNBUFFERED")}

    wanted, had = of_start(environment), of_start(os.environ)
    other = sorted(name for name in wanted.keys() | had.keys() if wanted.get(name) != had.get(name))
    assert not other, f"Python looks at {', '.join(other)} as it starts: say true_start=True"


def close_server() -> None:
    """Ends the fork server of this process, if there is one. What it has forked goes on."""
    with _lock:
        while _servers:
            _servers.pop().close()


def _server() -> ForkServer:
    if not _servers:
        environment = {**os.environ, "PYTHONPATH": str(TESTS)}
        _servers.append(ForkServer(environment, "harness.forked_program", own_session=False))
    return _servers[0]
