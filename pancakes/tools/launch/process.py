"""Start and end the processes of launched agents, by a fork server or `subprocess`.

On Linux the agents are forked from one process that has already loaded what they need: they start in half the time and
share memory. While it forks an agent, the launcher is a child subreaper: it becomes the agent's parent, and gets its
exit code. Use a `Starter` in one long-lived thread: when that thread ends, the agents end.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

import msgpack
import psutil

from pancakes.tools.remote_host.agent_processes import AgentProcess
from pancakes.util.clock import MonotonicClock


class ForkedProcess:
    """A child process that was forked elsewhere, with the interface of `subprocess.Popen`.

    Attributes:
        pid: its process number.
        returncode: its exit code, or minus the number of the signal that ended it; None: it runs, or `poll` was not
            called since it ended.
    """

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._process = psutil.Process(pid)

    def poll(self) -> int | None:
        """Return the exit code; None: the process runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait until the process has ended; return its exit code.

        Raises:
            subprocess.TimeoutExpired: it still runs after `timeout` seconds.
        """
        if self.returncode is None:
            try:
                self.returncode = int(self._process.wait(timeout))
            except psutil.TimeoutExpired:
                raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0) from None
        return self.returncode

    def terminate(self) -> None:
        """Send SIGTERM if the process runs."""
        self._send(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL if the process runs."""
        self._send(signal.SIGKILL)

    def _send(self, number: signal.Signals) -> None:
        if self.returncode is None:
            with contextlib.suppress(psutil.NoSuchProcess):
                self._process.send_signal(number)


PROGRAM: Final = "pancakes.tools.cli.fork_server"
ANSWER_BYTES: Final = 64
ANSWER_S: Final = 30.0
"""How long the fork server may take to fork an agent, in seconds; the first time it also loads the modules."""
_PR_SET_CHILD_SUBREAPER: Final = 36  # from <linux/prctl.h>


def packed(arguments: Sequence[str]) -> bytes:
    """Return the message with the arguments of a program; a path may have bytes that are not UTF-8."""
    return bytes(msgpack.packb(list(arguments), unicode_errors="surrogateescape"))


class ForkServer:
    """The launcher's end of its fork server, which starts with the first agent, and again if it has ended.

    Use it in one long-lived thread: when that thread ends, the fork server and the agents end.

    Args:
        environment: the environment of the agents; None: that of this process when the first agent starts.
        program: the module that forks; one that uses `pancakes.tools.cli.fork_server` may fork other programs.
        own_session: whether the fork server and its children have a session of their own.
    """

    def __init__(
        self, environment: Mapping[str, str] | None = None, program: str = PROGRAM, own_session: bool = True
    ) -> None:
        self._environment = environment
        self._program = program
        self._own_session = own_session
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None

    def fork(self, arguments: Sequence[str], output: int, ready_fd: int | None) -> ForkedProcess:
        """Fork an agent.

        Args:
            arguments: those of `pancakes-agent`, without `--ready-fd`.
            output: the file descriptor of its standard output and error.
            ready_fd: the file descriptor that it writes to once it is ready; None: none.

        Raises:
            OSError: the process cannot be created.
        """
        files = (output,) if ready_fd is None else (output, ready_fd)
        return ForkedProcess(self.fork_for(packed(arguments), files))

    def fork_for(self, message: bytes, files: Sequence[int]) -> int:
        """Send a message to the program, which forks a child for it; return the child's process number.

        Args:
            message: what the child will do.
            files: the file descriptors that it gets.

        Raises:
            OSError: the process cannot be created.
        """
        for _ in range(2):
            try:
                pid, error = msgpack.unpackb(self._ask(message, files))
            except ConnectionError:
                self.close()  # the fork server has ended: start another one
            except TimeoutError:
                self.close()
                raise
            else:
                if error:
                    raise OSError(error, os.strerror(error))
                return int(pid)
        raise OSError(errno.ECHILD, f"the fork server, {self._program}, ends at its start")

    def close(self) -> None:
        """End the fork server. The agents run on."""
        if self._channel is not None:
            self._channel.close()
            self._channel = None
        if self._process is not None:
            self._process.kill()  # it may hang, so do not ask it to end
            self._process.wait()
            self._process = None

    def _ask(self, message: bytes, files: Sequence[int]) -> bytes:
        channel = self._channel or self._begin()
        _adopt_orphans(True)
        try:
            channel.settimeout(ANSWER_S)
            socket.send_fds(channel, [message], files)
            answer = channel.recv(ANSWER_BYTES)
        finally:
            _adopt_orphans(False)
        if not answer:
            raise ConnectionResetError
        return answer

    def _begin(self) -> socket.socket:
        channel, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with there:
            self._process = subprocess.Popen(
                [sys.executable, "-m", self._program, str(there.fileno()), str(os.getpid())],
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=self._own_session,
                pass_fds=(there.fileno(),),
            )
        self._channel = channel
        return channel


def _adopt_orphans(adopts: bool) -> None:
    """Make this process the new parent of its grandchildren whose parent ends, or stop that."""
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, int(adopts), 0, 0, 0)


HOST = MonotonicClock()
"""Processes are timed in host time, whatever the mission clock does."""


class Starter:
    """Start agents, each in its own process. Use it in one long-lived thread: the agents end with that thread."""

    def __init__(self) -> None:
        self._server = ForkServer() if sys.platform.startswith("linux") else None

    def start(self, config: Path, sets: Sequence[str], output: int, ready_fd: int | None = None) -> AgentProcess:
        """Start `pancakes-agent`.

        Args:
            config: its configuration file.
            sets: the changes to that file, as `--set` takes them.
            output: the file descriptor of its standard output and error.
            ready_fd: a file descriptor that it writes a line to once it is ready.

        Raises:
            OSError: the process cannot be created.
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
            # Its own session: Ctrl-C at the terminal reaches only the launcher, which stops its agents gracefully.
            start_new_session=True,
            pass_fds=() if ready_fd is None else (ready_fd,),
        )

    def close(self) -> None:
        """Start no more agents; those that run continue."""
        if self._server is not None:
            self._server.close()


def end_all(processes: Iterable[AgentProcess], within_s: float) -> None:
    """End processes and wait for it: gracefully within `within_s` seconds, then by force."""
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
