"""How late time-driven tasks are ticked, against their absolute deadlines.

The baseline is one bare thread with a heap, which sleeps until the next deadline and calls a function. Beside a task
that computes without pause there is none: no thread of the same interpreter would do better for being bare.
"""

from __future__ import annotations

import heapq
import json
import os
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

from benchmarks.agent_process import INSECURE, agent_process, offer_tasks, read_report
from benchmarks.figure import Figure, Plan, alone, in_turns

from pancakes.task import Task, Tick, every

TITLE = "lateness of periodic tasks"
CASES = ((1, 1000.0), (100, 100.0), (1000, 10.0))
"""Tasks, and their rate in Hz."""
BUSY_CASE = (100, 100.0)
"""Of the same, while one more task computes without pause."""
BUSY_P99_MS = 3.0
COMPUTED_AT_ONCE = 2_000_000
"""So many steps of its loop, a tenth of a second or more, a computing task makes before it looks for messages."""
DURATION_S = 2.0
SETTLE_S = 2.0


class Periodic(Task):
    """Notes how late it was ticked, where all of its like do."""

    all_late_s: ClassVar[list[float]] = []

    @every(hz=1)
    def tick(self, tick: Tick) -> None:
        """Takes one tick; those that it replaces, because they could not come in time, were later by their periods."""
        late_s = self.now() - tick.time_s
        self.all_late_s.append(late_s)
        if tick.missed:
            period_s = self._actor.timers["tick"].period_s
            self.all_late_s.extend(late_s + (number + 1) * period_s for number in range(tick.missed))


class Busy(Task):
    """Computes in pure Python without pause, in a thread of its own, as its author was told to."""

    blocking = True

    @dataclass
    class State:
        total: int = 0

    def on_start(self) -> None:
        self.call(self.compute)

    def compute(self) -> None:
        """Computes for a while, and goes on at once."""
        total = self.state.total
        for number in range(COMPUTED_AT_ONCE):
            total = (total + number * number) % 65_521
        self.state.total = total
        self.call(self.compute)


class Judge(Task):
    """Tells whoever started the agent how late all were."""

    @dataclass
    class Settings:
        report_fd: int
        settle_s: float
        duration_s: float

    def on_start(self) -> None:
        self.after_host(self.settings.settle_s, self.begin)

    def begin(self) -> None:
        """Counts from now on."""
        Periodic.all_late_s.clear()
        self.after_host(self.settings.duration_s, self.report)

    def report(self) -> None:
        """Tells what there is."""
        os.write(self.settings.report_fd, (json.dumps({"late_s": Periodic.all_late_s}) + "\n").encode())


_CONFIG = """
schema = 1
[agent]
name = "late"
listen = "tcp://127.0.0.1:0"
state_dir = "{directory}/state"
[service.log]
settings = {{ console = false }}
[task.Judge]
type = "bench.Judge"
settings = {{ report_fd = {report_fd}, settle_s = {settle_s}, duration_s = {duration_s} }}
"""


def _percentiles_us(late_s: list[float]) -> list[float]:
    """Returns the median and the 99th percentile, in microseconds."""
    ordered = sorted(late_s)
    return [ordered[len(ordered) // 2] * 1e6, ordered[int(len(ordered) * 0.99)] * 1e6]


def pancakes(tasks: int, rate_hz: float, duration_s: float, more: str = "") -> list[float]:
    """One run of ours, in a process of its own, with more tables in its configuration. Returns the percentiles."""
    reader, writer = os.pipe()
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name:
        environment = offer_tasks(Path(name))
        numbers = {"report_fd": writer, "settle_s": SETTLE_S, "duration_s": duration_s}
        tables = [f'[task.Periodic{n}]\ntype = "bench.Periodic"\nrate_hz = {rate_hz}' for n in range(tasks)]
        config = "\n".join([_CONFIG.format(directory=name, **numbers), *tables, more, INSECURE])
        with agent_process(config, Path(name), environment, pass_fds=(writer,)):
            os.close(writer)
            try:
                late_s = read_report(reader)["late_s"]
            finally:
                os.close(reader)
    return _percentiles_us(all_there(late_s, tasks, rate_hz, duration_s))


def beside_a_busy_task(tasks: int, rate_hz: float, duration_s: float) -> list[float]:
    """One run of ours beside a task that computes. Returns the percentiles in ms."""
    return [late_us / 1e3 for late_us in pancakes(tasks, rate_hz, duration_s, '[task.Busy]\ntype = "bench.Busy"\n')]


def all_there(late_s: list[float], tasks: int, rate_hz: float, duration_s: float) -> list[float]:
    """Sees to it that nothing looks punctual because it never came: such a tick is as late as all this takes."""
    expected = round(tasks * (rate_hz * duration_s - 1))
    return [*late_s, *[duration_s] * (expected - len(late_s))]


def bare_thread(tasks: int, rate_hz: float, duration_s: float) -> list[float]:
    """One run of the baseline. Returns the same."""
    late_s: list[float] = []

    def run() -> None:
        # The kernel may make sleeps longer by 50 µs, unless it is told not to (Linux).
        slack = Path(f"/proc/{threading.get_native_id()}/timerslack_ns")
        if slack.exists():
            slack.write_text("1")
        now = time.monotonic
        start_s = now() + 0.01
        heap = [(start_s, number, 0) for number in range(tasks)]
        while heap[0][0] < start_s + SETTLE_S + duration_s:
            due_s, number, count = heap[0]
            wait_s = due_s - now()
            if wait_s > 0:
                time.sleep(wait_s)
            if due_s > start_s + SETTLE_S:
                late_s.append(now() - due_s)
            heapq.heapreplace(heap, (start_s + (count + 1) / rate_hz, number, count + 1))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join()
    return _percentiles_us(late_s)


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    duration_s = max(1.0, DURATION_S * plan.scale)
    for tasks, rate_hz in CASES:
        name = f"{tasks} at {rate_hz:g} Hz"
        yield from in_turns(
            plan,
            [Figure(f"{name}: lateness p50", "µs"), Figure(f"{name}: lateness p99", "µs", wanted=2.0)],
            partial(pancakes, tasks, rate_hz, duration_s),
            partial(bare_thread, tasks, rate_hz, duration_s),
        )
    tasks, rate_hz = BUSY_CASE
    name = f"{tasks} at {rate_hz:g} Hz beside a busy task"
    yield from alone(
        plan,
        [Figure(f"{name}: p50", "ms"), Figure(f"{name}: p99", "ms", wanted=BUSY_P99_MS, absolute=True)],
        lambda: beside_a_busy_task(tasks, rate_hz, duration_s),
    )
