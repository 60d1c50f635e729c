"""What an idle agent costs: the time from its command to the first tick of a task, its memory, its processor time.

The agent has its four services, ten tasks that tick once a second, and one that rests after its first tick. It runs in
an environment as users have it (`environments.python_of_users`), and finds a user's tasks by entry point. The baseline
of its start, its memory and its modules is a Python of the same environment that imports pykka and msgpack.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from subprocess import Popen

import psutil
from benchmarks import idle_tasks
from benchmarks.agent_process import (
    agent_process,
    head_of,
    listening_at,
    offer_tasks,
    process,
    read_report,
    usual_environment,
)
from benchmarks.environments import python_of_users
from benchmarks.figure import Figure, Plan, alone, in_turns

TITLE = "an idle agent: pancakes-agent with its four services and ten tasks at 1 Hz"
SETTLE_S = 1.0
"""How long it is left alone before anybody looks."""
SPAN_S = 10.0
"""How long its processor time is taken for."""

_TASKS = {f"bench.{name}": f"idle_tasks:{name}" for name in ("Started", "Idle")}
"""All that it offers: the packet types of other benchmarks, which each agent would import, are no part of it."""
_BARE = """
import json, os, sys, pykka, msgpack
os.write(int(sys.argv[1]), f'{json.dumps({"modules": len(sys.modules), "ours": 0})}\\n'.encode())
sys.stdin.read()
"""
_STARTED = '[task.Started]\ntype = "bench.Started"\nsettings = {{ report_fd = {report_fd} }}\n'
_IDLE = "".join(f'[task.Idle{number}]\ntype = "bench.Idle"\n' for number in range(10))


def _config(name: str, directory: Path, report_fd: int, peers: Sequence[str] = ()) -> str:
    return head_of(name, directory, peers) + _STARTED.format(report_fd=report_fd) + _IDLE


def _offers(directory: Path) -> dict[str, str]:
    """Puts a user's module and its entry points where an agent finds them; returns the environment of its process."""
    environment = offer_tasks(directory, _TASKS, {})
    shutil.copy(idle_tasks.__file__, directory)
    return {**environment, "PYTHONPATH": str(directory)}


def _measure(started: Popen[bytes], began_s: float, reader: int, writer: int) -> list[float]:
    try:
        os.close(writer)
        report = read_report(reader)
        start_ms = (time.perf_counter() - began_s) * 1e3
        used_ms = time.clock_gettime(clock_of(started)) * 1e3
        time.sleep(SETTLE_S)
        memory_mib = psutil.Process(started.pid).memory_info().rss / 2**20
        return [start_ms, used_ms, memory_mib, report["modules"], report["ours"]]
    finally:
        os.close(reader)


def pancakes(more: Mapping[str, str] | None = None, python: str | Path = sys.executable) -> list[float]:
    """One run of ours, with more in its environment variables.

    Returns:
        ms to the first tick, the same in processor time, MiB, and the modules that were imported: all, and ours.
    """
    reader, writer = os.pipe()
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name:
        directory = Path(name)
        environment = {**_offers(directory), **(more or {})}
        config = _config("idle", directory, writer)
        began_s = time.perf_counter()
        with agent_process(config, directory, environment, pass_fds=(writer,), python=python) as started:
            return _measure(started, began_s, reader, writer)


def bare_python(python: str | Path = sys.executable) -> list[float]:
    """One run of the baseline. Returns the same."""
    reader, writer = os.pipe()
    environment = {name: value for name, value in usual_environment().items() if name != "PYTHONPATH"}
    began_s = time.perf_counter()
    with process([str(python), "-c", _BARE, str(writer)], environment, pass_fds=(writer,)) as started:
        return _measure(started, began_s, reader, writer)


def clock_of(started: Popen[bytes]) -> int:
    """Returns the clock of a process's processor time, in nanoseconds (Linux: clock_getcpuclockid)."""
    return (~started.pid << 3) | 2


def percent_of_a_core(started: Popen[bytes], span_s: float) -> float:
    """Returns how much of a core a process takes, in per cent."""
    clock = clock_of(started)
    time.sleep(SETTLE_S)
    before_s, began_s = time.clock_gettime(clock), time.monotonic()
    time.sleep(span_s)
    return (time.clock_gettime(clock) - before_s) / (time.monotonic() - began_s) * 100.0


@contextmanager
def _ticking(
    name: str, directory: Path, environment: Mapping[str, str], python: Path, peers: Sequence[str] = ()
) -> Iterator[Popen[bytes]]:
    """Runs an agent, once all of it is ready and has ticked for the first time."""
    reader, writer = os.pipe()
    config = _config(name, directory, writer, peers)
    with agent_process(config, directory, environment, pass_fds=(writer,), until_ready=True, python=python) as started:
        os.close(writer)
        try:
            read_report(reader)
        finally:
            os.close(reader)
        yield started


def processor(span_s: float, python: Path) -> list[float]:
    """One run. Returns how much of a core an agent takes alone, and with a neighbour that is like it, in per cent."""
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name:
        directory = Path(name)
        environment = _offers(directory)
        with _ticking("one", directory, environment, python) as one:
            alone_percent = percent_of_a_core(one, span_s)
            with _ticking("two", directory, environment, python, [listening_at(environment, "one", one)]):
                return [alone_percent, percent_of_a_core(one, span_s)]


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    figures = [
        Figure("start to the first tick", "ms", wanted=3.0),
        Figure("CPU of the start", "ms", least=True),
        Figure("resident memory", "MiB", wanted=1.8),
        Figure("modules imported at the first tick", ""),
        ours := Figure("modules of Pancakes itself", ""),
    ]
    python = python_of_users()
    pancakes(None, python)  # the first one compiles what has changed
    bare_python(python)
    found = in_turns(plan, figures, partial(pancakes, None, python), partial(bare_python, python))
    ours.bare_runs = []  # there are none
    yield from found
    span_s = max(2.0, SPAN_S * plan.scale)
    yield from alone(
        plan,
        [
            Figure("processor time, of a core", "%", wanted=0.5, absolute=True),
            Figure("processor time in a mesh of two", "%"),
        ],
        lambda: processor(span_s, python),
    )
