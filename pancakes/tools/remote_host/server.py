"""Serve requests on a host, from standard input; end with that input.

A request is a line of JSON, `{"id": 1, "do": "look", ...}`, and so is its reply, `{"id": 1, "result": ...}` or
`{"id": 1, "fault": "a clause about the host"}`. An event is `{"event": "ended", ...}`; `{"event": "alive"}` is sent
every few seconds. The marker from `main` begins each line, because the user's shell may print too. The agents of a
launch are processes of this program, and end with it.
"""

from __future__ import annotations

import base64
import errno
import json
import os
import select
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pancakes.tools.remote_host.agent_processes import AgentProcesses
from pancakes.tools.remote_host.deployment import HostDeployment
from pancakes.tools.remote_host.host_folders import HostError, end_process, interpreter_for, prepare_environment
from pancakes.tools.remote_host.host_probe import probe_host

END_S = 2.5
"""How long an agent may take to stop before it is killed, in seconds."""
FORGET = """
import sys
from pancakes.config import load
from pancakes.tools.launch.clear_state import empty_state

empty_state(load(sys.argv[1], sys.argv[2:], None))
"""
Emit = Callable[..., None]
"""Sends the launcher an event: its name, and its values by name."""


class LaunchedAgents:
    """Start and end agents, and send the launcher their events.

    Args:
        emit: sends an event.
    """

    def __init__(self, emit: Emit) -> None:
        self._emit = emit
        self.processes = AgentProcesses(self)
        self._folder: str | None = None

    def start(
        self, fleet: str, agent: str, config: str, sets: list[str], keys: Mapping[str, str], fresh: bool
    ) -> dict[str, Any]:
        """Start an agent.

        Args:
            fleet: its fleet.
            agent: its name.
            config: its configuration, as TOML.
            sets: the changes to the configuration, as `--set` takes them.
            keys: the files of its keys for this run, by name, in base64; empty: it has its own, or needs none.
            fresh: whether to clear its state directory first.

        Raises:
            HostError: the agent cannot be started.
        """
        python = interpreter_for(fleet, agent)
        if not python:
            raise HostError("has no Pancakes: install it there with pancakes deploy")
        try:
            path, sets = self._put(agent, config, sets, keys)
            if fresh:
                self._forget(python, path, sets)
            process = self.processes.start(agent, lambda output, progress: _spawn(python, path, sets, output, progress))
        except OSError as error:
            raise HostError(f"cannot start {agent}: {(error.strerror or str(error)).lower()}") from None
        return {"pid": process.pid}

    def end(self, agent: str) -> None:
        """Stop an agent gracefully."""
        self.processes.terminate(agent)

    def kill(self, agent: str) -> None:
        """End an agent by force."""
        self.processes.kill(agent)

    def printed(self, name: str, text: str) -> None:
        """See `AgentListener`."""
        self._emit("line", agent=name, text=text)

    def said(self, name: str, line: str) -> None:
        """See `AgentListener`."""
        self._emit("said", agent=name, text=line)

    def ended(self, name: str, code: int, how: str = "") -> None:
        """See `AgentListener`."""
        self._emit("ended", agent=name, code=code)

    def end_all(self) -> None:
        """Stop all agents, by force after `END_S`, and remove their temporary files."""
        running = self.processes.processes()
        for process in running:
            process.terminate()
        until_s = time.monotonic() + END_S
        for process in running:
            try:
                process.wait(max(0.0, until_s - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _put(self, agent: str, config: str, sets: list[str], keys: Mapping[str, str]) -> tuple[Path, list[str]]:
        """Write the configuration and the keys; return the path of the configuration, and the changes to it."""
        if self._folder is None:
            self._folder = tempfile.mkdtemp(prefix="pancakes-launch-")
        path = Path(self._folder) / f"{agent}.toml"
        path.write_text(config, encoding="utf-8")
        if not keys:
            return path, sets
        folder = Path(self._folder) / "keys" / agent
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name, data in keys.items():
            with open(os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
                file.write(base64.b64decode(data))
        return path, [*sets, f'service.network.settings.keys="{folder}"']

    def _forget(self, python: str, path: Path, sets: list[str]) -> None:
        done = subprocess.run([python, "-c", FORGET, str(path), *sets], capture_output=True, text=True)
        if done.returncode:
            raise HostError(f"cannot clear the state of the agent: {last_line(done.stderr)}")


def _spawn(python: str, path: Path, sets: list[str], output: int, ready_fd: int) -> subprocess.Popen[bytes]:
    command = [python, "-m", "pancakes.tools.cli.agent_command", "--config", str(path)]
    command += [f"--die-with-parent={os.getpid()}", f"--ready-fd={ready_fd}"]
    for change in sets:
        command += ["--set", change]
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=output,
        start_new_session=True,
        pass_fds=(ready_fd,),
    )


def last_line(text: str) -> str:
    """Return the last line that is not blank."""
    return next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "no reason was given")


SILENCE_S = 20.0
"""A launcher that sends nothing for this long is gone, perhaps with its network: its agents are stopped."""
ALIVE_S = 5.0
"""How often a sign of life is sent to the launcher, in seconds, even during a long request."""
MOST_WAITING = 1 << 20
"""The most bytes that wait for the launcher; beyond that the output of the agents is not read, so that they wait."""
_CHUNK = 65_536


class HostServer:
    """Read and execute requests, in one thread, until the standard input ends.

    Args:
        marker: the prefix of each answer.
    """

    def __init__(self, marker: bytes) -> None:
        self._marker = marker
        self._out = bytearray()
        self._lock = threading.Lock()
        self._begun = b""
        self._ends = False
        self._heard_s = time.monotonic()
        self._agents = LaunchedAgents(self._emit)
        deploying = HostDeployment()
        self._calls: dict[str, Callable[..., Any]] = {
            "alive": lambda: None,
            "look": probe_host,
            "end_process": end_process,
            "start": self._agents.start,
            "end": self._agents.end,
            "kill": self._agents.kill,
            **deploying.calls,
        }

    def run(self) -> None:
        """Serve until the launcher is gone, then stop the agents of the launch."""
        reader, writer = os.pipe()
        for end in (reader, writer):
            os.set_blocking(end, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
            signal.signal(number, self._on_stop_signal)
        signal.signal(signal.SIGCHLD, lambda number, frame: None)
        os.set_blocking(1, False)
        threading.Thread(target=self._live, daemon=True).start()
        try:
            while not self._ends:
                self._turn(reader)
        finally:
            self._agents.end_all()

    def _turn(self, woken: int) -> None:
        calls: dict[int, Callable[[], Any]] = {0: self._read, woken: lambda: os.read(woken, _CHUNK)}
        if len(self._out) < MOST_WAITING:
            calls.update(self._agents.processes.pipes())
        readable, writable, _ = select.select(list(calls), [1] if self._out else [], [], 1.0)
        for handle in readable:
            calls[handle]()
        self._agents.processes.look()
        if writable:
            self._write()
        if self._agents.processes and time.monotonic() - self._heard_s > SILENCE_S:
            self._ends = True

    def _write(self) -> None:
        with self._lock:
            try:
                del self._out[: os.write(1, self._out[:_CHUNK])]
            except BlockingIOError:
                pass
            except OSError:
                self._ends = True

    def _live(self) -> None:
        """Send signs of life from a thread of its own: the main thread may be busy with a long request."""
        while True:
            time.sleep(ALIVE_S)
            if not self._out:
                self._emit("alive")
                self._write()

    def _on_stop_signal(self, number: int, frame: Any) -> None:
        self._ends = True

    def _read(self) -> None:
        data = os.read(0, 1 << 20)
        self._heard_s = time.monotonic()
        if not data:
            self._ends = True
        *lines, self._begun = (self._begun + data).split(b"\n")
        for line in lines:
            self._carry_out(json.loads(line))
        self._heard_s = time.monotonic()  # a long request is not silence of the launcher

    def _carry_out(self, request: dict[str, Any]) -> None:
        number, call = request.pop("id"), self._calls[request.pop("do")]
        try:
            self._say({"id": number, "result": call(**request)})
        except HostError as fault:
            self._say({"id": number, "fault": str(fault)})
        except OSError as error:
            self._say({"id": number, "fault": _fault_of(error)})

    def _emit(self, event: str, **values: Any) -> None:
        self._say({"event": event, **values})

    def _say(self, what: dict[str, Any]) -> None:
        with self._lock:
            self._out += b"\n" + self._marker + json.dumps(what).encode() + b"\n"


def _fault_of(error: OSError) -> str:
    where = f" ({os.fsdecode(error.filename)})" if error.filename else ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"has no room left on its disk{where}: make room there"
    return f"refuses: {(error.strerror or str(error)).lower()}{where}"


def main(marker: bytes) -> None:
    """Run the server.

    Args:
        marker: the prefix of each answer.
    """
    prepare_environment()
    HostServer(marker).run()
