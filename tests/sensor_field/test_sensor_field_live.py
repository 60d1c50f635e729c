"""The sensor field on real processes, a pseudo-terminal and UDP: short, and gone without a trace however it ends."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import psutil
import pytest
from pancakes_sensor_field.demos import AGENTS

PATIENCE_S = 60.0
LIMIT_S = 3.0
TINY = "pancakes_sensor_field.tiny_node"
EARLY = (
    "field:task.Field.settings.fires.shed.starts_s=12",
    "field:task.Field.settings.walkers.first.way=[[8, 3.0, 4.0], [30, 9.0, 4.5]]",
    "field:task.Field.settings.nodes.gateway.battery.capacity_j=10",
)
"""The shed burns soon, and the gateway's battery falls below 50 % after some 25 s."""


class LiveField:
    """`pancakes demo sensor-field --headless` in a process of its own; used in a `with` statement."""

    def __init__(self, out: Path, *arguments: str) -> None:
        self.lines: list[str] = []
        command = [sys.executable, "-m", "pancakes.cli.main", "demo", "sensor-field", "--headless", "--out", str(out)]
        self.process = subprocess.Popen(
            [*command, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
        self.found: dict[int, psutil.Process] = {}
        self._news = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._news:
                self.lines.append(line.rstrip("\n"))
                self._news.notify_all()

    def wait_for(self, text: str) -> None:
        """Waits until it has printed a line with `text`, and finds its agents and tiny nodes."""
        with self._news:
            seen = self._news.wait_for(lambda: any(text in line for line in self.lines), PATIENCE_S)
        assert seen, f"it never said {text!r}, only:\n{self.said}"
        words = []
        for child in psutil.Process(self.process.pid).children(recursive=True):
            with contextlib.suppress(psutil.Error):
                words.append(" ".join(child.cmdline()))
                self.found[child.pid] = child
        assert sum(TINY in line for line in words) == 2, words
        assert sum("pancakes.cli.agent" in line for line in words) == len(AGENTS), words

    def ends(self) -> int:
        code = self.process.wait(PATIENCE_S)
        self._reader.join(PATIENCE_S)
        return code

    def left_after(self, within_s: float) -> list[int]:
        """Returns which of the processes still run after some seconds."""
        deadline_s = time.monotonic() + within_s
        left = [process for process in self.found.values() if _runs(process)]
        while left and time.monotonic() < deadline_s:
            psutil.wait_procs(left, 0.05)
            left = [process for process in left if _runs(process)]
        return [process.pid for process in left]

    @property
    def said(self) -> str:
        with self._news:
            return "\n".join(self.lines)

    def __enter__(self) -> LiveField:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leaves nothing behind, also where a test failed."""
        if self.process.poll() is None:
            for child in psutil.Process(self.process.pid).children(recursive=True):
                with contextlib.suppress(psutil.Error):
                    child.kill()
            self.process.kill()
        for process in self.found.values():
            if _runs(process):
                process.kill()
        self.process.wait()
        self._reader.join(PATIENCE_S)
        assert self.process.stdout is not None
        self.process.stdout.close()


def _runs(process: psutil.Process) -> bool:
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@pytest.fixture
def under_way(tmp_path: Path) -> Iterator[LiveField]:
    """A mission in which the tiny nodes have been heard."""
    with LiveField(tmp_path / "out", "--set", EARLY[0], "--set", EARLY[1]) as demo:
        demo.wait_for("alarm raised")
        yield demo


def test_a_live_mission_hears_its_tiny_nodes_raises_the_alarm_and_moves_it(tmp_path: Path) -> None:
    out = tmp_path / "out"
    sets = [word for change in EARLY for word in ("--set", change)]
    with LiveField(out, "--duration", "60", *sets) as demo:
        demo.wait_for("alarm raised")
        demo.ends()
        assert demo.left_after(0.0) == []
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert not any("broke off" in reason for reason in summary["reasons"]), demo.said
    (first, *_) = summary["alarms"]
    assert (first["number"], first["fire"], first["agent"]) == (1, "shed", "gateway") and first["hot"] == ["shed"]
    gateway, heir = summary["holders"]
    assert gateway["agent"] == "gateway" and heir["agent"] in ("north", "east", "west"), demo.said
    assert summary["overlap_s"] <= 0.05 and summary["state_moved"]["alarms"] == 1
    assert all(received == highest for received, highest in summary["reports"].values()), summary["reports"]
    assert {"shed", "gate"} <= summary["reports"].keys(), "over the pseudo-terminal, and over UDP"
    assert not (out / "state" / "shed.tty").is_symlink()
    for agent in AGENTS:
        assert (out / "logs" / f"{agent}.txt").read_text(encoding="utf-8") == "", "an agent wrote to its terminal"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name)
def test_a_signal_ends_the_tiny_nodes_too(number: signal.Signals, under_way: LiveField) -> None:
    under_way.process.send_signal(number)
    assert under_way.ends() == 130
    assert under_way.left_after(0.0) == []


def test_a_launcher_that_is_killed_leaves_neither_agents_nor_tiny_nodes(under_way: LiveField) -> None:
    under_way.process.kill()
    assert under_way.left_after(LIMIT_S) == []


def test_a_field_that_is_killed_takes_its_tiny_nodes_along(under_way: LiveField) -> None:
    tiny = [process for process in under_way.found.values() if TINY in " ".join(process.cmdline())]
    (field,) = [process for process in under_way.found.values() if "field.toml" in " ".join(process.cmdline())]
    field.kill()
    _, left = psutil.wait_procs(tiny, LIMIT_S)
    assert not left
    assert under_way.ends() == 1 and "the mission broke off: the agent field " in under_way.said
