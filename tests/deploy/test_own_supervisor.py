"""The supervisor of Pancakes, with small programs in place of the agent."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

PATIENCE_S = 20.0
RUN = """
import sys
from pathlib import Path
from pancakes.tools.remote_host.agent_supervisor import Supervisor
Supervisor(Path(sys.argv[1]), watchdog_s=float(sys.argv[2]), pause_s=0.05).run()
"""
SAY = """
import os, socket, sys, time
manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
manager.connect(os.environ["NOTIFY_SOCKET"])
manager.send(b"READY=1")
print("I live", flush=True)
"""
LIVES = SAY + "while True:\n    manager.send(b'WATCHDOG=1')\n    time.sleep(0.05)\n"


class Supervised:
    """A supervisor in a folder, and its program."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.process: subprocess.Popen[bytes] | None = None

    def start(self, program: str, watchdog_s: float = PATIENCE_S) -> None:
        self.start_command([sys.executable, "-c", program], watchdog_s)

    def start_command(self, command: list[str], watchdog_s: float = PATIENCE_S) -> None:
        (self.folder / "command.json").write_text(json.dumps(command))
        supervisor = [sys.executable, "-c", RUN, str(self.folder), str(watchdog_s)]
        self.process = subprocess.Popen(supervisor, stdin=subprocess.DEVNULL)

    def wait(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        until_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                status = json.loads((self.folder / "status.json").read_text())
            except FileNotFoundError:
                status = {"state": "", "pid": 0, "restarts": 0}
            if condition(status):
                found: dict[str, Any] = status
                return found
            assert time.monotonic() < until_s, (status, self.log())
            time.sleep(0.02)

    def log(self) -> str:
        try:
            return (self.folder / "agent.log").read_text()
        except FileNotFoundError:
            return ""


@pytest.fixture
def supervised(tmp_path: Path) -> Iterator[Supervised]:
    made = Supervised(tmp_path)
    yield made
    if made.process is not None and made.process.poll() is None:
        made.process.kill()
        made.process.wait()


def test_hanging_agent_is_killed_and_restarted(supervised: Supervised):
    supervised.start(SAY + "time.sleep(600)", watchdog_s=0.3)
    first = supervised.wait(lambda it: it["state"] == "active")["pid"]
    assert supervised.wait(lambda it: it["restarts"] >= 1 and it["pid"] not in (0, first))["restarts"] == 1
    assert "the supervisor kills the agent: it hangs" in supervised.log()


def test_pauses_between_restarts_grow(supervised: Supervised):
    supervised.start("import sys; sys.exit(3)")
    supervised.wait(lambda it: it["restarts"] >= 4)
    pauses = [line.split()[6] for line in supervised.log().splitlines() if "restarts the agent" in line]
    assert pauses[:4] == ["0.05", "0.1", "0.2", "0.4"]


@pytest.mark.parametrize(("code", "state"), [(0, "inactive"), (4, "failed")])
def test_graceful_end_or_bad_configuration_is_final(supervised: Supervised, code: int, state: str):
    supervised.start(f"import sys; sys.exit({code})")
    assert supervised.process is not None and supervised.process.wait(PATIENCE_S) == 0
    assert supervised.wait(lambda it: True) == {"state": state, "pid": 0, "restarts": 0}


def test_supervisor_stops_its_agent_and_keeps_its_output(supervised: Supervised):
    end = "import os, signal\nsignal.signal(signal.SIGTERM, lambda *it: (print('farewell', flush=True), os._exit(0)))\n"
    supervised.start(end + LIVES)
    # It reports that it is ready before its first sign of life.
    pid = supervised.wait(lambda it: it["state"] == "active" and supervised.log() != "")["pid"]
    assert supervised.process is not None
    supervised.process.send_signal(signal.SIGTERM)
    assert supervised.process.wait(PATIENCE_S) == 0
    assert not psutil.pid_exists(pid)
    assert supervised.log().splitlines() == ["I live", "farewell"]


def test_missing_program_is_tried_again(supervised: Supervised):
    supervised.start_command(["/no/such/program"])
    supervised.wait(lambda it: it["restarts"] >= 2)
    assert supervised.process is not None
    assert "the agent cannot be started: " in supervised.log()
    os.kill(supervised.process.pid, signal.SIGTERM)
    assert supervised.process.wait(PATIENCE_S) == 0
