"""The fork server of a launcher, whose agents start in half the time, and share what is loaded. Linux alone.

While an agent is forked the launcher is what Linux calls a child subreaper: it becomes the parent of the agent as the
process between the two ends, and learns like that of any child how it ends.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import Final

import msgpack

from pancakes.tools.launch.forked_process import ForkedProcess

PROGRAM: Final = "pancakes.tools.cli.forking_program"
ANSWER_BYTES: Final = 64
ANSWER_S: Final = 30.0
"""An agent is forked within so long, and what it needs is loaded before the first one; else there is none."""
_PR_SET_CHILD_SUBREAPER: Final = 36  # from <linux/prctl.h>


class ForkServer:
    """The launcher's end of its fork server, which begins with the first agent, and anew where it has ended.

    To be used in one thread that stays: the fork server and the agents end with it.

    Args:
        environment: the environment of the agents; None: that of this process, as it is when the first one starts.
        program: the module that forks; one that uses `pancakes.tools.cli.forking_program` may fork other programs.
        own_session: whether the fork server, and with it what it forks, has a session of its own.
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
        """Forks an agent.

        Args:
            arguments: those of `pancakes-agent`, without `--ready-fd`.
            output: the file descriptor that takes its standard output and error.
            ready_fd: the one that it tells when it is ready; None: none.

        Raises:
            OSError: no process can be made.
        """
        files = (output,) if ready_fd is None else (output, ready_fd)
        return ForkedProcess(self.fork_for(msgpack.packb(list(arguments)), files))

    def fork_for(self, message: bytes, files: Sequence[int]) -> int:
        """Forks a child for a message to the program; returns its process number.

        Args:
            message: what the child is to do.
            files: the file descriptors that it gets.

        Raises:
            OSError: no process can be made.
        """
        for _ in range(2):
            try:
                pid, error = msgpack.unpackb(self._ask(message, files))
            except ConnectionError:
                self.close()  # it has ended: another one begins
            except TimeoutError:
                self.close()
                raise
            else:
                if error:
                    raise OSError(error, os.strerror(error))
                return int(pid)
        raise OSError(errno.ECHILD, f"the fork server, {self._program}, ends as it begins")

    def close(self) -> None:
        """Ends the fork server. Its agents go on."""
        if self._channel is not None:
            self._channel.close()
            self._channel = None
        if self._process is not None:
            self._process.kill()  # it may stand still
            self._process.wait()
            self._process = None

    def _ask(self, message: bytes, files: Sequence[int]) -> bytes:
        channel = self._channel or self._begin()
        _adopt_orphans(True)
        try:
            socket.send_fds(channel, [message], files)
            answer = channel.recv(ANSWER_BYTES)
        finally:
            _adopt_orphans(False)
        if not answer:
            raise ConnectionResetError
        return answer

    def _begin(self) -> socket.socket:
        channel, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        channel.settimeout(ANSWER_S)
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
    """Has the children of this process's children come to it where their parents end, or no longer."""
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, int(adopts), 0, 0, 0)
