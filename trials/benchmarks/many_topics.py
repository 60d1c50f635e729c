"""Five agents with fifty topics each, at 100 Hz, as robots with many sensors have them: the processor time of all.

A topic is a task with a channel of its own, which publishes to the next agent in each tick; there one task listens to
all fifty. So 25,000 packets go from one process to another each second. The agents are processes of this machine, in a
full mesh over TCP. There is nothing bare beside them.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from benchmarks.agent_process import agent_process, head_of, listening_at, offer_tasks, read_report
from benchmarks.figure import Figure, Plan, alone
from benchmarks.start_up import clock_of

from pancakes.devices import Pose
from pancakes.packet import Packet
from pancakes.task import Task, Tick, every

TITLE = "five agents with fifty topics each, at 100 Hz"
BESIDE = ""
AGENTS = 5
TOPICS = 50
RATE_HZ = 100.0
SETTLE_S = 2.0
LOOK_S = 0.05
SPAN_S = 5.0


class Topic(Task):
    """Publishes to another agent, in each tick."""

    @dataclass
    class Settings:
        channel: str
        to: str

    @every(hz=RATE_HZ)
    def tick(self, tick: Tick) -> None:
        """Publishes one pose."""
        self.publish(self.settings.channel, Pose(1.0, 2.0, 0.5), to=self.settings.to)


class Listener(Task):
    """Counts the poses of all topics; tells how many came before a span, and by its end.

    It begins when a file is there.
    """

    @dataclass
    class Settings:
        report_fd: int
        begin: str
        span_s: float

    def on_start(self) -> None:
        self.count = 0
        for number in range(TOPICS):
            self.subscribe(f"topic{number}", Pose, self.take)
        self.look()

    def look(self) -> None:
        """Looks for the file, time and again."""
        if not Path(self.settings.begin).exists():
            self.after_host(LOOK_S, self.look)
            return
        self.report()
        self.after_host(self.settings.span_s, self.report)

    def take(self, packet: Packet) -> None:
        """Counts one."""
        self.count += 1

    def report(self) -> None:
        """Tells it now."""
        os.write(self.settings.report_fd, f"{json.dumps(self.count)}\n".encode())


_TASKS = {f"bench.{name}": f"benchmarks.many_topics:{name}" for name in ("Topic", "Listener")}
_TOPIC = """
[channel.topic{number}]
[task.Topic{number}]
type = "bench.Topic"
settings = {{ channel = "topic{number}", to = "{to}" }}
"""
_LISTENER = """
[task.Listener]
type = "bench.Listener"
settings = {{ report_fd = {report_fd}, begin = "{begin}", span_s = {span_s} }}
"""


def run(span_s: float) -> list[float]:
    """One run. Returns the cores that all agents take, µs for each packet, and the share of the packets that came."""
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name, ExitStack() as stack:
        directory = Path(name)
        environment = offer_tasks(directory, _TASKS, {})
        processes, readers, begin = [], [], directory / "begin"
        peers: list[str] = []
        for number in range(AGENTS):
            reader, writer = os.pipe()
            stack.callback(os.close, reader)
            readers.append(reader)
            to = f"a{(number + 1) % AGENTS}"
            config = head_of(f"a{number}", directory, peers)
            config += _LISTENER.format(report_fd=writer, begin=begin, span_s=span_s)
            config += "".join(_TOPIC.format(number=topic, to=to) for topic in range(TOPICS))
            agent = agent_process(config, directory, environment, pass_fds=(writer,), until_ready=True)
            processes.append(stack.enter_context(agent))
            os.close(writer)
            peers = peers or [listening_at(environment, "a0", processes[0])]

        def look() -> tuple[float, float, int]:
            counts = [int(read_report(reader)) for reader in readers]
            return time.monotonic(), sum(time.clock_gettime(clock_of(process)) for process in processes), sum(counts)

        time.sleep(SETTLE_S)
        begin.touch()
        before, after = look(), look()
        took_s, used_s, came = (late - early for early, late in zip(before, after, strict=True))
    return [used_s / took_s, used_s / came * 1e6, 100.0 * came / (took_s * AGENTS * TOPICS * RATE_HZ)]


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    figures = [
        Figure("CPU of all five agents", "cores", least=True),
        Figure("CPU of a packet, with its tick, both ends", "µs", least=True),
        Figure("packets that came, of 25,000 a second", "%", "min"),
    ]
    yield from alone(plan, figures, partial(run, max(2.0, SPAN_S * plan.scale)))
