"""What a router costs: a task to a task in another process through one Zenoh router, and over TCP, both with keys.

And what an agent that stands still costs the others: the round trip of a healthy link at a router at which another
agent is stopped (SIGSTOP) while 24 links send to it; the baseline has none that is stopped.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

from benchmarks.figure import Figure, Plan, in_turns
from benchmarks.two_processes import PACKETS, ROUND_TRIPS, Way, pancakes, trips_us
from zenoh_links import swallower
from zenoh_links.routers import Router

from pancakes.mesh.transport import Connection, ConnectionHandler, SocketTransport
from pancakes.util.clock import MonotonicClock
from pancakes.util.plugins import Plugins

TITLE = "a task to a task in another process, through a Zenoh router, with keys"
BESIDE = "TCP with keys"
LINKS = 24
OWED_BYTES = 1_000_000
"""So much waits on each of the links to the agent that is stopped."""
TRIPS = 500
PATIENCE_S = 20.0


class _End(ConnectionHandler):
    """One end; where it is the far one, it sends all back."""

    def __init__(self, returns: bool = False) -> None:
        self.stands, self.came = threading.Event(), threading.Event()
        self._returns = returns

    def opened(self, connection: Connection) -> None:
        """See `ConnectionHandler`."""
        self.connection = connection
        self.stands.set()

    def received(self, data: bytes) -> None:
        """See `ConnectionHandler`."""
        if self._returns:
            self.connection.send(data)
        self.came.set()

    def closed(self, reason: str) -> None:
        """See `ConnectionHandler`."""


def healthy_p99_us(router: str, is_one_stopped: bool) -> float:
    """Returns the 99th percentile of a healthy link's round trips."""
    command = [sys.executable, swallower.__file__, router, "zenoh://swallower:0"]
    settings = {"zenoh": {"insecure": True, "routers": [router]}}
    sender, healthy = (SocketTransport(MonotonicClock(), name, Plugins(), settings) for name in ("sender", "healthy"))
    stopped = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert stopped.stdout is not None
        address = stopped.stdout.readline().strip()
        links = [_End() for _ in range(LINKS)]
        for link in links:
            sender.dial(address, link)
        near = _End()
        sender.dial(healthy.listen("zenoh://healthy:0", lambda: _End(returns=True)), near)
        if not all(link.stands.wait(PATIENCE_S) for link in (*links, near)):
            raise RuntimeError("the links did not come to stand")
        if is_one_stopped:
            os.kill(stopped.pid, signal.SIGSTOP)
            for link in links:
                link.connection.send(bytes(OWED_BYTES))
        times_s = sorted(_trip_s(near) for _ in range(TRIPS))
        return times_s[int(len(times_s) * 0.99)] * 1e6
    finally:
        stopped.kill()
        stopped.wait()
        if stopped.stdout is not None:
            stopped.stdout.close()
        sender.close()
        healthy.close()


def _trip_s(near: _End) -> float:
    near.came.clear()
    began_s = time.perf_counter()
    near.connection.send(bytes(64))
    if not near.came.wait(PATIENCE_S):
        raise RuntimeError("a healthy link stood still")
    return time.perf_counter() - began_s


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    trips = max(200, plan.share(ROUND_TRIPS))
    small, large = (max(500, plan.share(number)) for number in PACKETS.values())
    router = Router()
    router.start()
    try:

        def over(way: Way) -> list[float]:
            report = pancakes(64, trips, small, way=way, router=router.address)
            bulk = pancakes(65_536, 200, large, way=way, router=router.address)
            return [*trips_us(report), report["per_s"], bulk["per_s"]]

        yield from in_turns(
            plan,
            [
                Figure("round trip, 64 B: p50", "µs"),
                Figure("round trip, 64 B: p99", "µs"),
                Figure("one way, 64 B", "1/s", "min"),
                Figure("one way, 64 KiB", "1/s", "min"),
            ],
            lambda: over("routed"),
            lambda: over("keys"),
        )
        yield from in_turns(
            plan,
            [Figure("a healthy link beside a stopped agent: p99; none is stopped", "µs", wanted=2.0)],
            lambda: [healthy_p99_us(router.address, True)],
            lambda: [healthy_p99_us(router.address, False)],
        )
    finally:
        router.end()
