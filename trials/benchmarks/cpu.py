"""The processor time of single steps inside an agent: a delivery, a turn of one packet, a tick, a reading of a driver.

It is that of the whole process, with all its threads, so other work on the machine changes it less than it changes wall
time. What is bare beside it is as simple as it can be, and runs on one thread, which wakes no other: a message that is
told to a stock pykka actor, and handled by it; the next deadline of a heap, and the call of a function.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import pykka
from benchmarks.fan_out import from_a_driver, from_a_task
from benchmarks.figure import Figure, Plan, in_turns
from benchmarks.local_agent import local_agent

from pancakes.devices import Pose
from pancakes.packet import Packet
from pancakes.task import Task, Tick, every, on

TITLE = "the processor time of single steps"
DELIVERIES = 50_000
TURNS = 30_000
SUBSCRIBERS = 100
TICKING, TICKS_HZ = 100, 500.0
TICKING_S = 1.0
PACED, PACED_HZ = 1_000, 1_000.0
BARE = 50_000

_POSE = Pose(1.0, 2.0, 0.5)


class Ticking(Task):
    """Counts its ticks."""

    def on_start(self) -> None:
        self.count = 0

    @every(hz=1)
    def tick(self, tick: Tick) -> None:
        """Counts one."""
        self.count += 1


class Paced(Task):
    """Publishes one packet in each tick."""

    @every(hz=0)
    def tick(self, tick: Tick) -> None:
        """Publishes one."""
        self.publish("bench", _POSE)


class Taking(Task):
    """Counts packets, and keeps the processor time of the process between the first and the last of some."""

    @dataclass
    class Settings:
        packets: int = 0

    def on_start(self) -> None:
        self.count = 0

    @on("bench", Pose, queue=1024)
    def take(self, packet: Packet) -> None:
        """Counts one packet."""
        self.count += 1
        if self.count == 1:
            self.began_cpu_s = time.process_time()
        elif self.count == self.settings.packets + 1:
            self.used_s = time.process_time() - self.began_cpu_s
            self.publish("done", _POSE)


def delivery_ns(subscribers: int, packets: int) -> list[float]:
    """One run: a task publishes in bursts. Returns ns a delivery, all from `publish` to the end of the handler."""
    return from_a_task(subscribers, packets, probes=False)[1:]


def turn_ns(packets: int) -> list[float]:
    """One run: each packet finds all its subscribers without work. Returns ns a delivery and the turn that it gives."""
    return from_a_task(SUBSCRIBERS, packets, burst=1, probes=False)[1:]


def driver_ns(packets: int) -> list[float]:
    """One run: a thread of a driver brings readings. Returns ns a reading, until its reader has handled it."""
    return from_a_driver(packets)[1:]


def tick_ns(duration_s: float) -> list[float]:
    """One run: many tasks tick together. Returns ns a tick, with the timer's part and its waking up."""
    table = f'type = "bench.Ticking"\nrate_hz = {TICKS_HZ}'
    with local_agent({"bench.Ticking": Ticking}, {f"Ticking{number}": table for number in range(TICKING)}) as agent:
        cores: Any = agent.kernel.registry
        tasks: list[Any] = [cores.get(f"{agent.name}/client/Ticking{number}").facade for number in range(TICKING)]
        time.sleep(0.2)
        before, before_s = sum(task.count for task in tasks), time.process_time()
        time.sleep(duration_s)
        used_s = time.process_time() - before_s
        return [used_s / (sum(task.count for task in tasks) - before) * 1e9]


def paced_us(packets: int) -> list[float]:
    """One run: a task publishes at 1 kHz to one other. Returns µs for a tick, packet and turn, waking up included."""
    tasks = {
        "Taking": f'type = "bench.Taking"\nsettings = {{ packets = {packets} }}',
        "Paced": f'type = "bench.Paced"\nrate_hz = {PACED_HZ}',
    }
    with local_agent({"bench.Taking": Taking, "bench.Paced": Paced}, tasks, ("bench", "done")) as agent:
        cores: Any = agent.kernel.registry
        taking: Any = cores.get(f"{agent.name}/client/Taking").facade
        until_s = time.monotonic() + 60.0
        while not hasattr(taking, "used_s"):
            if time.monotonic() > until_s:
                raise TimeoutError(f"only {taking.count} packets came")
            time.sleep(0.1)
        return [float(taking.used_s / packets * 1e6)]


class _Told(pykka.ThreadingActor):
    """A stock actor without its thread: whoever has it handles its messages."""

    made: ClassVar[list[_Told]]

    def _start_actor_loop(self) -> None:
        self.made.append(self)

    def on_receive(self, message: Any) -> None:
        """Takes one."""


def bare_tell_ns(messages: int = BARE) -> list[float]:
    """One run of the baseline: stock pykka's `tell`, inbox and handling, on one thread. Returns ns a message."""
    _Told.made = []
    reference = _Told.start()
    (actor,) = _Told.made
    tell, get, handle = reference.tell, reference.actor_inbox.get, actor._handle_receive  # noqa: SLF001
    before_s = time.thread_time()
    for _ in range(messages):
        tell(_POSE)
        handle(get().message)
    used_s = time.thread_time() - before_s
    pykka.ActorRegistry.unregister(reference)
    return [used_s / messages * 1e9]


def bare_tick_ns(ticks: int = BARE) -> list[float]:
    """One run of the baseline: a heap of as many deadlines, and the call of a function. Returns ns a tick."""
    count = 0

    def tick(due_s: float) -> None:
        nonlocal count
        count += 1

    heap = [(0.0, number, tick) for number in range(TICKING)]
    before_s = time.thread_time()
    for _ in range(ticks):
        due_s, number, call = heap[0]
        heapq.heapreplace(heap, (due_s + 1.0 / TICKS_HZ, number, call))
        call(due_s)
    return [(time.thread_time() - before_s) / ticks * 1e9]


def bare_paced_us(packets: int) -> list[float]:
    """One run of the baseline: a thread with a clock tells a stock actor at 1 kHz. Returns µs for each message."""
    actor = pykka.ThreadingActor.start()
    try:
        before_s, due_s = time.process_time(), time.monotonic()
        for _ in range(packets):
            due_s += 1.0 / PACED_HZ
            time.sleep(max(0.0, due_s - time.monotonic()))
            actor.tell(_POSE)
        return [(time.process_time() - before_s) / packets * 1e6]
    finally:
        actor.stop()


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    deliveries, turns, paced = (plan.share(number) for number in (DELIVERIES, TURNS, PACED))
    ticking_s = max(0.3, TICKING_S * plan.scale)
    for name, unit, ours, bare in (
        ("CPU of a delivery to 1", "ns", partial(delivery_ns, 1, deliveries), bare_tell_ns),
        ("CPU of a delivery to 100", "ns", partial(delivery_ns, 100, deliveries // 100), bare_tell_ns),
        ("CPU of a turn of one packet, with its delivery", "ns", partial(turn_ns, turns // SUBSCRIBERS), bare_tell_ns),
        ("CPU of a tick", "ns", partial(tick_ns, ticking_s), bare_tick_ns),
        ("CPU of a reading from a driver's thread", "ns", partial(driver_ns, deliveries), bare_tell_ns),
        ("CPU of a packet at 1 kHz, with tick and turn", "µs", partial(paced_us, paced), partial(bare_paced_us, paced)),
    ):
        yield from in_turns(plan, [Figure(name, unit, least=True)], ours, bare)
