"""Fixtures for the tests of the command line."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cli.live_output import LiveOutput
from cli.processes import Rig, Running


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    try:
        yield rig
    finally:
        rig.close()


@pytest.fixture
def start(rig: Rig) -> Iterator[Callable[..., LiveOutput]]:
    """Start commands that keep running."""
    running = []

    def start(*arguments: str) -> LiveOutput:
        running.append(LiveOutput(rig, *arguments))
        return running[-1]

    yield start
    for it in running:
        it.close()


@pytest.fixture
def freeze() -> Iterator[Callable[[Running], None]]:
    """Suspend a process (SIGSTOP), and return when it is suspended."""
    frozen = []

    def freeze(running: Running) -> None:
        os.kill(running.pid, signal.SIGSTOP)
        os.waitpid(running.pid, os.WUNTRACED)
        frozen.append(running)

    yield freeze
    for running in frozen:
        running.process.send_signal(signal.SIGCONT)  # does nothing if it has ended
