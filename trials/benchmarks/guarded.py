"""What guarded tasks cost: a hundred of them over five agents, beside the same tasks unguarded.

Each task has 1 KiB of state that changes twice a second, three guardians, and the usual lease and checkpoints. Five
agents on one machine write to one disk. What each writes is counted before the disk makes blocks of it.
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

import psutil
from benchmarks.agent_process import agent_process, offer_tasks
from benchmarks.figure import Figure, Plan, in_turns

from pancakes.client import Client, Target
from pancakes.control import Guarding
from pancakes.task import Task, Tick, every

TITLE = "a hundred guarded tasks over five agents, beside the same tasks unguarded"
BESIDE = "unguarded"
AGENTS = ("a", "b", "c", "d", "e")
TASKS = 100
STATE_BYTES = 1024
MEASURED_S = 10.0
ANSWERED_S = 1.0
"""So long after the agents were asked what they have written: what the answers cost is not the tasks'."""
GUARDED_S = 30.0
"""So long it may take until each task has its guardians."""


class Kept(Task):
    """A task whose whole state changes twice a second."""

    @dataclass
    class State:
        load: bytes = b""

    def on_start(self) -> None:
        self.state.load = bytes(STATE_BYTES)

    @every(hz=2)
    def change(self, tick: Tick) -> None:
        """Changes it."""
        self.state.load = os.urandom(STATE_BYTES)


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures all figures."""
    figures = [
        Figure("share of a core of an agent", "%", wanted=3.0, absolute=True),
        Figure("written by an agent", "MB an hour"),
        Figure("fsyncs of an agent", "an hour"),
        Figure("sent and received by an agent", "kB/s", wanted=200.0, absolute=True),
    ]
    tasks = plan.share(TASKS) // len(AGENTS) * len(AGENTS) or len(AGENTS)
    yield from in_turns(plan, figures, partial(_run, tasks, "guard = { copies = 3 }\n"), partial(_run, tasks, ""))


def _run(tasks: int, guard: str) -> list[float]:
    with tempfile.TemporaryDirectory() as text, ExitStack() as held:
        directory = Path(text)
        environment = offer_tasks(directory)
        processes = []
        for name in AGENTS:
            own = "".join(
                f'[task.{name}{number}]\ntype = "bench.Kept"\n{guard}' for number in range(tasks // len(AGENTS))
            )
            started = agent_process(_config(name, directory) + own, directory, environment, until_ready=True)
            processes.append(psutil.Process(held.enter_context(started).pid))
        addresses = tuple(f"local://{directory}/{name}" for name in AGENTS)
        with Client(Target(addresses), 5.0) as client:
            if guard:
                _wait_for_guardians(client, tasks)
            told_at, told = time.monotonic(), _told(client)
            time.sleep(ANSWERED_S)
            used_at, used = time.monotonic(), _used(processes)
            time.sleep(MEASURED_S)
            shares = [(_used(processes) - used) / (time.monotonic() - used_at)]
            told_s = time.monotonic() - told_at
            shares += [(now - then) / told_s for now, then in zip(_told(client), told, strict=True)]
        units = (100.0, 3600e-6, 3600.0, 1e-3)
        return [share * unit / len(AGENTS) for share, unit in zip(shares, units, strict=True)]


def _config(name: str, directory: Path) -> str:
    peers = [f"local://{directory}/{other}" for other in AGENTS if other != name]
    return f"""
schema = 1
[agent]
name = "{name}"
listen = "local://{directory}/{name}"
peers = {json.dumps(peers)}
state_dir = "{directory}/state-{name}"
[service.log]
settings = {{ console = false }}
"""


def _wait_for_guardians(client: Client, tasks: int) -> None:
    until_s = time.monotonic() + GUARDED_S
    while True:
        rows = [row for _, reply in client.request_all(Guarding()).replies for row in reply.result]
        if sum(len(row.get("guardians", ())) == 3 for row in rows) == tasks:
            return
        if time.monotonic() > until_s:
            raise TimeoutError(f"not all of {tasks} tasks were guarded within {GUARDED_S:g} s")
        time.sleep(0.5)


def _used(processes: list[psutil.Process]) -> float:
    times = [process.cpu_times() for process in processes]
    return sum(it.user + it.system for it in times)


def _told(client: Client) -> tuple[float, float, float]:
    """Returns what all agents have written, how often they have waited for the disk, and what went over links."""
    agents = client.describe().agents
    peers = [peer for agent in agents for peer in agent["mesh"]["peers"] if peer["name"] in AGENTS]
    disks = [agent["disk"] for agent in agents]
    return (
        float(sum(disk["written_bytes"] for disk in disks)),
        float(sum(disk["syncs"] for disk in disks)),
        float(sum(peer["bytes_in"] + peer["bytes_out"] for peer in peers)),
    )
