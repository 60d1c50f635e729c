"""The process of one launched agent: it ends with its launcher, however that ends."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import IO

from pancakes.runtime.clock import MonotonicClock

HOST = MonotonicClock()
"""Processes live in the host's time, whatever the mission's clock does."""


def start_agent(
    config: Path, sets: Sequence[str], output: int | IO[bytes], ready_fd: int | None = None
) -> subprocess.Popen[bytes]:
    """Starts `pancakes-agent`. To be called in a thread that stays: the agent ends with it.

    Args:
        config: its configuration file.
        sets: what is changed of that, as `--set` takes it.
        output: what takes its standard output and error.
        ready_fd: a file descriptor that it writes a line to once it is ready.

    Raises:
        OSError: no process can be made.
    """
    command = [sys.executable, "-m", "pancakes.tools.cli.agent_command", "--config", str(config)]
    command.append(f"--die-with-parent={os.getpid()}")
    for change in sets:
        command += ["--set", change]
    if ready_fd is not None:
        command.append(f"--ready-fd={ready_fd}")
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=output,
        # A session of its own: an interrupt at the terminal reaches the launcher, which stops its agents in order.
        start_new_session=True,
        pass_fds=() if ready_fd is None else (ready_fd,),
    )


def end_all(processes: Iterable[subprocess.Popen[bytes]], within_s: float) -> None:
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
