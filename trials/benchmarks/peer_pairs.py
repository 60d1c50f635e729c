"""From a task to a task in another process, beside what a user might take instead: pyzmq, zenoh, ROS and mango.

The packets are the same, of 64 bytes and all that a packet says about itself, and are decoded at the receiver. The
peers are used in the way that is fastest without losing any (see the scripts in `peers`). Nothing is bound to a core.
Of rclpy it is the single-threaded executor: to its other one no other thread may publish.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from benchmarks import two_processes
from benchmarks.environments import MANGO, PYZMQ, RCLPY, ROSPY, ZENOH, Peer, PeerMissing, python_of
from benchmarks.figure import Figure, Missing, Plan, Side, in_turns_of_all
from benchmarks.peer_runs import pair

TITLE = "a task to a task in another process, beside what a user might take instead; bound to no core"
BESIDE = "the peer"
SIZE = 64
ROUND_TRIPS = 3000
PACKETS = {"pancakes": 100_000, "pyzmq": 100_000, "zenoh": 100_000, "rospy": 30_000, "rclpy": 10_000, "mango": 10_000}
"""How many go one way in a run."""
ONE_WAY_WANTED = {"zenoh": 1.0, "rospy": 3.0}


def measure(plan: Plan) -> Iterator[Figure | Missing]:
    """Measures everything."""
    trips = max(200, plan.share(ROUND_TRIPS))

    def ours() -> list[float]:
        return _values(two_processes.pancakes(SIZE, trips, plan.share(PACKETS["pancakes"]), is_bound=False))

    our_trips: list[float] = []
    our_rates: list[float] = []
    sides: list[Side] = [(ours, (our_trips, our_rates))]
    round_trips, one_way = [], []
    for peer in (PYZMQ, ZENOH, ROSPY, RCLPY, MANGO):
        try:
            theirs = _side(peer, trips, plan.share(PACKETS[peer.name]))
        except PeerMissing as error:
            yield Missing(peer.name, str(error))
            continue
        trips_us: list[float] = []
        rates: list[float] = []
        sides.append((theirs, (trips_us, rates)))
        round_trips.append(Figure(f"round trip, 64 B: p50; {peer.name}", "µs", "max", 1.0, our_trips, trips_us))
        wanted = ONE_WAY_WANTED.get(peer.name)
        one_way.append(Figure(f"one way, 64 B; {peer.name}", "1/s", "min", wanted, our_rates, rates))
    if len(sides) > 1:
        yield from in_turns_of_all(plan, sides, [*round_trips, *one_way])


def _side(peer: Peer, round_trips: int, packets: int) -> Callable[[], list[float]]:
    python = python_of(peer)
    return lambda: _values(pair(peer, python, round_trips, packets, SIZE))


def _values(report: dict[str, Any]) -> list[float]:
    return [two_processes.trips_us(report)[0], report["per_s"]]
