"""How the cost grows with the tasks of one agent, from 10 to 10,000: starting them, keeping them, and ticking them.

There is no baseline, and nothing is wanted: it is to grow in proportion. The tasks are those of `many_tasks`.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from benchmarks.figure import Figure, Plan, alone
from benchmarks.many_tasks import crowded
from benchmarks.start_up import percent_of_a_core

TITLE = "how the cost grows with the tasks of an agent"
BESIDE = ""
TASKS = (10, 100, 1_000, 10_000)
SPAN_S = 5.0


def grown(tasks: int, span_s: float) -> list[float]:
    """One run. Returns ms and µs a task to start, KiB a task, per cent of a core at rest, µs a tick at 1 Hz."""
    with crowded(tasks, 0.0) as (process, (start_ms, memory_mib)):
        rest_percent = percent_of_a_core(process, span_s)
    with crowded(tasks, 1.0) as (process, _):
        ticking_percent = percent_of_a_core(process, span_s)
    tick_us = (ticking_percent - rest_percent) / 100.0 / tasks * 1e6
    return [start_ms, start_ms / tasks * 1e3, memory_mib * 1024 / tasks, rest_percent, tick_us]


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    span_s = max(2.0, SPAN_S * plan.scale)
    for tasks in TASKS:
        figures = [
            Figure(f"{tasks:,} tasks: start", "ms"),
            Figure(f"{tasks:,} tasks: start, each", "µs"),
            Figure(f"{tasks:,} tasks: memory, each", "KiB"),
            Figure(f"{tasks:,} tasks at rest: processor, of a core", "%"),
            Figure(f"{tasks:,} tasks at 1 Hz: processor time a tick", "µs"),
        ]
        yield from alone(plan, figures, partial(grown, tasks, span_s))
