"""Keep a deployed agent running on a host: with systemd as a service of the user, or with Pancakes' own supervisor.

Both start an agent and wait until it is ready, restart it if it fails or hangs, and keep it running when the user logs
out. The same tests check both.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Protocol

from pancakes.tools.remote_host import agent_supervisor
from pancakes.tools.remote_host.host_folders import (
    HostError,
    agent_folder,
    current_python,
    home,
    is_locked,
    write_whole,
)

START_S: Final = 90.0
"""An agent that is not ready after this time has failed to start, in seconds."""
STOP_S: Final = 20.0
"""A supervisor that has not ended after this time is killed, and its agent with it, in seconds."""
LOOK_S: Final = 0.05
TAIL: Final = 12
"""How many of the last lines of an agent are shown if it does not start."""
NO_OUTPUT: Final = "there is no output"


class ServiceManager(Protocol):
    """Keep one agent running.

    Attributes:
        kind: the manager, in a word for people.
    """

    kind: str

    def install(self) -> None:
        """Register the current version as a service, which starts with the computer if the manager supports it."""

    def start(self) -> None:
        """Start the agent, and wait until it is ready.

        Raises:
            HostError: the agent ends, or is not ready in time; the fault has its last lines of output.
        """

    def stop(self) -> None:
        """Stop the agent, and wait until it has ended; it is not restarted."""

    def status(self) -> dict[str, Any]:
        """Return `state` (`active`, `starting`, `failed`, `inactive`), `pid` (0: none) and `restarts`."""

    def forget(self) -> None:
        """Undo `install`; the agent does not run."""


def agent_command(fleet: str, name: str) -> list[str]:
    """Return the command that runs the current version of an agent."""
    config = agent_folder(fleet, name) / "current" / "agent.toml"
    return [str(current_python(fleet, name)), "-m", "pancakes.tools.cli.agent_command", "--config", str(config)]


def runs_systemd() -> bool:
    """Return whether systemd runs here and manages services of this user."""
    if not os.path.isdir("/run/systemd/system") or shutil.which("systemctl") is None:
        return False
    return _systemctl("show-environment").returncode == 0


def manager_of(fleet: str, name: str) -> ServiceManager:
    """Return the service manager of an agent on this host."""
    return Systemd(fleet, name) if runs_systemd() else OwnSupervisor(fleet, name)


class Systemd:
    """The systemd of the user, with a unit from `pancakes agent unit`."""

    kind = "systemd"

    def __init__(self, fleet: str, name: str) -> None:
        self._fleet, self._name = fleet, name
        self._unit = f"pancakes-{fleet}-{name}.service"
        base = os.environ.get("XDG_CONFIG_HOME")
        self._path = (Path(base) if base else home() / ".config") / "systemd" / "user" / self._unit

    def install(self) -> None:
        """See `ServiceManager`."""
        _linger()
        config = agent_folder(self._fleet, self._name) / "current" / "agent.toml"
        python = str(current_python(self._fleet, self._name))
        command = [python, "-m", "pancakes.tools.cli.main", "agent", "unit", str(config), "--user"]
        made = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)
        if made.returncode:
            raise HostError(f"cannot make a unit for {self._name}: {tail_of(made.stderr)}")
        self._path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(self._path, made.stdout.encode())
        self._order("daemon-reload")
        self._order("enable", "--quiet", self._unit)

    def start(self) -> None:
        """See `ServiceManager`."""
        _systemctl("reset-failed", self._unit)
        began_s = time.time()
        started = _systemctl("start", self._unit)
        if started.returncode:
            output = self._output(began_s)
            _systemctl("stop", self._unit)
            raise HostError(f"does not get {self._name} ready: {output or tail_of(started.stderr)}")

    def stop(self) -> None:
        """See `ServiceManager`."""
        if self._path.exists():
            self._order("stop", self._unit)

    def status(self) -> dict[str, Any]:
        """See `ServiceManager`."""
        shown = _systemctl("show", "--property=ActiveState,SubState,MainPID,NRestarts", self._unit).stdout
        found = dict(line.partition("=")[::2] for line in shown.splitlines())
        states = {"active": "active", "activating": "starting", "reloading": "active", "failed": "failed"}
        return {
            "manager": self.kind,
            "state": states.get(found.get("ActiveState", ""), "inactive"),
            "pid": int(found.get("MainPID") or 0),
            "restarts": int(found.get("NRestarts") or 0),
        }

    def forget(self) -> None:
        """See `ServiceManager`."""
        if not self._path.exists():
            return
        _systemctl("stop", self._unit)
        _systemctl("disable", "--quiet", self._unit)
        self._path.unlink(missing_ok=True)
        _systemctl("daemon-reload")
        _systemctl("reset-failed", self._unit)

    def _order(self, *words: str) -> None:
        done = _systemctl(*words)
        if done.returncode:
            raise HostError(f"refuses `systemctl --user {' '.join(words)}`: {tail_of(done.stderr)}")

    def _output(self, since_s: float) -> str:
        command = ["journalctl", "--user", "-u", self._unit, "-o", "cat", "-n", str(TAIL), f"--since=@{since_s:.0f}"]
        with contextlib.suppress(OSError):
            found = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)
            return tail_of(found.stdout) if found.returncode == 0 and "-- No entries --" not in found.stdout else ""
        return ""


class OwnSupervisor:
    """Pancakes' own supervisor process (`agent_supervisor.py`), for hosts without systemd."""

    kind = "supervisor"

    def __init__(self, fleet: str, name: str) -> None:
        self._fleet, self._name = fleet, name
        self._folder = agent_folder(fleet, name) / "supervisor"

    def install(self) -> None:
        """See `ServiceManager`."""
        self._folder.mkdir(parents=True, exist_ok=True)
        write_whole(self._folder / "command.json", json.dumps(agent_command(self._fleet, self._name)).encode())

    def start(self) -> None:
        """See `ServiceManager`."""
        if self._supervisor() is None:
            self._spawn()
        until_s = time.monotonic() + START_S
        while (status := self.status())["state"] != "active":
            ended = status["state"] in ("failed", "inactive") or status["restarts"] > 0
            if ended or time.monotonic() > until_s:
                output = self._output()
                self.stop()
                raise HostError(f"does not get {self._name} ready: {output}")
            time.sleep(LOOK_S)

    def stop(self) -> None:
        """See `ServiceManager`."""
        pid = self._supervisor()
        if pid is None:
            (self._folder / "status.json").unlink(missing_ok=True)
            return
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGTERM)
        until_s = time.monotonic() + STOP_S
        while self._supervisor() is not None:
            if time.monotonic() > until_s:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            time.sleep(LOOK_S)

    def status(self) -> dict[str, Any]:
        """See `ServiceManager`."""
        found = {"state": "inactive", "pid": 0, "restarts": 0}
        with contextlib.suppress(OSError, ValueError):
            found.update(json.loads((self._folder / "status.json").read_text()))
        if self._supervisor() is None and found["state"] != "failed":
            found["state"], found["pid"] = "inactive", 0
        return {"manager": self.kind, **{key: found[key] for key in ("state", "pid", "restarts")}}

    def forget(self) -> None:
        """See `ServiceManager`."""
        self.stop()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _spawn(self) -> None:
        (self._folder / "status.json").unlink(missing_ok=True)
        write_whole(self._folder / "supervisor.py", _source_of_supervisor())
        with open(self._folder / "agent.log", "ab") as log:
            begun = log.tell()
            process = subprocess.Popen(
                [sys.executable, str(self._folder / "supervisor.py"), str(self._folder)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        while not (self._folder / "status.json").exists():
            if process.poll() is not None:
                with open(self._folder / "agent.log", "rb") as file:
                    file.seek(begun)
                    output = tail_of(file.read().decode("utf-8", "replace"))
                raise HostError(f"cannot start the supervisor: {output}")
            time.sleep(LOOK_S)

    def _supervisor(self) -> int | None:
        """Return the process number of the supervisor; None: it does not run."""
        with contextlib.suppress(OSError, ValueError), open(self._folder / "lock") as file:
            if is_locked(file.fileno()):
                return int(file.read() or 0) or None
        return None

    def _output(self) -> str:
        with contextlib.suppress(OSError):
            return tail_of((self._folder / "agent.log").read_text(errors="replace"))
        return NO_OUTPUT


def _source_of_supervisor() -> bytes:
    """Return the source of our supervisor; modules that were sent to a host have no files."""
    sent: str | None = getattr(agent_supervisor, "__source__", None)
    return sent.encode() if sent is not None else Path(agent_supervisor.__file__).read_bytes()


def tail_of(text: str) -> str:
    """Return the last lines of some output."""
    return "\n    ".join([line.rstrip() for line in text.splitlines() if line.strip()][-TAIL:]) or NO_OUTPUT


def _linger() -> None:
    """Make systemd keep the services of this user running while the user is not logged in.

    Raises:
        HostError: systemd does not, and this user may not change that.
    """

    def lingers() -> bool:
        shown = _run(["loginctl", "show-user", str(os.getuid()), "--property=Linger"])
        return shown.returncode != 0 or shown.stdout.strip() != "Linger=no"  # without logind, services are not ended

    if not lingers():
        _run(["loginctl", "enable-linger"])
        if not lingers():
            name = os.environ.get("USER") or str(os.getuid())
            advice = f"run `sudo loginctl enable-linger {name}` there"
            raise HostError(f"stops the services of {name} when {name} logs out: {advice}")


def _systemctl(*words: str) -> subprocess.CompletedProcess[str]:
    return _run(["systemctl", "--user", "--no-pager", *words])


def _run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    except OSError as error:
        return subprocess.CompletedProcess(command, 127, "", str(error))
