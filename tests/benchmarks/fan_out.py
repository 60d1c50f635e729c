"""One task publishes, 1, 10 or 100 others get it: what a delivery costs, and how long until the last has it.

The baseline is a thread that puts into a `queue.SimpleQueue` for each of as many threads.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from queue import SimpleQueue
from statistics import median
from typing import Any

from benchmarks.figure import Figure, Plan, in_turns
from benchmarks.local_agent import local_agent

from pancakes.devices.types import Pose
from pancakes.packet import Packet
from pancakes.task import Task, Tick, every, on, queue

TITLE = "a channel to its subscribers"
SUBSCRIBERS = (1, 10, 100)
DELIVERIES = 100_000
BURST = 64
"""Packets that the publisher publishes in one turn."""
PROBES = 60
PROBES_HZ = 200.0
SKIPPED = 10
"""Probes at the beginning that do not count: everything is cold."""
PATIENCE_S = 60.0

_POSE = Pose(1.0, 2.0, 0.5)


class Publisher(Task):
    """Publishes as fast as it can, or one packet at a time."""

    @dataclass
    class Settings:
        packets: int = 0

    def on_start(self) -> None:
        self.sent = 0
        self.began_s = 0.0
        self.probes_s: list[float] = []

    def flood(self) -> None:
        """Publishes all packets, a burst in each turn."""
        if not self.sent:
            self.began_s = time.perf_counter()
        burst = min(BURST, self.settings.packets - self.sent)
        for _ in range(burst):
            self.publish("bench", _POSE)
        self.sent += burst
        if self.sent < self.settings.packets:
            self.call(self.flood)

    @every(hz=0)
    def probe(self, tick: Tick) -> None:
        """Publishes one packet."""
        if len(self.probes_s) < PROBES:
            self.probes_s.append(time.perf_counter())
            self.publish("probe", _POSE)


class Subscriber(Task):
    """Counts what it gets, and says on `done` when that was all."""

    @dataclass
    class Settings:
        packets: int = 0

    def on_start(self) -> None:
        self.count = 0
        self.wanted = self.settings.packets
        self.heard_s: list[float] = []

    # Room for all: where the system takes a worker's core away meanwhile, the others run far ahead of its subscriber.
    @on("bench", Pose, keep=queue(DELIVERIES))
    def take(self, packet: Packet) -> None:
        """Counts one packet."""
        self.count += 1
        if self.count == self.wanted:
            self.publish("done", _POSE)

    @on("probe", Pose)
    def hear(self, packet: Packet) -> None:
        """Notes when one packet came."""
        self.heard_s.append(time.perf_counter())
        if len(self.heard_s) == PROBES:
            self.publish("done", _POSE)


class _Countdown:
    """Waits until all have finished; takes the time of the last."""

    def __init__(self, number: int) -> None:
        self._left = number
        self._lock = threading.Lock()
        self._event = threading.Event()
        self.ended_s = 0.0

    def one(self, _packet: Any = None) -> None:
        """One has finished. Any thread."""
        with self._lock:
            self._left -= 1
            if self._left == 0:
                self.ended_s = time.perf_counter()
                self._event.set()

    def wait(self) -> None:
        """Waits until the last has finished."""
        if not self._event.wait(PATIENCE_S):
            raise TimeoutError(f"{self._left} subscribers had not got everything after {PATIENCE_S:g} s")


def _last_us(probes_s: list[float], heard_s: list[list[float]]) -> float:
    """The median time from a probe until the last subscriber had it, in microseconds."""
    return median(max(times) - sent for sent, *times in list(zip(probes_s, *heard_s, strict=True))[SKIPPED:]) * 1e6


def pancakes(subscribers: int, packets: int) -> list[float]:
    """One run of ours. Returns ns a delivery, and µs until the last has it."""
    tasks = {f"Subscriber{number}": f'type = "bench.Subscriber"\nsettings = {{ packets = {packets} }}'
             for number in range(subscribers)}  # fmt: skip
    tasks["Publisher"] = f'type = "bench.Publisher"\nsettings = {{ packets = {packets} }}'
    classes: dict[str, type[Task]] = {"bench.Subscriber": Subscriber, "bench.Publisher": Publisher}
    with local_agent(classes, tasks, ("bench", "probe", "done")) as agent:
        find = agent.kernel.registry.get
        publisher: Any = find("bench/client/Publisher")
        others: list[Any] = [find(f"bench/client/Subscriber{number}") for number in range(subscribers)]
        countdown = _Countdown(subscribers)
        agent.kernel.stream.tap("done", countdown.one)
        publisher.call(publisher.flood)
        countdown.wait()
        delivery_ns = (countdown.ended_s - publisher.began_s) / (packets * subscribers) * 1e9
        agent.kernel.stream.untap("done", countdown.one)
        countdown = _Countdown(subscribers)
        agent.kernel.stream.tap("done", countdown.one)
        publisher.call(lambda: publisher.reschedule(PROBES_HZ))
        countdown.wait()
        return [delivery_ns, _last_us(publisher.probes_s, [other.heard_s for other in others])]


def simple_queues(subscribers: int, packets: int) -> list[float]:
    """One run of the baseline. Returns the same."""
    queues: list[SimpleQueue[Any]] = [SimpleQueue() for _ in range(subscribers)]
    heard_s: list[list[float]] = [[] for _ in range(subscribers)]
    flooded, probed = _Countdown(subscribers), _Countdown(subscribers)

    def subscriber(number: int) -> None:
        get, heard = queues[number].get, heard_s[number]
        for _ in range(packets):
            get()
        flooded.one()
        for _ in range(PROBES):
            get()
            heard.append(time.perf_counter())
        probed.one()

    threads = [threading.Thread(target=subscriber, args=(number,), daemon=True) for number in range(subscribers)]
    for thread in threads:
        thread.start()
    puts = [one.put for one in queues]
    began_s = time.perf_counter()
    for _ in range(packets):
        for put in puts:
            put(_POSE)
    flooded.wait()
    delivery_ns = (flooded.ended_s - began_s) / (packets * subscribers) * 1e9
    probes_s = []
    due_s = time.perf_counter()
    for _ in range(PROBES):
        due_s += 1.0 / PROBES_HZ
        time.sleep(max(0.0, due_s - time.perf_counter()))
        probes_s.append(time.perf_counter())
        for put in puts:
            put(_POSE)
    probed.wait()
    for thread in threads:
        thread.join()
    return [delivery_ns, _last_us(probes_s, heard_s)]


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    for subscribers in SUBSCRIBERS:
        packets = max(1, plan.share(DELIVERIES) // subscribers)
        figures = [
            Figure(f"publish to {subscribers}: a delivery", "ns"),
            Figure(f"publish to {subscribers}: until the last has it", "µs"),
        ]
        yield from in_turns(
            plan,
            figures,
            lambda subscribers=subscribers, packets=packets: pancakes(subscribers, packets),  # type: ignore[misc]
            lambda subscribers=subscribers, packets=packets: simple_queues(subscribers, packets),  # type: ignore[misc]
        )
