"""From a task to a task in another process, over the mesh: round trips, and packets one way.

The baseline is two processes with a blocking socket each, which exchange the same packets as msgpack. Each of the two
processes is bound to a core: unbound, the bare round trip has two values, according to where the scheduler puts them.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from benchmarks.agent_process import (
    agent_process,
    head_of,
    keys_of,
    listening_at,
    offer_tasks,
    process,
    read_report,
    two_cores,
    usual_environment,
)
from benchmarks.figure import Figure, Plan, in_turns

Way = Literal["plain", "keys", "local", "routed"]

TITLE = "a task to a task in another process, over loopback"
ROUND_TRIPS = 3000
PACKETS = {64: 50_000, 65_536: 3_000}
"""How many go one way, for each size of their data in bytes."""
SKIPPED = 10
"""The first so many-th of the round trips do not count: everything is cold."""

_TASK = """
[channel.bench]
[channel.load]
[task.{task}]
type = "bench.{task}"
settings = {{ {settings} }}
"""


def pancakes(
    size: int, round_trips: int, packets: int, is_bound: bool = True, way: Way = "plain", router: str = ""
) -> dict[str, Any]:
    """One run of ours, each process bound to a core or not. Returns what the near task reports.

    Args:
        size: of the packets' data, in bytes.
        round_trips: how many.
        packets: how many go one way.
        is_bound: whether each process is bound to a core.
        way: how they speak: over TCP without keys, over TCP with keys, by `local://`, or through a router with keys.
        router: where that is.

    Raises:
        RuntimeError: packets were lost.
    """
    near_core, far_core = two_cores() if is_bound else (None, None)
    reader, writer = os.pipe()
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name:
        directory = Path(name)
        environment = offer_tasks(directory)
        if way in ("keys", "routed"):
            environment = {**environment, **keys_of(directory, "near", "far"), "PANCAKES_ZENOH": router}
        at = "zenoh://{}:1" if way == "routed" else "tcp://127.0.0.1:0"
        far = head_of("far", directory, at=at.format("far")) + _TASK.format(task="Far", settings="")
        settings = f"report_fd = {writer}, round_trips = {round_trips}, packets = {packets}, size = {size}"
        with agent_process(far, directory, environment, far_core, until_ready=True) as listener:
            peers = [listening_at(environment, "far", listener, way == "local")]
            near = head_of("near", directory, peers, at.format("near")) + _TASK.format(task="Near", settings=settings)
            with agent_process(near, directory, environment, near_core, (writer,)):
                os.close(writer)
                try:
                    report = read_report(reader)
                finally:
                    os.close(reader)
    if report["received"] != packets:
        raise RuntimeError(f"{report['received']} of {packets} packets arrived")
    return report


def bare_sockets(size: int, round_trips: int, packets: int) -> dict[str, Any]:
    """One run of the baseline. Returns what its near process reports."""
    near_core, far_core = two_cores()
    command = [sys.executable, "-m", "benchmarks.bare_sockets"]
    port_reader, port_writer = os.pipe()
    reader, writer = os.pipe()
    numbers = [str(number) for number in (round_trips, packets, size)]
    with process([*command, "far", str(port_writer)], usual_environment(), far_core, (port_writer,)):
        port = read_report(port_reader)["port"]
        near = [*command, "near", str(port), str(writer), *numbers]
        with process(near, usual_environment(), near_core, (writer,)):
            try:
                return read_report(reader)
            finally:
                for handle in (reader, writer, port_reader, port_writer):
                    os.close(handle)


def trips_us(report: dict[str, Any]) -> list[float]:
    """Returns the median and the 99th percentile of the round trips."""
    times_s = report["times_s"]
    warm = sorted(times_s[len(times_s) // SKIPPED :])
    return [warm[len(warm) // 2] * 1e6, warm[int(len(warm) * 0.99)] * 1e6]


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    trips = max(200, plan.share(ROUND_TRIPS))
    small, large = (max(500, plan.share(number)) for number in PACKETS.values())

    def small_ours() -> list[float]:
        report = pancakes(64, trips, small)
        return [*trips_us(report), report["per_s"], report["per_s"], *report["cpu_us"]]

    def small_bare() -> list[float]:
        report = bare_sockets(64, trips, small)
        return [*trips_us(report), report["per_s"], report["coalesced_per_s"], *report["cpu_us"]]

    yield from in_turns(
        plan,
        [
            Figure("round trip, 64 B: p50", "µs", wanted=0.60),
            Figure("round trip, 64 B: p99", "µs"),
            Figure("one way, 64 B; bare: a send each", "1/s", "min"),
            Figure("one way, 64 B; bare: many in a send", "1/s", "min"),
            Figure("the same: CPU of a packet at the sender", "µs", least=True),
            Figure("the same: CPU of a packet at the receiver", "µs", least=True),
        ],
        small_ours,
        small_bare,
    )

    def megabytes(report: dict[str, Any]) -> list[float]:
        return [report["per_s"] * 65_536 / 1e6]

    yield from in_turns(
        plan,
        [Figure("one way, 64 KiB", "MB/s", "min", wanted=0.75)],
        lambda: megabytes(pancakes(65_536, 10, large)),
        lambda: megabytes(bare_sockets(65_536, 10, large)),
    )
