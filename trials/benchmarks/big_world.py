"""What a simulated world of many robots costs its process, at real time.

The world is an agent with the task `sim.world`, as anybody starts it; the robots move, and their devices, which are
another process and not counted, ask and command them over the hardware bus. There is nothing bare beside it; what the
simulation takes by itself, without agent and bus, is a figure of its own.
"""

from __future__ import annotations

import math
import os
import socket
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from random import Random

import msgspec
import psutil
from benchmarks.agent_process import INSECURE, agent_process, offer_tasks, process, read_report
from benchmarks.bus_load import GOOD_FOR_S, RATE_HZ, wheels_mps
from benchmarks.figure import Figure, Plan, alone

from pancakes.sim.robot_models import Wheels
from pancakes.sim.world import STEP_S, Physics, World

TITLE = "a world of Khepera III that move, 9 infrared sensors and wheels each asked and commanded at 10 Hz"
BESIDE = ""
WANTED_PERCENT = 40.0
"""Of one core, for the usual number of robots."""
USUAL = 100
CASES = (10, USUAL, 300, 1000)
DURATION_S = 10.0
APART_M = 1.1
"""Between the places where the robots start: they go in circles of less, and now and then meet."""

_CONFIG = """
schema = 1
[agent]
name = "world"
role = "environment"
listen = "tcp://127.0.0.1:0"
state_dir = "{directory}/state"
[service.log]
settings = {{ console = false }}
[task.World]
type = "sim.world"
[task.World.settings]
bus = "tcp://127.0.0.1:{port}"
[task.World.settings.arena]
width_m = {width_m}
height_m = {height_m}
"""


def _config(directory: str, port: int, robots: int) -> str:
    columns = math.ceil(math.sqrt(robots))
    rows = math.ceil(robots / columns)
    lines = [_CONFIG.format(directory=directory, port=port, width_m=columns * APART_M, height_m=rows * APART_M)]
    for number in range(robots):
        x_m = (number % columns - 0.5 * (columns - 1)) * APART_M
        y_m = (number // columns - 0.5 * (rows - 1)) * APART_M
        lines.append(f"[task.World.settings.robots.robot{number}]\nx_m = {x_m:.3f}\ny_m = {y_m:.3f}\n")
        lines.append(f"theta_rad = {number % 6}")
    return "\n".join([*lines, INSECURE])


def _free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        port: int = taken.getsockname()[1]
        return port


def world(robots: int, duration_s: float) -> list[float]:
    """One run. Returns the processor's share in percent, and how long readings took, p50 and p99 in ms."""
    reader, writer = os.pipe()
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name:
        environment = offer_tasks(Path(name))
        port = _free_port()
        command = [sys.executable, "-m", "benchmarks.bus_load", "127.0.0.1", str(port), str(robots), str(duration_s)]
        with agent_process(_config(name, port, robots), Path(name), environment, until_ready=True) as started:
            with process([*command, str(writer)], environment, pass_fds=(writer,)):
                os.close(writer)
                seen = psutil.Process(started.pid)
                read_report(reader)
                before = seen.cpu_times()
                report = read_report(reader)
                after = seen.cpu_times()
    os.close(reader)
    if report["answered"] < 0.95 * report["asked"] and robots <= USUAL:
        raise RuntimeError(f"only {report['answered']} of {report['asked']} readings came in {duration_s} s: {report}")
    used_s = after.user + after.system - before.user - before.system
    return [100.0 * used_s / duration_s, report["answered"] / duration_s, report["p50_ms"], report["p99_ms"]]


def simulation_alone(robots: int, duration_s: float) -> float:
    """One run of the simulation in this process, in which the robots are asked and commanded as often.

    Returns:
        The share of a core that it takes at real time, in percent.
    """
    table = tomllib.loads(_config("", 0, robots))["task"]["World"]["settings"]
    simulation = Physics(msgspec.convert(table, World.Settings), Random(1))
    turns = round(1.0 / RATE_HZ / STEP_S)  # the robots are spread over so many steps
    began_s = time.process_time()
    for step in range(round(duration_s / STEP_S)):
        simulation.advance(step * STEP_S)
        for number in range(step % turns, robots, turns):
            simulation.sample(f"robot{number}", "ir")
        for number in range((step + turns // 2) % turns, robots, turns):
            simulation.drive(f"robot{number}", Wheels(*wheels_mps(number)), GOOD_FOR_S, "")
    return 100.0 * (time.process_time() - began_s) / duration_s


def with_and_without_agents(robots: int, duration_s: float) -> list[float]:
    """Measures the whole world, and then the simulation alone."""
    return [*world(robots, duration_s), simulation_alone(robots, duration_s)]


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    duration_s = max(2.0, DURATION_S * plan.scale)
    for robots in CASES:
        wanted = WANTED_PERCENT if robots == USUAL else None
        figures = [
            Figure(f"{robots} robots: processor", "%", wanted=wanted, absolute=True),
            Figure(f"{robots} robots: readings answered", "1/s"),
            Figure(f"{robots} robots: a reading takes p50", "ms"),
            Figure(f"{robots} robots: a reading takes p99", "ms"),
            Figure(f"{robots} robots: the simulation alone", "%"),
        ]
        yield from alone(
            plan if robots == USUAL else Plan(rounds=1),  # the others only show how the cost grows
            figures,
            partial(with_and_without_agents, robots, duration_s),
        )
