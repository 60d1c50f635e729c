"""From a task to a task in another process of the same machine: by `local://`, and over TCP.

The baseline is the same two agents over TCP. Each of the two processes is bound to a core.
"""

from __future__ import annotations

from collections.abc import Iterator

from benchmarks.figure import Figure, Plan, in_turns
from benchmarks.two_processes import PACKETS, ROUND_TRIPS, Way, pancakes, trips_us

TITLE = "a task to a task in another process, by local://"
BESIDE = "TCP"


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    trips, packets = max(200, plan.share(ROUND_TRIPS)), max(500, plan.share(PACKETS[64]))

    def over(way: Way) -> list[float]:
        report = pancakes(64, trips, packets, way=way)
        return [trips_us(report)[0], report["per_s"]]

    yield from in_turns(
        plan,
        [Figure("round trip, 64 B: p50", "µs", wanted=1.0), Figure("one way, 64 B", "1/s", "min")],
        lambda: over("local"),
        lambda: over("plain"),
    )
