"""What it costs the agents of the demo to be recorded, and to be watched by an open page.

Everything is measured on one live fleet, as `pancakes demo encirclement` runs it (five times real time), in spans that
take turns: with the observer, and without. The baseline is the same agents, unobserved. Processor time is that of the
agents' processes; lateness is that of a task on each agent that is ticked 200 times a second of host time.

The p99 of a span rests on its two dozen latest ticks, and differs twofold between two spans in which nothing is
different. So percentiles are those of all ticks of a side together. What else the machine does makes ticks late as
well: only that half of the rounds counts in which all other processes together were busy the least, on whichever side.
The spread that is shown is that of the single spans of all rounds.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import psutil
from benchmarks.agent_process import offer_tasks, process
from benchmarks.figure import Figure, Plan, in_turns_of_all

from pancakes.client import Client
from pancakes.control import Begin, Configure, Describe, Start, Stop
from pancakes.errors import PancakesError
from pancakes.launch.ports import claim_ports
from pancakes.web.feed import Feed
from pancakes.web.watch import Watch

TITLE = "being observed, the agents of the demo; bare: the same, unobserved"
AGENTS = ("world", "agent1", "agent2", "sensor")
SPEED = 5.0
SPAN_S = 3.0
TICKS_HZ = 200.0
WANTED = 1.1
SHOWN = (("processor time a second", None), ("lateness p50", 0.5), ("lateness p99", 0.99))
"""What is told of each observer, and which percentile of the lateness it is."""
ROUNDS = 13
"""So many rounds at least: with fewer, the p99 is not sure to 10 % either."""
SETTLE_S = 1.0
"""So long after something was switched nothing is measured."""
READY_S = 30.0
RECORDER, STEADY = "log/Recorder", "client/Steady"
CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "encirclement"


@dataclass(frozen=True)
class Span:
    """What was measured for a while.

    Attributes:
        busy_ms: the agents' processor time for each second.
        late_us: how late each tick was.
        others_ms: the processor time of all other processes for each second.
    """

    busy_ms: float
    late_us: list[int]
    others_ms: float

    def value(self, share: float | None) -> float:
        """Returns a percentile of the lateness, or the processor time where none is asked for."""
        return self.busy_ms if share is None else quantile(self.late_us, share)


class Side:
    """One side of all figures: what was measured of it, span by span.

    Args:
        span: measures one.

    Attributes:
        spans: what was measured.
        runs: the values of each span, by figure (see `SHOWN`).
    """

    def __init__(self, span: Callable[[], Span]) -> None:
        self._span = span
        self.spans: list[Span] = []
        self.runs: list[list[float]] = [[] for _ in SHOWN]

    def measure(self) -> list[float]:
        """Measures one span, and returns its values."""
        span = self._span()
        self.spans.append(span)
        return [span.value(share) for _, share in SHOWN]

    def value(self, share: float | None, rounds: list[int]) -> float:
        """Returns the value of some rounds together."""
        spans = [self.spans[number] for number in rounds]
        if share is None:
            return sum(span.busy_ms for span in spans) / len(spans)
        return quantile([late_us for span in spans for late_us in span.late_us], share)


@dataclass
class Quieter(Figure):
    """A figure of that half of the rounds in which the rest of the machine was busy the least.

    Attributes:
        share: which percentile of the lateness; None: the processor time.
        sides: ours and the baseline's.
    """

    share: float | None = None
    sides: tuple[Side, ...] = ()

    @property
    def value(self) -> float:
        return self.sides[0].value(self.share, self.rounds())

    @property
    def baseline(self) -> float:
        return self.sides[1].value(self.share, self.rounds())

    def rounds(self) -> list[int]:
        """Returns the numbers of the rounds that count."""
        others_ms = [
            max(span.others_ms for span in spans) for spans in zip(*(it.spans for it in self.sides), strict=True)
        ]
        return sorted(range(len(others_ms)), key=others_ms.__getitem__)[: (len(others_ms) + 1) // 2]


def quantile(late_us: list[int], share: float) -> float:
    """Returns the value that this share of some ticks stayed below."""
    return float(sorted(late_us)[int(share * len(late_us))])


class Demo:
    """The agents of the demo, as processes.

    Args:
        directory: where their files go.
        client: asks them.
        processes: them.
    """

    def __init__(self, directory: Path, client: Client, processes: dict[str, subprocess.Popen[bytes]]) -> None:
        self.directory = directory
        self.client = client
        self._processes = processes
        self._window = 0

    def ask(self, agent: str, body: Any) -> Any:
        """Asks an agent for something, and returns what it answers."""
        reply = self.client.request(agent, body, READY_S)
        if not reply.ok:
            raise RuntimeError(f"{agent} refuses {body}: {reply.reason}")
        return reply.result

    def span(self, duration_s: float) -> Span:
        """Measures for a while."""
        self._mark()
        before_s, all_before_s = self._processor_s(), _machine_s()
        begun_s = time.monotonic()
        time.sleep(duration_s)
        used_s, all_used_s = self._processor_s() - before_s, _machine_s() - all_before_s
        took_s = time.monotonic() - begun_s
        self._mark()
        late_us = [one_us for agent in AGENTS for one_us in self._ticks(agent)]
        if len(late_us) < 0.5 * len(AGENTS) * TICKS_HZ * duration_s:
            raise RuntimeError(f"only {len(late_us)} ticks came in {duration_s:g} s")
        return Span(1000 * used_s / took_s, late_us, 1000 * max(0.0, all_used_s - used_s) / took_s)

    def _mark(self) -> None:
        self._window += 1
        for agent in AGENTS:
            self.ask(agent, Configure(STEADY, {"window": self._window}))

    def _ticks(self, agent: str) -> list[int]:
        state = self.ask(agent, Describe(STEADY, state=True))["state"]
        if state["window"] != self._window:
            raise RuntimeError(f"{agent} tells the ticks of another span")
        return list(state["late_us"])

    def _processor_s(self) -> float:
        # Of another process, to the nanosecond: how Linux builds the number of such a clock (clock_getcpuclockid).
        return sum(time.clock_gettime((~one.pid << 3) | 2) for one in self._processes.values())


@contextmanager
def running_demo() -> Iterator[Demo]:
    """Runs the agents of the demo; their batteries last, so that all spans are alike."""
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name, ExitStack() as stack:
        directory = Path(name)
        environment = dict(offer_tasks(directory / "python"))
        files = {}
        for agent in AGENTS:
            text = (CONFIGS / f"{agent}.toml").read_text()
            text += '\n[task.Steady]\ntype = "bench.Steady"\n'
            files[agent] = directory / f"{agent}.toml"
            files[agent].write_text(text)
        claim, moved = claim_ports(files)
        if claim is not None:
            stack.callback(claim.release)
        processes = {}
        for agent, path in files.items():
            sets = [
                f'agent.fleet="bench-{os.getpid()}"',
                f'agent.state_dir="{directory}/state-{agent}"',
                f"clock.speed={SPEED}",
                "service.log.settings.console=false",
                *moved.get(agent, ()),
            ]
            if agent == "world":
                sets.append(f'task.Trajectory.settings.path="{directory}/trajectory.csv"')
                sets += [f"task.World.settings.robots.agent{n}.battery.capacity_j=1e6" for n in (1, 2)]
            command = [str(Path(sys.executable).with_name("pancakes-agent")), "--config", str(path)]
            command += [part for one in sets for part in ("--set", one)]
            processes[agent] = stack.enter_context(process(command, environment))
        address = next((one.split('"')[1] for one in moved.get("world", ()) if one.startswith("agent.listen=")), "")
        client = stack.enter_context(_client(address or "tcp://127.0.0.1:7400"))
        for agent in AGENTS:
            client.request(agent, Begin(0.5), READY_S)
        demo = Demo(directory, client, processes)
        time.sleep(3 * SETTLE_S)
        yield demo


@contextmanager
def _client(address: str) -> Iterator[Client]:
    """Waits until the whole fleet is there and ready."""
    until_s = time.monotonic() + READY_S
    while True:
        with Client((address,), 2.0) as client:
            try:
                found = client.survey().agents
            except PancakesError:  # nobody answers yet
                found = []
            if sum(row["ready"] for row in found) == len(AGENTS):
                yield client
                return
        if time.monotonic() > until_s:
            raise TimeoutError(f"only {len(found)} agents were ready within {READY_S:g} s")
        time.sleep(0.2)


def recorded(demo: Demo, span_s: float) -> Span:
    """One span in which all agents record everything."""
    for agent in AGENTS:
        demo.ask(agent, Start(RECORDER, {"path": f"{demo.directory}/{{agent}}.mcap"}))
    time.sleep(SETTLE_S)
    try:
        return demo.span(span_s)
    finally:
        for agent in AGENTS:
            demo.ask(agent, Stop(RECORDER))


def watched(demo: Demo, span_s: float) -> Span:
    """One span in which a page is open: what a page shows is followed, whoever looks at it and however fast."""
    begun_s = time.monotonic()
    addresses = [door.agents()[0].listen for door in demo.client.doors()]
    watch = Watch(Feed(lambda: time.monotonic() - begun_s), addresses)
    watch.start()
    time.sleep(SETTLE_S)
    try:
        return demo.span(span_s)
    finally:
        watch.close()


def unobserved(demo: Demo, span_s: float) -> Span:
    """One span in which nobody looks."""
    time.sleep(SETTLE_S)
    return demo.span(span_s)


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    span_s = max(2.0, SPAN_S * plan.scale)
    if plan.scale == 1.0:
        plan = replace(plan, rounds=max(ROUNDS, plan.rounds))
    observers: tuple[tuple[str, Callable[[Demo, float], Span]], ...] = (
        ("recording everything", recorded),
        ("one open page", watched),
    )
    with running_demo() as demo:
        bare = Side(lambda: unobserved(demo, span_s))
        sides: list[Side] = [bare]
        figures: list[Figure] = []
        for name, observer in observers:
            observer(demo, 2.0)  # the first time modules are imported
            ours = Side(lambda observer=observer: observer(demo, span_s))  # type: ignore[misc]
            sides.append(ours)
            for number, (what, share) in enumerate(SHOWN):
                figure = Quieter(f"{name}: {what}", "ms" if share is None else "µs", wanted=WANTED, share=share)
                figure.runs, figure.bare_runs, figure.sides = ours.runs[number], bare.runs[number], (ours, bare)
                figures.append(figure)
        yield from in_turns_of_all(plan, [(side.measure, side.runs) for side in sides], figures)


def _machine_s() -> float:
    """Returns how long the machine's processors have been busy so far, all together."""
    busy = psutil.cpu_times()
    return float(sum(busy) - busy.idle - getattr(busy, "iowait", 0.0) - getattr(busy, "guest", 0.0))
