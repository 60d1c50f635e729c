"""Fixtures for the smoke tests of the programs in `trials/`."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from benchmarks.agent_process import PYTHON_PATH

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(PYTHON_PATH)}


@pytest.fixture
def program() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run a program of `trials/` as its script does, and return how it ended."""

    def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
        arguments = [sys.executable, "-m", *map(str, command)]
        return subprocess.run(arguments, env=ENVIRONMENT, capture_output=True, text=True, check=False)

    return run


@pytest.fixture
def begun() -> Iterator[Callable[[str], subprocess.Popen[str]]]:
    """Start Python code that may import the programs; processes that still run at the end are killed."""
    started: list[subprocess.Popen[str]] = []

    def start(code: str, *arguments: str | Path) -> subprocess.Popen[str]:
        options: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        started.append(subprocess.Popen([sys.executable, "-c", code, *map(str, arguments)], env=ENVIRONMENT, **options))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()
