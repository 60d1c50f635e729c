"""How the cost grows with the agents of a fleet in virtual time, from 10 to 1,000 in one process.

Each agent has its four services, a task that ticks once a second, a few links, and beacons and heartbeats every 5 s, as
the user of a large fleet would choose. Each fleet has a process of its own. There is no baseline: what an agent costs
should stay the same.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import time
from collections.abc import Iterator
from functools import partial

import psutil
from benchmarks.agent_process import PYTHON_PATH, process, read_report, usual_environment
from benchmarks.figure import Figure, Plan, alone
from benchmarks.idle_tasks import Idle

from pancakes.config import parse
from pancakes.simulation.fleet import Fleet

TITLE = "how the cost grows with the agents of a fleet in virtual time"
BESIDE = ""
AGENTS = (10, 100, 1_000)
LINKS = 4
SETTLE_S = 40.0
"""Virtual time until all have found their links."""
SPAN_S = 30.0
FIRST_PORT = 7400


def _config(number: int) -> str:
    peers = f'peers = ["tcp://127.0.0.1:{FIRST_PORT}"]' if number else ""
    return f"""
schema = 1
[agent]
name = "agent{number}"
listen = "tcp://127.0.0.1:{FIRST_PORT + number}"
links = {LINKS}
{peers}
[clock]
join_s = 0
[service.network]
settings = {{ discovery_hz = 0.2, heartbeat_s = 5.0 }}
[service.log]
settings = {{ console = false }}
[task.Idle]
type = "bench.Idle"
"""


def run(agents: int, span_s: float) -> list[float]:
    """Runs a fleet in this process.

    Returns:
        Of each agent: ms to start, KiB, and µs of processor time for each second of virtual time; and how many times
        faster than real time the fleet ran.
    """
    gc.collect()
    before, began_s = psutil.Process().memory_info().rss, time.process_time()
    fleet = Fleet(1, classes={"bench.Idle": Idle}, channels=("none",))
    for number in range(agents):
        fleet.start_config(parse(_config(number), f"agent{number}"), settle=False, probe=False)
    fleet.run_for(1.0)
    start_s = time.process_time() - began_s
    fleet.run_for(SETTLE_S)
    gc.collect()
    memory = psutil.Process().memory_info().rss - before
    began_s = time.process_time()
    fleet.run_for(span_s)
    used_s = time.process_time() - began_s
    fleet.close()
    return [start_s / agents * 1e3, memory / agents / 1024, used_s / agents / span_s * 1e6, span_s / used_s]


def _in_new_process(agents: int, span_s: float) -> list[float]:
    reader, writer = os.pipe()
    command = [sys.executable, "-m", "benchmarks.virtual_fleet", str(agents), str(span_s), str(writer)]
    environment = {**usual_environment(), "PYTHONPATH": os.pathsep.join(PYTHON_PATH)}
    with process(command, environment, pass_fds=(writer,)):
        os.close(writer)
        try:
            figures: list[float] = read_report(reader, patience_s=600.0)
            return figures
        finally:
            os.close(reader)


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    for agents in AGENTS:
        figures = [
            Figure(f"{agents:,} agents: CPU of the start of one", "ms", least=True),
            Figure(f"{agents:,} agents: memory of one", "KiB"),
            Figure(f"{agents:,} agents: CPU of one, a second", "µs", least=True),
            Figure(f"{agents:,} agents: times real time", "x", "min"),
        ]
        span_s = max(10.0, SPAN_S * plan.scale)
        # The largest takes minutes, and its noise is small.
        rounds = plan if agents < AGENTS[-1] else Plan(rounds=1)
        yield from alone(rounds, figures, partial(_in_new_process, agents, span_s))


if __name__ == "__main__":
    report = run(int(sys.argv[1]), float(sys.argv[2]))
    os.write(int(sys.argv[3]), f"{json.dumps(report)}\n".encode())
