"""What a delivery costs in processor time at 200 Hz, in a process and between two, beside rclpy, of ROS 2.

One task publishes three numbers in each tick; 1 or 10 subscribers get them. The processor time is that of all processes
with all that they do meanwhile, for each delivery. Of rclpy the faster of its two executors counts, in each run.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from subprocess import Popen
from typing import Any, ClassVar

from benchmarks.agent_process import agent_process, head_of, listening_at, offer_tasks, read_report
from benchmarks.environments import RCLPY, PeerMissing, python_of
from benchmarks.figure import Figure, Missing, Plan, alone, in_turns
from benchmarks.peer_runs import peer_process, ros2_variables
from benchmarks.start_up import clock_of

from pancakes.devices import Pose
from pancakes.packet import Packet
from pancakes.task import Task, Tick, every, on

TITLE = "processor time of a delivery at 200 Hz, all that the processes do included"
BESIDE = "rclpy"
RATE_HZ = 200.0
SUBSCRIBERS = (1, 10)
SPAN_S = 4.0
SETTLE_S = 1.5
EXECUTORS = ("single", "events")
WANTED = 0.25


class Speaker(Task):
    """Publishes in each tick."""

    @dataclass
    class Settings:
        to: str = ""

    @every(hz=RATE_HZ)
    def tick(self, tick: Tick) -> None:
        """Publishes a pose."""
        self.publish("bench", Pose(1.0, 2.0, 0.5), to=self.settings.to)


class Hearer(Task):
    """Counts what all of its like get; the first that gets anything tells the count when a span begins and ends."""

    counts: ClassVar[list[int]] = [0]

    @dataclass
    class Settings:
        report_fd: int
        span_s: float

    @on("bench", Pose)
    def take(self, packet: Packet) -> None:
        """Counts one."""
        self.counts[0] += 1
        if self.counts[0] == 1:
            self.after_host(SETTLE_S, self.tell)
            self.after_host(SETTLE_S + self.settings.span_s, self.tell)

    def tell(self) -> None:
        """Tells it now."""
        os.write(self.settings.report_fd, f"{json.dumps(self.counts[0])}\n".encode())


_TASKS = {f"bench.{name}": f"benchmarks.peer_ros2:{name}" for name in ("Speaker", "Hearer")}
_SPEAKER = '[task.Speaker]\ntype = "bench.Speaker"\nsettings = {{ to = "{to}" }}\n'
_HEARER = '[task.Hearer{}]\ntype = "bench.Hearer"\nsettings = {{ report_fd = {}, span_s = {} }}\n'


def _a_delivery_us(processes: Sequence[Popen[Any]], count: Callable[[], int], span_s: float = 0.0) -> float:
    def look() -> tuple[int, float]:
        return count(), sum(time.clock_gettime(clock_of(process)) for process in processes)

    before, before_s = look()
    time.sleep(span_s)
    after, after_s = look()
    if after == before:
        raise RuntimeError("nothing was delivered")
    return (after_s - before_s) / (after - before) * 1e6


def pancakes(subscribers: int, between: bool, span_s: float) -> list[float]:
    """One run of ours, in one agent or between two. Returns µs of processor time for each delivery."""
    reader, writer = os.pipe()
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name, ExitStack() as stack:
        directory = Path(name)
        environment = offer_tasks(directory, _TASKS, {})
        channel, speaker = "[channel.bench]\n", _SPEAKER.format(to="*" if between else "")
        hearers = "".join(_HEARER.format(number, writer, span_s) for number in range(subscribers))
        far = head_of("far", directory) + channel + hearers + ("" if between else speaker)
        stack.callback(os.close, reader)
        hears = agent_process(far, directory, environment, pass_fds=(writer,), until_ready=True)
        processes = [stack.enter_context(hears)]
        os.close(writer)
        if between:
            near = head_of("near", directory, [listening_at(environment, "far", processes[0])]) + channel + speaker
            processes.append(stack.enter_context(agent_process(near, directory, environment, until_ready=True)))
        return [_a_delivery_us(processes, lambda: int(read_report(reader)))]


def rclpy(python: Path, subscribers: int, between: bool, span_s: float) -> list[float]:
    """One run of the peer. Returns the same, of its faster executor."""
    return [min(_rclpy(python, executor, subscribers, between, span_s) for executor in EXECUTORS)]


def _rclpy(python: Path, executor: str, subscribers: int, between: bool, span_s: float) -> float:
    start = partial(peer_process, RCLPY, python, "paced", executor, str(RATE_HZ), variables=ros2_variables())
    with ExitStack() as stack:
        hearer = stack.enter_context(start("0" if between else "1", str(subscribers)))
        processes = [hearer.process]
        if between:
            processes.append(stack.enter_context(start("1", "0")).process)

        def count() -> int:
            hearer.say(count=True)
            return int(hearer.hear_of("count"))

        until_s = time.monotonic() + 30.0
        while not count() and time.monotonic() < until_s:
            time.sleep(0.1)
        time.sleep(SETTLE_S)
        return _a_delivery_us(processes, count, span_s)


def measure(plan: Plan) -> Iterator[Figure | Missing]:
    """Measures everything."""
    try:
        python = python_of(RCLPY)
    except PeerMissing as error:
        yield Missing(RCLPY.name, str(error))
        python = None
    span_s = max(2.0, SPAN_S * plan.scale)
    for between in (False, True):
        for subscribers in SUBSCRIBERS:
            name = f"to {subscribers}, {'between two processes' if between else 'in a process'}"
            figures = [Figure(name, "µs", wanted=WANTED if python else None, least=True)]
            ours = partial(pancakes, subscribers, between, span_s)
            if python is None:
                yield from alone(plan, figures, ours)
            else:
                yield from in_turns(plan, figures, ours, partial(rclpy, python, subscribers, between, span_s))
