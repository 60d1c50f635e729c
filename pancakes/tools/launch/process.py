"""The process of one launched agent: it ends with its launcher, however that ends."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from pancakes.runtime.clock import MonotonicClock
from pancakes.tools.launch.fork_server import ForkServer
from pancakes.tools.launch.forked_process import ForkedProcess

HOST = MonotonicClock()
"""Processes live in the host's time, whatever the mission's clock does."""

AgentProcess = subprocess.Popen[bytes] | ForkedProcess


class Starter:
    """Starts agents, each a process of its own. In one thread that stays: the agents end with it."""

    def __init__(self) -> None:
        self._server = ForkServer() if sys.platform.startswith("linux") else None

    def start(self, config: Path, sets: Sequence[str], output: int, ready_fd: int | None = None) -> AgentProcess:
        """Starts `pancakes-agent`.

        Args:
            config: its configuration file.
            sets: what is changed of that, as `--set` takes it.
            output: the file descriptor that takes its standard output and error.
            ready_fd: a file descriptor that it writes a line to once it is ready.

        Raises:
            OSError: no process can be made.
        """
        arguments = ["--config", str(config), f"--die-with-parent={os.getpid()}"]
        for change in sets:
            arguments += ["--set", change]
        if self._server is not None:
            return self._server.fork(arguments, output, ready_fd)
        if ready_fd is not None:
            arguments.append(f"--ready-fd={ready_fd}")
        return subprocess.Popen(
            [sys.executable, "-m", "pancakes.tools.cli.agent_command", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            # A session of its own: an interrupt at the terminal reaches the launcher, which stops its agents in order.
            start_new_session=True,
            pass_fds=() if ready_fd is None else (ready_fd,),
        )

    def close(self) -> None:
        """Starts no more agents; those that it has started go on."""
        if self._server is not None:
            self._server.close()


def end_all(processes: Iterable[AgentProcess], within_s: float) -> None:
    """Ends processes, and waits for that: in good order where they can, by force where they do not in time."""
    running = [process for process in processes if process.poll() is None]
    for process in running:
        process.terminate()
    deadline_s = HOST.now() + within_s
    for process in running:
        try:
            process.wait(max(0.0, deadline_s - HOST.now()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
