"""What an agent costs in a fleet that does nothing but know each other: a full mesh of 2 to 50 agents as processes.

They are started all at once. Each has its four services and no task, and discovery at 1 Hz. There is no baseline.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.figure import Figure, Plan, alone
from soak.agents import Fleet, bytes_sent, names_of
from soak.vitals import processor_s, vitals_of

TITLE = "an agent in a fleet of so many, all on this machine"
BESIDE = ""
SIZES = (2, 10, 25, 50)
SPAN_S = 6.0
SETTLE_S = 3.0
STARTS_WITHIN_S = 60.0
MEETS_WITHIN_S = 5.0


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures fleets of all sizes."""
    for size in SIZES:
        yield from of_size(size, plan)


def of_size(size: int, plan: Plan) -> list[Figure]:
    """Measures one fleet, in spans that follow each other."""
    meets = Figure(f"{size} agents: all have met, after the last listens", "s", wanted=MEETS_WITHIN_S, absolute=True)
    processor = Figure(f"{size} agents: processor time of an agent", "ms/s")
    wire = Figure(f"{size} agents: an agent sends, without headers", "kB/s")
    memory = Figure(f"{size} agents: memory of an agent, shared pages shared", "MiB")
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as directory:
        with Fleet(Path(directory), names_of(size), {}) as fleet:
            fleet.start()
            fleet.until(fleet.all_ready, "all agents start", STARTS_WITHIN_S)
            meets.runs.append(fleet.until(fleet.is_full_mesh, "all agents meet", STARTS_WITHIN_S))
            time.sleep(SETTLE_S)

            def span() -> list[float]:
                return _span(fleet, max(1.0, SPAN_S * plan.scale))

            return [meets, *alone(plan, [processor, wire, memory], span)]


def _span(fleet: Fleet, duration_s: float) -> list[float]:
    processes = [agent.process.pid for agent in fleet.alive() if agent.process is not None]
    size = len(processes)
    sent, asked_s = bytes_sent(fleet)
    used_s, began_s = sum(map(processor_s, processes)), time.monotonic()
    time.sleep(duration_s)
    used_s, took_s = sum(map(processor_s, processes)) - used_s, time.monotonic() - began_s
    sent_then, asked_then_s = bytes_sent(fleet)
    memory_kib = [vitals_of(pid).pss_kib for pid in processes]
    return [
        1000 * used_s / took_s / size,
        (sent_then - sent) / (asked_then_s - asked_s) / size / 1000,
        sum(memory_kib) / size / 1024,
    ]
