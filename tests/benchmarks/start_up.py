"""What an idle agent costs: the time from its command to the first tick of a task, and its resident memory.

The baseline is a Python process that imports pykka and msgpack.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from subprocess import Popen

import psutil
from benchmarks.agent_process import agent_process, offer_tasks, process, read_report, usual_environment
from benchmarks.figure import Figure, Plan, in_turns

TITLE = "an idle agent: pancakes-agent with its four services and one task"
SETTLE_S = 1.0
"""How long it is left alone before its memory is looked at."""

_BARE = "import os, sys, pykka, msgpack; os.write(int(sys.argv[1]), b'{}\\n'); sys.stdin.read()"
_CONFIG = """
schema = 1
[agent]
name = "idle"
listen = "tcp://127.0.0.1:0"
state_dir = "{directory}/state"
[service.log]
settings = {{ console = false }}
[task.Started]
type = "bench.Started"
settings = {{ report_fd = {report_fd} }}
"""


def _measure(started: Popen[bytes], began_s: float, reader: int, writer: int) -> list[float]:
    try:
        os.close(writer)
        read_report(reader)
        start_ms = (time.perf_counter() - began_s) * 1e3
        time.sleep(SETTLE_S)
        return [start_ms, psutil.Process(started.pid).memory_info().rss / 2**20]
    finally:
        os.close(reader)


def pancakes() -> list[float]:
    """One run of ours. Returns ms to the first tick, and MiB."""
    reader, writer = os.pipe()
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name:
        environment = offer_tasks(Path(name))
        config = _CONFIG.format(directory=name, report_fd=writer)
        began_s = time.perf_counter()
        with agent_process(config, Path(name), environment, pass_fds=(writer,)) as started:
            return _measure(started, began_s, reader, writer)


def bare_python() -> list[float]:
    """One run of the baseline. Returns the same."""
    reader, writer = os.pipe()
    began_s = time.perf_counter()
    with process([sys.executable, "-c", _BARE, str(writer)], usual_environment(), pass_fds=(writer,)) as started:
        return _measure(started, began_s, reader, writer)


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    figures = [Figure("start to the first tick", "ms", wanted=3.0), Figure("resident memory", "MiB", wanted=1.8)]
    pancakes()  # the first one compiles what has changed
    bare_python()
    yield from in_turns(plan, figures, pancakes, bare_python)
