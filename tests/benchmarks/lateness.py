"""How late time-driven tasks are ticked, against their absolute deadlines.

The baseline is one bare thread with a heap, which sleeps until the next deadline and calls a function.
"""

from __future__ import annotations

import heapq
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.figure import Figure, Plan, in_turns
from benchmarks.local_agent import local_agent

from pancakes.task import Task, Tick, every

TITLE = "lateness of periodic tasks"
CASES = ((1, 1000.0), (100, 100.0), (1000, 10.0))
"""Tasks, and their rate in Hz."""
DURATION_S = 2.0
SETTLE_S = 2.0


class Periodic(Task):
    """Notes how late it was ticked."""

    def on_start(self) -> None:
        self.late_s: list[float] = []

    @every(hz=1)
    def tick(self, tick: Tick) -> None:
        """Takes one tick."""
        self.late_s.append(self.now() - tick.time_s)


def _percentiles_us(late_s: list[float]) -> list[float]:
    """Returns the median and the 99th percentile, in microseconds."""
    ordered = sorted(late_s)
    return [ordered[len(ordered) // 2] * 1e6, ordered[int(len(ordered) * 0.99)] * 1e6]


def pancakes(tasks: int, rate_hz: float, duration_s: float) -> list[float]:
    """One run of ours. Returns the percentiles."""
    tables = {f"Periodic{number}": f'type = "bench.Periodic"\nrate_hz = {rate_hz}' for number in range(tasks)}
    with local_agent({"bench.Periodic": Periodic}, tables) as agent:
        found: list[Any] = [agent.kernel.registry.get(f"bench/client/Periodic{number}") for number in range(tasks)]
        time.sleep(SETTLE_S)
        before = [len(task.late_s) for task in found]
        time.sleep(duration_s)
        late_s = [late for task, start in zip(found, before, strict=True) for late in task.late_s[start:]]
    if len(late_s) < tasks * (0.9 * rate_hz * duration_s - 1):
        raise RuntimeError(f"only {len(late_s)} of {tasks * rate_hz * duration_s:.0f} ticks came")
    return _percentiles_us(late_s)


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
            lambda tasks=tasks, rate_hz=rate_hz: pancakes(tasks, rate_hz, duration_s),  # type: ignore[misc]
            lambda tasks=tasks, rate_hz=rate_hz: bare_thread(tasks, rate_hz, duration_s),  # type: ignore[misc]
        )
