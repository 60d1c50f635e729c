"""What encryption and certificates cost: agents with keys, and the same ones without (`insecure`), over TCP.

The baseline is the same without keys, in one run. Each of the two processes of a link is bound to a core.
"""

from __future__ import annotations

import gc
import tempfile
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import psutil
from benchmarks.agent_process import keys_of
from benchmarks.figure import Figure, Plan, alone, in_turns
from benchmarks.start_up import pancakes as started
from benchmarks.two_processes import PACKETS, ROUND_TRIPS, Way, pancakes, trips_us
from keys_in_test import KeysInTest

from pancakes.mesh.transport import Connection, ConnectionHandler, SocketTransport
from pancakes.security.keys import Keys
from pancakes.util.clock import MonotonicClock
from pancakes.util.plugins import Plugins

TITLE = "a task to a task in another process, over TCP with keys"
BESIDE = "TCP without keys"
LINKS = 200
"""So many stand idle where their memory is measured."""
PATIENCE_S = 30.0


class _Counted(ConnectionHandler):
    """Waits until so many connections stand."""

    def __init__(self, number: int) -> None:
        self._left = number
        self._connections: list[Connection] = []
        self.all_stand = threading.Event()

    def opened(self, connection: Connection) -> None:
        """See `ConnectionHandler`."""
        self._connections.append(connection)
        if len(self._connections) == self._left:
            self.all_stand.set()

    def received(self, data: bytes) -> None:
        """See `ConnectionHandler`."""

    def closed(self, reason: str) -> None:
        """See `ConnectionHandler`."""


def link_end_kib(folder: Path) -> float:
    """Returns the memory of one end of an idle connection, in KiB: both ends are in this process, which is new.

    Args:
        folder: the keys.
    """
    transport = SocketTransport(MonotonicClock(), "bench", Plugins(), keys=Keys(folder))
    try:
        _stand(transport, 20)  # what is made once
        gc.collect()
        before = psutil.Process().memory_info().rss
        kept = _stand(transport, LINKS)
        gc.collect()
        grown = psutil.Process().memory_info().rss - before
        del kept
    finally:
        transport.close()
    return grown / 1024 / (2 * LINKS)


def _stand(transport: SocketTransport, number: int) -> list[_Counted]:
    here, there = _Counted(number), _Counted(number)
    address = transport.listen("tcp://127.0.0.1:0", lambda: there)
    for count in range(number):
        transport.dial(address, here)
        if count % 40 == 39 and not here.all_stand.wait(0.5):  # more at a time would be refused
            continue
    for side in (here, there):
        if not side.all_stand.wait(PATIENCE_S):
            raise RuntimeError(f"{number} connections did not come to stand")
    return [here, there]


def _in_new_process(folder: Path) -> float:
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(link_end_kib, folder).result()


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    trips = max(200, plan.share(ROUND_TRIPS))
    small, large = (max(500, plan.share(number)) for number in PACKETS.values())

    def over(way: Way) -> list[float]:
        report = pancakes(64, trips, small, way=way)
        return [trips_us(report)[0], report["per_s"], pancakes(65_536, 200, large, way=way)["per_s"]]

    yield from in_turns(
        plan,
        [
            Figure("round trip, 64 B: p50", "µs", wanted=1.5),
            Figure("one way, 64 B", "1/s", "min", wanted=0.9),
            Figure("one way, 64 KiB", "1/s", "min", wanted=0.45),
        ],
        lambda: over("keys"),
        lambda: over("plain"),
    )
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name:
        folder = KeysInTest(Path(name)).of_agent("default", "idle")
        idle = Figure("memory of one end of an idle link", "KiB", wanted=32.0, absolute=True)
        yield from alone(plan, [idle], lambda: [_in_new_process(folder)])
        environment = keys_of(Path(name), "idle")
        yield from in_turns(
            plan,
            [Figure("an agent's start, to the first tick", "ms", wanted=1.15), Figure("its memory", "MiB")],
            lambda: started(environment)[:3:2],
            lambda: started({})[:3:2],
        )
