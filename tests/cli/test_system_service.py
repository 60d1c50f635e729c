"""An agent under a service manager such as systemd: its notifications, and the folders of its files."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from cli.processes import INSECURE, PATIENCE_S, READY, Rig

STUCK = """
import re
from pancakes.task import Task, every

class Stuck(Task):
    @every(hz=1)
    def look(self, tick):
        re.fullmatch("(a|a)*b", "a" * 60)  # holds Python's lock, for years
"""


class Manager:
    """The socket on which a service manager listens."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))

    def hear(self, wanted: str, within_s: float = PATIENCE_S) -> list[str]:
        """Wait for a notification; return all notifications until then."""
        told: list[str] = []
        self._socket.settimeout(within_s)
        while wanted not in told:
            told += self._socket.recv(4096).decode().splitlines()
        return told

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


@pytest.fixture
def manager(rig: Rig) -> Iterator[Manager]:
    made = Manager(rig.directory / "notify")
    rig.environment |= {"NOTIFY_SOCKET": str(made.path), "WATCHDOG_USEC": "400000"}
    yield made
    made.close()


def test_agent_notifies_its_service_manager(rig: Rig, manager: Manager):
    source = """
import os
from pancakes.task import Task

class Look(Task):
    def on_start(self):
        self.log("info", f"told {sorted(set(os.environ) & {'NOTIFY_SOCKET', 'WATCHDOG_USEC'})}")
"""
    rig.install("look", "[pancakes.tasks]\nlook.Look = plugin_look:Look\n", source)
    running = rig.agent(rig.config("a", f'{INSECURE}[task.Look]\ntype = "look.Look"\n'))
    assert "STATUS=a is ready" in manager.hear("READY=1")
    running.hear("told []")  # what it starts does not speak in its name
    for _ in range(3):
        manager.hear("WATCHDOG=1")
    running.process.terminate()
    assert "STATUS=a ends" in manager.hear("STOPPING=1")
    assert running.ended() == 0


def test_hanging_agent_stops_its_watchdog_messages(rig: Rig, manager: Manager):
    rig.install("stuck", "[pancakes.tasks]\nstuck.Stuck = plugin_stuck:Stuck\n", STUCK)
    running = rig.agent(rig.config("a", f'{INSECURE}[task.Stuck]\ntype = "stuck.Stuck"\n'))
    manager.hear("READY=1")
    with pytest.raises(TimeoutError):
        while True:
            manager.hear("WATCHDOG=1", within_s=2.0)
    assert running.process.poll() is None


def test_agent_survives_its_service_manager(rig: Rig, manager: Manager):
    running = rig.agent(rig.config("a", INSECURE))
    manager.hear("READY=1")
    manager.close()
    manager.path.unlink()
    running.process.send_signal(signal.SIGTERM)
    assert running.ended() == 0


def test_agent_uses_the_state_directory_of_its_manager(rig: Rig):
    own = rig.directory / "own"
    rig.environment["STATE_DIRECTORY"] = str(own)
    rig.agent(rig.config("a", INSECURE)).hear(READY)
    assert list(own.iterdir()) and not (rig.directory / "state").exists()


def test_agent_marks_log_levels_for_the_journal(rig: Rig, tmp_path: Path):
    path = tmp_path / "journal"
    path.touch()
    status = os.stat(path)
    rig.environment["JOURNAL_STREAM"] = f"{status.st_dev}:{status.st_ino}"
    source = """
import sys, os
os.dup2(os.open(sys.argv[1], os.O_WRONLY | os.O_APPEND), 2)
os.execv(sys.executable, [sys.executable, "-m", "pancakes.tools.cli.agent_command", *sys.argv[2:]])
"""
    config = rig.config("a", INSECURE)
    manager = Manager(tmp_path / "notify")
    rig.environment["NOTIFY_SOCKET"] = str(manager.path)
    running = rig.run("-c", source, str(path), "--config", str(config))
    manager.hear("READY=1")
    running.process.terminate()
    assert running.ended() == 0
    manager.close()
    lines = path.read_text().splitlines()
    assert [line[:3] for line in lines if "without keys" in line] == ["<4>"]
    assert all(line.startswith("<") for line in lines) and any(line.startswith("<6>") for line in lines)
