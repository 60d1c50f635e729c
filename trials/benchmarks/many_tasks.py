"""Ten thousand tasks in one agent: how long until all of them run, and how much memory they take.

The baseline is as many empty pykka actors as they come, each with its thread. Each side is a process of its own, and
what that had before it began is taken off its memory.

The tasks have two subscriptions on two channels, a timer, settings and state. They come in the two ways in which a user
has tasks: a service of one's own brings them, and begins to count as it starts; these have no records on disk. Or a
configuration names them, which has to be read, and each is in the journal before it runs: what such an agent takes
longer, and more, than one with a single task.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from subprocess import Popen

import psutil
import pykka
from benchmarks.agent_process import (
    INSECURE,
    PYTHON_PATH,
    agent_process,
    offer_tasks,
    process,
    read_report,
    usual_environment,
)
from benchmarks.figure import Figure, Plan, in_turns

from pancakes.devices import Pose
from pancakes.packet import SYSTEM, Packet
from pancakes.service import Service
from pancakes.supervision.service_core import ServiceCore
from pancakes.supervision.slots import Slot
from pancakes.task import Task, TaskSpec, Tick, every, on

TITLE = "many tasks in one agent, beside as many empty pykka actors"
TASKS = 10_000
CONFIGURED_TASKS = 1_000
"""Of those that a configuration names: nobody writes down ten thousand."""
SETTLE_S = 0.5
"""How long they run before their memory is looked at."""


class Small(Task):
    """A task that has some of everything."""

    @dataclass
    class Settings:
        gain: float = 1.0

    @dataclass
    class State:
        heard: int = 0

    @on("bench", Pose)
    def take(self, packet: Packet) -> None:
        """Counts one packet."""
        self.state.heard += 1

    @on(SYSTEM, Pose, queue="latest")
    def steer(self, packet: Packet) -> None:
        """Takes a pose."""

    @every(period_s=10.0)
    def tick(self, tick: Tick) -> None:
        """Takes a tick."""


class Crowd(ServiceCore, Service):
    """A user's service that brings a crowd of tasks, and tells on a file descriptor when all of them run."""

    __module__ = "pancakes"  # its names are Pancakes' own

    @dataclass
    class Settings:
        tasks: int
        report_fd: int
        rate_hz: float = 0.1

    def on_start(self) -> None:
        self.before_mib, self.began_s = _memory_mib(), time.perf_counter()
        self.left = self.settings.tasks

    def own_tasks(self) -> Sequence[TaskSpec]:
        settings, rate_hz = {"gain": 2.0}, self.settings.rate_hz
        return [
            TaskSpec(f"Small{number}", Small, settings=settings, rate_hz=rate_hz)
            for number in range(self.settings.tasks)
        ]

    def task_running(self, slot: Slot) -> None:
        super().task_running(slot)
        self.left -= 1
        if not self.left:
            took_ms = (time.perf_counter() - self.began_s) * 1e3
            self.after_host(SETTLE_S, lambda: self.report(took_ms))

    def report(self, took_ms: float) -> None:
        """Tells how long it took, and how much memory."""
        _tell(self.settings.report_fd, took_ms, _memory_mib() - self.before_mib)


def _memory_mib() -> float:
    return float(psutil.Process().memory_info().rss / 2**20)


def _tell(handle: int, start_ms: float, memory_mib: float) -> None:
    os.write(handle, (json.dumps([start_ms, memory_mib]) + "\n").encode())


_CONFIG = """
schema = 1
[agent]
name = "crowded"
listen = "tcp://127.0.0.1:0"
state_dir = "{directory}/state"
[channel.bench]
[service.log]
settings = {{ console = false }}
"""


@contextmanager
def crowded(tasks: int, rate_hz: float = 0.1) -> Iterator[tuple[Popen[bytes], list[float]]]:
    """Runs an agent whose service brings tasks; gives its process, and what `of_a_service` returns."""
    reader, writer = os.pipe()
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name:
        settings = f"settings = {{ tasks = {tasks}, report_fd = {writer}, rate_hz = {rate_hz} }}"
        config = _CONFIG.format(directory=name) + f'[service.crowd]\ntype = "bench.Crowd"\n{settings}{INSECURE}'
        with agent_process(config, Path(name), offer_tasks(Path(name)), pass_fds=(writer,)) as started:
            yield started, _report(reader, writer)


def of_a_service(tasks: int) -> list[float]:
    """One run of a service that brings tasks. Returns ms from its start until all run, and their memory in MiB."""
    with crowded(tasks) as (_, report):
        return report


def configured(tasks: int) -> list[float]:
    """One run of an agent whose configuration names tasks. Returns what they take: more than one with a single task.

    So what the module of these tasks imports is not taken for theirs.
    """
    with_tasks, with_one = _ready(tasks + 1), _ready(1)
    return [more - less for more, less in zip(with_tasks, with_one, strict=True)]


def _ready(tasks: int) -> list[float]:
    """Returns ms from the command until the agent is ready, and its memory in MiB."""
    table = '[task.Small{number}]\ntype = "bench.Small"\nsettings = {{ gain = 2.0 }}\n'
    tables = "".join(table.format(number=number) for number in range(tasks))
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name:
        environment = offer_tasks(Path(name))
        config = _CONFIG.format(directory=name) + tables + INSECURE
        began_s = time.perf_counter()
        with agent_process(config, Path(name), environment, until_ready=True) as started:
            took_ms = (time.perf_counter() - began_s) * 1e3
            time.sleep(SETTLE_S)
            return [took_ms, psutil.Process(started.pid).memory_info().rss / 2**20]


def bare_actors(tasks: int) -> list[float]:
    """One run of the baseline. Returns ms until all actors run, and their memory in MiB."""
    reader, writer = os.pipe()
    command = [sys.executable, "-m", "benchmarks.many_tasks", str(tasks), str(writer)]
    environment = {**usual_environment(), "PYTHONPATH": os.pathsep.join(PYTHON_PATH)}
    with process(command, environment, pass_fds=(writer,)):
        return _report(reader, writer)


def _report(reader: int, writer: int) -> list[float]:
    os.close(writer)
    try:
        start_ms, memory_mib = read_report(reader)
        return [start_ms, memory_mib]
    finally:
        os.close(reader)


def _run_bare_actors(tasks: int, handle: int) -> None:
    """Starts empty actors in this process."""
    before_mib, began_s = _memory_mib(), time.perf_counter()
    refs = [pykka.ThreadingActor.start() for _ in range(tasks)]
    took_ms = (time.perf_counter() - began_s) * 1e3
    time.sleep(SETTLE_S)
    _tell(handle, took_ms, _memory_mib() - before_mib)
    for ref in refs:
        ref.stop(block=False)


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    for ours, what, tasks, most_start, most_memory in (
        (of_a_service, "of a service", TASKS, 0.20, 0.35),
        (configured, "configured, on disk", CONFIGURED_TASKS, 5.0, None),
    ):
        number = plan.share(tasks)
        # Threads cost the more the more there are.
        start, memory = (most_start, most_memory) if number == tasks else (None, None)
        name = f"{number:,} {what}"
        yield from in_turns(
            plan,
            [Figure(f"{name}: start", "ms", wanted=start), Figure(f"{name}: memory", "MiB", wanted=memory)],
            partial(ours, number),
            partial(bare_actors, number),
        )


if __name__ == "__main__":
    _run_bare_actors(int(sys.argv[1]), int(sys.argv[2]))
