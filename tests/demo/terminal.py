"""A terminal that a command runs in: a pseudo-terminal, and what a person would see on its screen."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import signal
import struct
import termios
import time
from types import TracebackType

import pyte
from harness.programs import Program, pancakes

PATIENCE_S = 90.0


class Terminal:
    """`pancakes` with these arguments in a terminal of this size; used in a `with` statement.

    Attributes:
        process: the command.
    """

    def __init__(self, rows: int, columns: int, *arguments: str) -> None:
        self._screen = pyte.HistoryScreen(columns, rows, history=10_000, ratio=1.0)
        self._stream = pyte.ByteStream(self._screen)
        self._ours, theirs = pty.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        environment = {key: value for key, value in os.environ.items() if key not in ("COLUMNS", "LINES", "NO_COLOR")}
        self.process = Program(
            pancakes(*arguments),
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
            env={**environment, "TERM": "xterm-256color"},
        )
        os.close(theirs)

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, traceback: TracebackType | None) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait(PATIENCE_S)
        os.close(self._ours)

    def screens_until(self, text: str) -> list[str]:
        """Waits until `text` is on the screen; returns what the screen showed after each thing that was written."""
        screens: list[str] = []
        until_s = time.monotonic() + PATIENCE_S
        while not screens or text not in screens[-1]:
            assert time.monotonic() < until_s and self._read(), f"{text!r} was never shown, but:\n{self.everything()}"
            screens.append(self._shown())
        return screens

    def interrupt(self) -> int:
        """Presses Ctrl-C, and returns the exit code."""
        self.process.send_signal(signal.SIGINT)
        while self._read():
            pass
        return self.process.wait(PATIENCE_S)

    def everything(self) -> str:
        """Returns what is on the screen, below all that has scrolled out of it."""
        columns = range(self._screen.columns)
        gone = ["".join(line[column].data for column in columns).rstrip() for line in self._screen.history.top]
        return "\n".join([*gone, self._shown()])

    def _shown(self) -> str:
        return "\n".join(line.rstrip() for line in self._screen.display)

    def _read(self) -> bool:
        """Takes what was written next; returns whether there may be more."""
        ready, _, _ = select.select([self._ours], [], [], PATIENCE_S)
        try:
            data = os.read(self._ours, 65_536) if ready else b""
        except OSError:  # the last process has closed it
            data = b""
        self._stream.feed(data)
        return bool(data)
