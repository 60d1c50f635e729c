"""A `pancakes` command that keeps running, and its output."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
import time
from queue import Empty, SimpleQueue
from typing import Any

from cli.processes import PATIENCE_S, Rig
from harness.programs import Program, pancakes


class LiveOutput:
    """A running command, with the lines of its standard output and standard error.

    Args:
        rig: the rig with its agents.
        arguments: the command's arguments.
    """

    def __init__(self, rig: Rig, *arguments: str) -> None:
        self.process = Program(
            pancakes(*arguments),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=rig.environment,
            cwd=rig.directory,
        )
        self._lines: SimpleQueue[str] = SimpleQueue()
        self._said: SimpleQueue[str] = SimpleQueue()
        self.printed: list[str] = []
        self.said: list[str] = []
        self._threads = [
            threading.Thread(target=self._read, args=(self.process.stdout, self._lines), daemon=True),
            threading.Thread(target=self._read, args=(self.process.stderr, self._said), daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    @staticmethod
    def _read(stream: Any, lines: SimpleQueue[str]) -> None:
        for line in stream:
            lines.put(line.rstrip("\n"))

    def line(self, text: str = "") -> str:
        """Wait for the next line of standard output that contains `text`."""
        return self._next(self._lines, self.printed, text)

    def last(self) -> str:
        """Return the last line of standard output so far."""
        while not self._lines.empty():
            self.printed.append(self._lines.get())
        return self.printed[-1]

    def record(self, text: str = "") -> dict[str, Any]:
        """Wait for the next line that contains `text`, and parse it as JSON."""
        found: dict[str, Any] = json.loads(self.line(text))
        return found

    def hear(self, text: str) -> str:
        """Wait for the next line of standard error that contains `text`."""
        return self._next(self._said, self.said, text)

    def _next(self, lines: SimpleQueue[str], kept: list[str], text: str) -> str:
        while True:
            try:
                kept.append(lines.get(timeout=PATIENCE_S))
            except Empty:
                raise AssertionError(f"{text!r} never came, but:\n" + "\n".join([*self.printed, *self.said])) from None
            if text in kept[-1]:
                return kept[-1]

    def interrupt(self) -> int:
        """Press Ctrl-C, and return the exit code."""
        self.process.send_signal(signal.SIGINT)
        return self.ended()

    def ended(self) -> int:
        """Wait for the end, and return the exit code; then `printed` and `said` are complete."""
        code = self.process.wait(PATIENCE_S)
        for thread in self._threads:
            thread.join(PATIENCE_S)
        for lines, kept in ((self._lines, self.printed), (self._said, self.said)):
            while not lines.empty():
                kept.append(lines.get())
        return code

    def close(self) -> None:
        """Kill the command if it still runs."""
        if self.process.poll() is None:
            self.process.kill()
        self.ended()
        for stream in (self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()


def on_a_terminal(rig: Rig, height: int, width: int, *arguments: str, until: bytes) -> tuple[int, str]:
    """Run a command on its own terminal, press Ctrl-C when it has shown `until`, and wait for its end.

    Returns:
        The exit code, and everything that was shown.
    """
    import fcntl
    import pty
    import select
    import struct
    import termios

    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", height, width, 0, 0))
    process = Program(
        pancakes(*arguments),
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env={key: value for key, value in rig.environment.items() if key not in ("LINES", "COLUMNS", "NO_COLOR")}
        | {"TERM": "xterm-256color"},
        cwd=rig.directory,
        start_new_session=True,
    )
    os.close(theirs)
    until_s = time.monotonic() + PATIENCE_S
    shown = b""
    interrupted = False
    try:
        while True:
            left_s = until_s - time.monotonic()
            assert left_s > 0 and select.select([ours], [], [], left_s)[0], (
                f"{until!r} was not shown:\n{shown.decode()}"
            )
            try:
                data = os.read(ours, 65_536)
            except OSError:  # the command's side is closed
                break
            if not data:
                break
            shown += data
            if until in shown and not interrupted:
                interrupted = True
                process.send_signal(signal.SIGINT)
        return process.wait(PATIENCE_S), shown.decode()
    finally:
        os.close(ours)
        if process.poll() is None:
            process.kill()
            process.wait(PATIENCE_S)
