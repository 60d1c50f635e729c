"""The short form for CI: the processor time of a few steps, which must stay near what `cpu.json` says.

Only ratios are compared. Each step is divided by something bare in the same run, on the same machine and Python, in
turns with it; of both the smallest of several short rounds counts, as other work on the machine only adds. A step that
seems too slow is measured more often before it counts as that.
"""

from __future__ import annotations

import gc
import json
import tracemalloc
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import msgspec
import pykka
from benchmarks import cpu, start_up, two_processes
from benchmarks.figure import Figure
from benchmarks.local_agent import local_agent
from benchmarks.many_tasks import Small

FILE = Path(__file__).with_name("cpu.json")
LIMIT = 1.5
"""A step fails if its ratio is as many times what the file says."""
ROUNDS, MOST_ROUNDS = 5, 15
DELIVERIES = 10_000
TURNS = 50
TICKING_S = 0.3
PACED = 500
PACKETS = 5_000
WEIGHED_TASKS = 100


class Step(msgspec.Struct, frozen=True):
    """One step, and what is bare beside it.

    Attributes:
        name: what it is.
        unit: of both sides.
        ours: one short round of it.
        bare: one of what is bare.
        rounds: how often each is measured at first.
    """

    name: str
    unit: str
    ours: Callable[[], float]
    bare: Callable[[], float]
    rounds: int = ROUNDS


def _first(measure: Callable[[], Sequence[float]], at: int = 0) -> Callable[[], float]:
    return lambda: measure()[at]


def _bytes_of_tasks(tasks: int) -> float:
    table = 'type = "bench.Small"\nsettings = { gain = 2.0 }'
    with local_agent({"bench.Small": Small}, {f"Small{number}": table for number in range(tasks)}, ("bench",)):
        gc.collect()
        return tracemalloc.get_traced_memory()[0]


def bytes_a_task() -> float:
    """Returns the bytes that Python has for a task of a configuration: the same two agents, one with more tasks."""
    tracemalloc.start()
    try:
        _bytes_of_tasks(1)
        before = _bytes_of_tasks(1)
        return (_bytes_of_tasks(1 + WEIGHED_TASKS) - before) / WEIGHED_TASKS
    finally:
        tracemalloc.stop()


def bytes_an_actor() -> float:
    """Returns the bytes that Python has for an empty stock actor."""
    tracemalloc.start()
    try:
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        actors = [pykka.ThreadingActor.start() for _ in range(WEIGHED_TASKS)]
        gc.collect()
        return (tracemalloc.get_traced_memory()[0] - before) / WEIGHED_TASKS
    finally:
        tracemalloc.stop()
        for actor in actors:
            actor.stop()


def _packet_us(side: Callable[..., dict[str, list[float]]]) -> float:
    return sum(side(64, 20, PACKETS)["cpu_us"])


def steps() -> list[Step]:
    """Returns all steps."""
    tell, tick, paced = (
        _first(bare) for bare in (cpu.bare_tell_ns, cpu.bare_tick_ns, partial(cpu.bare_paced_us, PACED))
    )
    return [
        Step("a delivery to 1", "ns", _first(partial(cpu.delivery_ns, 1, DELIVERIES)), tell),
        Step("a delivery to 100", "ns", _first(partial(cpu.delivery_ns, 100, DELIVERIES // 50)), tell),
        Step("a turn of one packet, with its delivery", "ns", _first(partial(cpu.turn_ns, TURNS)), tell),
        Step("a reading from a driver's thread", "ns", _first(partial(cpu.driver_ns, DELIVERIES)), tell),
        Step("a tick", "ns", _first(partial(cpu.tick_ns, TICKING_S)), tick),
        Step("a packet at 1 kHz", "µs", _first(partial(cpu.paced_us, PACED)), paced),
        Step(
            "a packet to another process, both sides",
            "µs",
            partial(_packet_us, two_processes.pancakes),
            partial(_packet_us, two_processes.bare_sockets),
        ),
        Step("the start of an agent", "ms", _first(start_up.pancakes, 1), _first(start_up.bare_python, 1), 3),
        Step("modules of ours at the start", "", _first(start_up.pancakes, 4), _first(start_up.bare_python, 3), 1),
        Step("a task's memory", "bytes", bytes_a_task, bytes_an_actor, 1),
    ]


def measured(step: Step, limit: float | None, most_rounds: int = MOST_ROUNDS) -> Figure:
    """Measures a step, in turns with what is bare, until it is within a limit; returns its figure."""
    figure = Figure(step.name, step.unit, wanted=limit, least=True)
    for number in range(max(step.rounds, most_rounds)):
        if number >= step.rounds and not figure.is_missed:
            break
        sides = [(figure.runs, step.ours), (figure.bare_runs, step.bare)]
        for runs, measure in reversed(sides) if number % 2 else sides:
            runs.append(measure())
    return figure


def known() -> dict[str, float]:
    """Returns the ratio of each step that the file says."""
    ratios: dict[str, float] = json.loads(FILE.read_text())
    return ratios


def write(figures: Sequence[Figure]) -> None:
    """Writes the ratios into the file."""
    ratios = {figure.name: round(figure.ratio, 3) for figure in figures if figure.ratio is not None}
    FILE.write_text(json.dumps(ratios, indent=4) + "\n")
