"""What an idle agent costs: the time from its command to the first tick of a task, its memory, its processor time.

The baseline of the first two is a Python process that imports pykka and msgpack; the third has none. The agent has its
four services, ten tasks that tick once a second, and one that rests after its first tick.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from subprocess import Popen

import psutil
from benchmarks.agent_process import (
    agent_process,
    head_of,
    listening_at,
    offer_tasks,
    process,
    read_report,
    usual_environment,
)
from benchmarks.figure import Figure, Plan, alone, in_turns

TITLE = "an idle agent: pancakes-agent with its four services and ten tasks at 1 Hz"
SETTLE_S = 1.0
"""How long it is left alone before anybody looks."""
SPAN_S = 10.0
"""How long its processor time is taken for."""

_TASKS = {name: f"benchmarks.idle_tasks:{name.removeprefix('bench.')}" for name in ("bench.Started", "bench.Idle")}
"""All that it offers: the packet types of other benchmarks, which each agent would import, are no part of it."""
_BARE = "import os, sys, pykka, msgpack; os.write(int(sys.argv[1]), b'{}\\n'); sys.stdin.read()"
_STARTED = '[task.Started]\ntype = "bench.Started"\nsettings = {{ report_fd = {report_fd} }}\n'
_IDLE = "".join(f'[task.Idle{number}]\ntype = "bench.Idle"\n' for number in range(10))


def _config(name: str, directory: Path, report_fd: int, peers: Sequence[str] = ()) -> str:
    return head_of(name, directory, peers) + _STARTED.format(report_fd=report_fd) + _IDLE


def _measure(started: Popen[bytes], began_s: float, reader: int, writer: int) -> list[float]:
    try:
        os.close(writer)
        read_report(reader)
        start_ms = (time.perf_counter() - began_s) * 1e3
        time.sleep(SETTLE_S)
        return [start_ms, psutil.Process(started.pid).memory_info().rss / 2**20]
    finally:
        os.close(reader)


def pancakes(more: Mapping[str, str] | None = None) -> list[float]:
    """One run of ours, with more in its environment. Returns ms to the first tick, and MiB."""
    reader, writer = os.pipe()
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name:
        directory = Path(name)
        environment = {**offer_tasks(directory, _TASKS, {}), **(more or {})}
        config = _config("idle", directory, writer)
        began_s = time.perf_counter()
        with agent_process(config, directory, environment, pass_fds=(writer,)) as started:
            return _measure(started, began_s, reader, writer)


def bare_python() -> list[float]:
    """One run of the baseline. Returns the same."""
    reader, writer = os.pipe()
    began_s = time.perf_counter()
    with process([sys.executable, "-c", _BARE, str(writer)], usual_environment(), pass_fds=(writer,)) as started:
        return _measure(started, began_s, reader, writer)


def percent_of_a_core(started: Popen[bytes], span_s: float) -> float:
    """Returns how much of a core a process takes, in per cent."""
    clock = (~started.pid << 3) | 2  # the clock of its processor time, in nanoseconds (Linux: clock_getcpuclockid)
    time.sleep(SETTLE_S)
    before_s, began_s = time.clock_gettime(clock), time.monotonic()
    time.sleep(span_s)
    return (time.clock_gettime(clock) - before_s) / (time.monotonic() - began_s) * 100.0


@contextmanager
def _ticking(
    name: str, directory: Path, environment: Mapping[str, str], peers: Sequence[str] = ()
) -> Iterator[Popen[bytes]]:
    """Runs an agent, once all of it is ready and has ticked for the first time."""
    reader, writer = os.pipe()
    config = _config(name, directory, writer, peers)
    with agent_process(config, directory, environment, pass_fds=(writer,), until_ready=True) as started:
        os.close(writer)
        try:
            read_report(reader)
        finally:
            os.close(reader)
        yield started


def processor(span_s: float) -> list[float]:
    """One run. Returns how much of a core an agent takes alone, and with a neighbour that is like it, in per cent."""
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name:
        directory = Path(name)
        environment = offer_tasks(directory, _TASKS, {})
        with _ticking("one", directory, environment) as one:
            alone_percent = percent_of_a_core(one, span_s)
            with _ticking("two", directory, environment, [listening_at(environment, "one", one)]):
                return [alone_percent, percent_of_a_core(one, span_s)]


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    figures = [Figure("start to the first tick", "ms", wanted=3.0), Figure("resident memory", "MiB", wanted=1.8)]
    pancakes()  # the first one compiles what has changed
    bare_python()
    yield from in_turns(plan, figures, pancakes, bare_python)
    span_s = max(2.0, SPAN_S * plan.scale)
    yield from alone(
        plan,
        [
            Figure("processor time, of a core", "%", wanted=0.5, absolute=True),
            Figure("processor time in a mesh of two", "%"),
        ],
        lambda: processor(span_s),
    )
