"""The process of an agent that the fork server has forked."""

from __future__ import annotations

import contextlib
import signal
import subprocess

import psutil


class ForkedProcess:
    """A child that `subprocess` has not made, and that is used as one that it has.

    Attributes:
        pid: its number.
        returncode: its exit code, minus the number of the signal that ended it; None: it runs, or `poll` was not asked.
    """

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._process = psutil.Process(pid)

    def poll(self) -> int | None:
        """Returns its exit code; None: it runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Waits until it has ended; returns its exit code.

        Raises:
            subprocess.TimeoutExpired: it has not within `timeout` seconds.
        """
        if self.returncode is None:
            try:
                self.returncode = int(self._process.wait(timeout))
            except psutil.TimeoutExpired:
                raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0) from None
        return self.returncode

    def terminate(self) -> None:
        """Sends it SIGTERM, where it runs."""
        self._send(signal.SIGTERM)

    def kill(self) -> None:
        """Sends it SIGKILL, where it runs."""
        self._send(signal.SIGKILL)

    def _send(self, number: signal.Signals) -> None:
        if self.returncode is None:
            with contextlib.suppress(psutil.NoSuchProcess):
                self._process.send_signal(number)
