"""Supervise one deployed agent on a host without systemd: start it, and restart it if it fails or hangs.

    python supervisor.py FOLDER

This module is sent to the host as a single file and runs as a script: it needs only Python, and works with any version
of Pancakes. `command.json` in the folder is the command to run. The supervisor keeps the file `lock` locked, reports
the state of the agent in `status.json`, and writes the agent's output to `agent.log`. SIGTERM ends both.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import selectors
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final

WATCHDOG_S: Final = 10.0
"""An agent that sends no sign of life for this long hangs, in seconds."""
READY_S: Final = 90.0
"""An agent that is not ready after this time is killed and restarted, in seconds."""
END_S: Final = 10.0
"""How long an agent may take to stop before it is killed, in seconds."""
PAUSE_S: Final = 1.0
"""The pause before the first restart, in seconds; it doubles with each further failure up to `LONGEST_S`."""
LONGEST_S: Final = 60.0
"""The longest pause before a restart; an agent that ran this long starts again with the shortest."""
BAD_CONFIGURATION: Final = 4
"""The exit code for a bad configuration: a restart would end in the same way."""
LOCK_S: Final = 2.0
"""How long to wait for the lock, in seconds: a program that checks for a supervisor holds it for a moment."""
LOG_BYTES: Final = 4 << 20
"""A longer log becomes `agent.log.1`."""


class AgentLog:
    """The output of the agent, in a file of limited size."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def write(self, data: bytes) -> None:
        """Append to the file. Errors are ignored: a full disk must not stop the agent."""
        with contextlib.suppress(OSError):
            if self._path.exists() and self._path.stat().st_size > LOG_BYTES:
                os.replace(self._path, self._path.with_name("agent.log.1"))
            with open(self._path, "ab") as file:
                file.write(data)


class Supervisor:
    """Keep one agent running, in one thread.

    Args:
        folder: the folder with `command.json`.
        watchdog_s: see `WATCHDOG_S`.
        pause_s: see `PAUSE_S`.
    """

    def __init__(self, folder: Path, watchdog_s: float = WATCHDOG_S, pause_s: float = PAUSE_S) -> None:
        self._folder = folder
        self._command = json.loads((folder / "command.json").read_text())
        self._watchdog_s, self._pause_s = watchdog_s, pause_s
        self._log = AgentLog(folder / "agent.log")
        self._process: subprocess.Popen[bytes] | None = None
        self._status: dict[str, Any] = {"state": "starting", "pid": 0, "restarts": 0}
        self._ends = False
        self._failures = 0
        self._began_s = self._heard_s = self._due_s = 0.0
        self._selector = selectors.DefaultSelector()

    def run(self) -> None:
        """Run until SIGTERM, or until the agent ends for good."""
        place = tempfile.mkdtemp(prefix="pancakes-notify-")
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notices:
            try:
                self._prepare(Path(place) / "notify", notices)
                while not self._ends:
                    self._turn(notices)
                self._end()
            finally:
                shutil.rmtree(place, ignore_errors=True)

    def _prepare(self, path: Path, notices: socket.socket) -> None:
        notices.bind(str(path))
        notices.setblocking(False)
        reader, writer = os.pipe()
        for end in (reader, writer):
            os.set_blocking(end, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        signal.signal(signal.SIGTERM, self._on_stop_signal)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        signal.signal(signal.SIGCHLD, lambda number, frame: None)
        self._selector.register(notices, selectors.EVENT_READ)
        self._selector.register(reader, selectors.EVENT_READ)
        self._woken = reader
        self._environment = {**os.environ, "NOTIFY_SOCKET": str(path)}
        self._environment["WATCHDOG_USEC"] = str(int(self._watchdog_s * 1e6))
        self._spawn()

    def _on_stop_signal(self, number: int, frame: Any) -> None:
        self._ends = True

    def _turn(self, notices: socket.socket) -> None:
        for key, _ in self._selector.select(self._wait_s()):
            if key.fileobj is notices:
                self._hear(notices)
            elif key.fd == self._woken:
                os.read(self._woken, 4096)
            else:
                self._read(key.fd)
        now_s = time.monotonic()
        if self._process is None:
            if self._due_s and now_s >= self._due_s:
                self._spawn()
        elif self._process.poll() is not None:
            self._ended(self._process.returncode)
        elif now_s - self._heard_s > self._patience_s():
            self._log.write(b"the supervisor kills the agent: it hangs\n")
            self._process.kill()
            self._heard_s = now_s

    def _wait_s(self) -> float | None:
        if self._process is None:
            return max(0.0, self._due_s - time.monotonic()) if self._due_s else None
        return max(0.05, self._heard_s + self._patience_s() - time.monotonic())

    def _patience_s(self) -> float:
        return self._watchdog_s if self._status["state"] == "active" else READY_S

    def _spawn(self) -> None:
        self._began_s = self._heard_s = time.monotonic()
        self._due_s = 0.0
        reader, writer = os.pipe()
        try:
            self._process = subprocess.Popen(
                [*self._command, f"--die-with-parent={os.getpid()}"],
                stdin=subprocess.DEVNULL,
                stdout=writer,
                stderr=writer,
                env=self._environment,
                start_new_session=True,
            )
        except OSError as error:
            os.close(reader)
            self._log.write(f"the agent cannot be started: {error}\n".encode())
            self._ended(1)
            return
        finally:
            os.close(writer)
        self._selector.register(reader, selectors.EVENT_READ)
        self._tell(state="starting", pid=self._process.pid)

    def _read(self, handle: int) -> None:
        data = os.read(handle, 65_536)
        if data:
            self._log.write(data)
        else:
            self._selector.unregister(handle)
            os.close(handle)

    def _hear(self, notices: socket.socket) -> None:
        with contextlib.suppress(BlockingIOError):
            while lines := notices.recv(4096).decode("utf-8", "replace").splitlines():
                self._heard_s = time.monotonic()
                if "READY=1" in lines and self._process is not None:
                    self._tell(state="active")

    def _ended(self, code: int) -> None:
        """Plan the restart of an agent that has ended by itself, or was killed because it hung."""
        self._process = None
        if code in (0, BAD_CONFIGURATION):
            self._ends = True
            self._tell(state="failed" if code else "inactive", pid=0)
        else:
            self._failures = 1 if time.monotonic() - self._began_s >= LONGEST_S else self._failures + 1
            pause_s = min(LONGEST_S, self._pause_s * 2 ** (self._failures - 1))
            self._due_s = time.monotonic() + pause_s
            self._log.write(f"the supervisor restarts the agent in {pause_s:g} s: it ended with {code}\n".encode())
            self._tell(state="starting", pid=0, restarts=self._status["restarts"] + 1)

    def _end(self) -> None:
        """Stop the agent, and read its last output."""
        if self._process is None:
            return
        self._process.terminate()
        until_s = time.monotonic() + END_S
        while self._process.poll() is None:
            if time.monotonic() > until_s:
                self._process.kill()
            for key, _ in self._selector.select(0.1):
                if key.fd == self._woken:
                    os.read(self._woken, 4096)
                elif isinstance(key.fileobj, int):
                    self._read(key.fd)
        for key, _ in self._selector.select(0.0):
            if isinstance(key.fileobj, int) and key.fd != self._woken:
                self._read(key.fd)
        self._tell(state="inactive", pid=0)

    def _tell(self, **changes: Any) -> None:
        self._status.update(changes)
        with contextlib.suppress(OSError):
            made = self._folder / ".status.json.new"
            made.write_text(json.dumps(self._status))
            os.replace(made, self._folder / "status.json")


def main() -> None:
    """Start the supervisor, unless this agent already has one."""
    folder = Path(sys.argv[1])
    lock = open(folder / "lock", "a+")  # noqa: SIM115 - it is open as long as this process
    until_s = time.monotonic() + LOCK_S
    while True:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            break
        except BlockingIOError:
            if time.monotonic() > until_s:
                sys.exit("this agent already has a supervisor")
            time.sleep(0.05)
    lock.truncate(0)
    lock.write(str(os.getpid()))
    lock.flush()
    Supervisor(folder).run()


if __name__ == "__main__":
    main()
