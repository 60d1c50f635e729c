"""A task or a driver publishes, 1, 10 or 100 tasks get it: what a delivery costs, and how long until the last has it.

The baseline is pykka as it comes: as many `ThreadingActor`s, and a loop that tells each of them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import Any

import pykka
from benchmarks.figure import Figure, Plan, in_turns
from benchmarks.local_agent import local_agent

from pancakes.agent.agent import Agent
from pancakes.devices import Pose
from pancakes.devices.driver import Sensor
from pancakes.packet import SYSTEM, Packet
from pancakes.task import Task, Tick, every, on

TITLE = "a channel to its subscribers"
SUBSCRIBERS: tuple[tuple[int, float | None, float | None], ...] = ((1, 0.28, None), (10, None, None), (100, 0.17, 0.09))
"""How many there are, and what is wanted of a delivery, and of the time until the last has it."""
FROM_A_DRIVER = 0.45
"""What is wanted of a delivery to one subscriber from a driver's own thread."""
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
        burst: int = BURST

    def on_start(self) -> None:
        self.sent = 0
        self.began_s = self.began_cpu_s = 0.0
        self.probes_s: list[float] = []

    def flood(self) -> None:
        """Publishes all packets, a burst in each turn."""
        if not self.sent:
            self.began_s, self.began_cpu_s = time.perf_counter(), time.process_time()
        burst = min(self.settings.burst, self.settings.packets - self.sent)
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
    @on("bench", Pose, queue=DELIVERIES)
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


class Reader(Subscriber):
    """Counts readings of a device."""

    @on(SYSTEM, Pose, queue=DELIVERIES)
    def take(self, packet: Packet) -> None:
        """Counts one reading."""
        super().take(packet)


class Stream(Sensor):
    """A sensor whose hardware sends readings by itself, so that a thread of its own has to listen: as fast as it can.

    Whoever sends it a pose makes the hardware begin.
    """

    type = "pose"
    rate = "none"

    @dataclass
    class Settings:
        readings: int = 0

    def open(self) -> None:
        self.began_s = self.began_cpu_s = 0.0
        self._thread = threading.Thread(target=self._listen, name="stream", daemon=True)

    def receive(self, packet: Packet) -> None:
        self._thread.start()

    def read(self) -> None:
        """Brings nothing: readings come from the thread."""

    def _listen(self) -> None:
        self.began_s, self.began_cpu_s = time.perf_counter(), time.process_time()
        deliver = self.context.deliver
        for _ in range(self.settings.readings):
            deliver(_POSE)


class Countdown:
    """Waits until all have finished; takes the time of the last, and the processor time of this process by then."""

    def __init__(self, number: int) -> None:
        self._left = number
        self._lock = threading.Lock()
        self._event = threading.Event()
        self.ended_s = self.ended_cpu_s = 0.0

    def one(self, _packet: Any = None) -> None:
        """One has finished. Any thread."""
        with self._lock:
            self._left -= 1
            if self._left == 0:
                self.ended_s, self.ended_cpu_s = time.perf_counter(), time.process_time()
                self._event.set()

    def wait(self) -> None:
        """Waits until the last has finished."""
        if not self._event.wait(PATIENCE_S):
            raise TimeoutError(f"{self._left} subscribers had not got everything after {PATIENCE_S:g} s")

    def each_ns(self, began_s: float, began_cpu_s: float, number: int) -> list[float]:
        """Returns the time, and the processor time, from a beginning until the last had finished, for each of many."""
        return [(self.ended_s - began_s) / number * 1e9, (self.ended_cpu_s - began_cpu_s) / number * 1e9]


def _last_us(probes_s: list[float], heard_s: list[list[float]]) -> float:
    """The median time from a probe until the last subscriber had it, in microseconds."""
    return median(max(times) - sent for sent, *times in list(zip(probes_s, *heard_s, strict=True))[SKIPPED:]) * 1e6


def _counting(agent: Agent, number: int) -> Countdown:
    """Waits for so many to say `done`."""
    countdown = Countdown(number)
    agent.kernel.stream.tap("done", countdown.one)
    return countdown


def from_a_task(subscribers: int, packets: int, burst: int = BURST, probes: bool = True) -> list[float]:
    """One run of ours. Returns ns a delivery, the same in processor time, and µs until the last has it.

    Args:
        subscribers: how many get each packet.
        packets: how many are published.
        burst: how many are published in one turn.
        probes: whether the last is measured; else only the first two values are returned.
    """
    tasks = {f"Subscriber{number}": f'type = "bench.Subscriber"\nsettings = {{ packets = {packets} }}'
             for number in range(subscribers)}  # fmt: skip
    tasks["Publisher"] = f'type = "bench.Publisher"\nsettings = {{ packets = {packets}, burst = {burst} }}'
    classes: dict[str, type[Task]] = {"bench.Subscriber": Subscriber, "bench.Publisher": Publisher}
    with local_agent(classes, tasks, ("bench", "probe", "done")) as agent:
        cores: Any = agent.kernel.registry
        publisher: Any = cores.get(f"{agent.name}/client/Publisher").facade
        others: list[Any] = [
            cores.get(f"{agent.name}/client/Subscriber{number}").facade for number in range(subscribers)
        ]
        flooded = _counting(agent, subscribers)
        publisher.call(publisher.flood)
        flooded.wait()
        each_ns = flooded.each_ns(publisher.began_s, publisher.began_cpu_s, packets * subscribers)
        if not probes:
            return each_ns
        agent.kernel.stream.untap("done", flooded.one)
        probed = _counting(agent, subscribers)
        publisher.call(lambda: publisher.reschedule(PROBES_HZ))
        probed.wait()
        return [*each_ns, _last_us(publisher.probes_s, [other.heard_s for other in others])]


def from_a_driver(packets: int) -> list[float]:
    """One run of ours: a driver's thread to one task. Returns ns a delivery, and the same in processor time."""
    tasks = {"Reader": f'type = "bench.Reader"\nsettings = {{ packets = {packets} }}'}
    device_table = f'[device.stream]\ndriver = "bench.Stream"\nsettings = {{ readings = {packets} }}'
    offers = {("pancakes.drivers", "bench.Stream"): Stream}
    channels = ("bench", "probe", "done")
    with local_agent({"bench.Reader": Reader}, tasks, channels, offers, device_table) as agent:
        cores: Any = agent.kernel.registry
        device: Any = cores.get(f"{agent.name}/device/stream")
        reader: Any = cores.get(f"{agent.name}/client/Reader").facade
        done = _counting(agent, 1)
        reader.call(lambda: reader.publish(SYSTEM, _POSE, to=device.address))
        done.wait()
        return done.each_ns(device.driver.began_s, device.driver.began_cpu_s, packets)


class StockActor(pykka.ThreadingActor):
    """Counts what it is told, then notes when each probe came."""

    def __init__(self, packets: int, heard_s: list[float], flooded: Countdown, probed: Countdown) -> None:
        super().__init__()
        self.count = 0
        self.packets = packets
        self.heard_s = heard_s
        self.flooded = flooded
        self.probed = probed

    def on_receive(self, message: Any) -> None:
        self.count += 1
        if self.count > self.packets:
            self.heard_s.append(time.perf_counter())
            if len(self.heard_s) == PROBES:
                self.probed.one()
        elif self.count == self.packets:
            self.flooded.one()


def stock_pykka(subscribers: int, packets: int) -> list[float]:
    """One run of the baseline. Returns the same as `from_a_task`."""
    flooded, probed = Countdown(subscribers), Countdown(subscribers)
    heard_s: list[list[float]] = [[] for _ in range(subscribers)]
    with ExitStack() as stack:  # actors that nobody stops would keep this process for ever
        refs = []
        for number in range(subscribers):
            refs.append(StockActor.start(packets, heard_s[number], flooded, probed))
            stack.callback(refs[-1].stop)
        began_s, began_cpu_s = time.perf_counter(), time.process_time()
        for _ in range(packets):
            for ref in refs:
                ref.tell(_POSE)
        flooded.wait()
        each_ns = flooded.each_ns(began_s, began_cpu_s, packets * subscribers)
        probes_s = []
        due_s = time.perf_counter()
        for _ in range(PROBES):
            due_s += 1.0 / PROBES_HZ
            time.sleep(max(0.0, due_s - time.perf_counter()))
            probes_s.append(time.perf_counter())
            for ref in refs:
                ref.tell(_POSE)
        probed.wait()
        return [*each_ns, _last_us(probes_s, heard_s)]


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    for subscribers, delivery, last in SUBSCRIBERS:
        packets = max(1, plan.share(DELIVERIES) // subscribers)
        figures = [
            Figure(f"publish to {subscribers}: a delivery", "ns", wanted=delivery),
            Figure(f"publish to {subscribers}: CPU of a delivery", "ns", least=True),
            Figure(f"publish to {subscribers}: until the last has it", "µs", wanted=last),
        ]
        yield from in_turns(
            plan,
            figures,
            partial(from_a_task, subscribers, packets),
            partial(stock_pykka, subscribers, packets),
        )
    packets = plan.share(DELIVERIES)
    yield from in_turns(
        plan,
        [
            Figure("publish to 1 from a driver's thread: a delivery", "ns", wanted=FROM_A_DRIVER),
            Figure("publish to 1 from a driver's thread: CPU", "ns", least=True),
        ],
        lambda: from_a_driver(packets),
        lambda: stock_pykka(1, packets)[:2],
    )
