"""What it costs the agents of the demo to be recorded, and to be watched by an open page.

Everything is measured on two live fleets, as `pancakes demo encirclement` runs them (five times real time), at the same
time: one is observed and the other is not, then the other way round. What the machine does to one of them it does to
the other: one fleet alone, observed and not in turns, took from 225 to 360 ms a second with nothing changed, which
hides a tenth. Processor time is that of the agents' processes; lateness is that of a task on each agent that is ticked
200 times a second of host time, ticks that never came included.

A fleet is observed for five seconds at a time, in which a recorder brings its file to the disk once; what only its
start takes is over before. The p99 of such a span rests on its forty latest ticks, and differs twofold between two in
which nothing is different: so percentiles are those of all ticks of a side together. What else the machine does makes
ticks late as well: rounds in which all other processes together were much busier than in the quietest do not count; at
least half of them does.

The range that is shown is where a ratio lies in 90 of 100 draws of as many rounds from these (a bootstrap): it says how
far the ratio is to be trusted.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from statistics import mean
from typing import Any

import psutil
from benchmarks.agent_process import listening_at, offer_tasks, ready_process
from benchmarks.figure import Figure, Plan

from pancakes.client import Client, Target
from pancakes.config.toml_reader import read_values
from pancakes.control import Begin, Configure, Describe, Start, Stop
from pancakes.tools.launch.ports import claim_ports
from pancakes.tools.web.feed import Feed
from pancakes.tools.web.watch import Watch

TITLE = "being observed, the agents of the demo; bare: the same, unobserved"
AGENTS = ("world", "agent1", "agent2", "sensor")
SPEED = 5.0
SPAN_S = 5.0
TICKS_HZ = 200.0
WANTED = 1.1
SHOWN = (("processor time a second", None), ("lateness p50", 0.5), ("lateness p99", 0.99))
"""What is told of each observer, and which percentile of the lateness it is."""
ROUNDS = 7
"""So many rounds at least, which take three and a half minutes: with fewer, the p99 is not sure to 10 %."""
SETTLE_S = 0.5
"""So long nothing is measured after something has ended to observe, ..."""
RECORDER_SETTLE_S = 1.0
"""... so long after a recorder began, which first asks for all tasks, ..."""
PAGE_SETTLE_S = 2.2
"""... and so long after a page was opened, which first asks for what was said before, and for each task."""
READY_S, READY_SETTLE_S = 30.0, 3.0
DRAWS = 200
"""So often as many rounds are drawn to see how far a ratio is to be trusted, ..."""
TRUSTED = 0.9
"""... which is how many of these lie in the range that is shown."""
BUSY_SHARE = 0.1
"""A round counts where all others took no more of the machine than in the quietest round, and this much of it."""
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


@dataclass(frozen=True)
class Round:
    """Each fleet once with an observer, and what the other, which had none, did at the same time."""

    ours: tuple[Span, Span]
    bare: tuple[Span, Span]

    @property
    def others_ms(self) -> float:
        """The processor time of all other processes for each second, in the busier of the spans."""
        return max(span.others_ms for span in self.ours)


@dataclass
class Compared(Figure):
    """A figure of those rounds in which the rest of the machine left the agents alone.

    Attributes:
        share: which percentile of the lateness; None: the processor time.
        rounds: what was measured.
    """

    share: float | None = None
    rounds: list[Round] = field(default_factory=list)

    def take(self, measured: Round) -> None:
        """Takes a round."""
        self.rounds.append(measured)
        ours, bare = self._sides([measured])
        self.runs.append(ours)
        self.bare_runs.append(bare)

    @property
    def value(self) -> float:
        return self._sides(quiet(self.rounds))[0]

    @property
    def baseline(self) -> float:
        return self._sides(quiet(self.rounds))[1]

    @property
    def spread(self) -> tuple[float, float]:
        """The range in which the ratio lies in `TRUSTED` of all draws of as many rounds, each as often as it comes."""
        rounds, draw, ratios = quiet(self.rounds), Random(1), []
        for _ in range(DRAWS):
            ours, bare = self._sides(draw.choices(rounds, k=len(rounds)))
            ratios.append(ours / bare)
        ratios.sort()
        outside = round(DRAWS * (1.0 - TRUSTED) / 2)
        return ratios[outside], ratios[-1 - outside]

    def _sides(self, rounds: list[Round]) -> tuple[float, float]:
        ours = [span for measured in rounds for span in measured.ours]
        return self._of(ours), self._of([span for measured in rounds for span in measured.bare])

    def _of(self, spans: list[Span]) -> float:
        if self.share is None:
            return mean(span.busy_ms for span in spans)
        return quantile([late_us for span in spans for late_us in span.late_us], self.share)


def quiet(rounds: list[Round]) -> list[Round]:
    """Returns the rounds that count: those in which all others left the machine alone, and the quieter half anyway."""
    by_noise = sorted(rounds, key=lambda measured: measured.others_ms)
    most_ms = by_noise[0].others_ms + 1000 * BUSY_SHARE * psutil.cpu_count()
    undisturbed = sum(measured.others_ms <= most_ms for measured in rounds)
    return by_noise[: max(undisturbed, (len(rounds) + 1) // 2)]


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

    def mark(self) -> None:
        """Begins a span of ticks, and ends the one before."""
        self._window += 1
        for agent in AGENTS:
            self.ask(agent, Configure(STEADY, {"window": self._window}))

    def ticks(self, duration_s: float) -> list[int]:
        """Returns how late each tick of the span was that has ended, in µs; so long it was."""
        ticks = {agent: self._ticks(agent) for agent in AGENTS}
        if any(len(late_us) < 0.5 * TICKS_HZ * duration_s for late_us in ticks.values()):
            told = ", ".join(
                f"{agent} {len(late_us)} (latest {max(late_us, default=0)} µs)" for agent, late_us in ticks.items()
            )
            raise RuntimeError(f"of {TICKS_HZ * duration_s:.0f} ticks these came: {told}")
        return [one_us for agent in AGENTS for one_us in ticks[agent]]

    def _ticks(self, agent: str) -> list[int]:
        state = self.ask(agent, Describe(STEADY, state=True))["state"]
        if state["window"] != self._window:
            raise RuntimeError(f"{agent} tells the ticks of another span")
        return [int(one_us) for one_us in state["late_us"].split()]

    def processor_s(self) -> float:
        """Returns the processor time of all agents so far."""
        # Of another process, to the nanosecond: how Linux builds the number of such a clock (clock_getcpuclockid).
        return sum(time.clock_gettime((~one.pid << 3) | 2) for one in self._processes.values())


@contextmanager
def running_demo(fleet: str) -> Iterator[Demo]:
    """Runs the agents of the demo; their batteries last, so that all spans are alike.

    Args:
        fleet: the name of their fleet.
    """
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name, ExitStack() as stack:
        directory = Path(name)
        environment = dict(offer_tasks(directory / "python"))
        files = {}
        shutil.copy(CONFIGS / "common.toml", directory)
        for agent in AGENTS:
            text = (CONFIGS / f"{agent}.toml").read_text()
            text += '\n[task.Steady]\ntype = "bench.Steady"\n'
            files[agent] = directory / f"{agent}.toml"
            files[agent].write_text(text)
        claim, moved = claim_ports(
            {agent: read_values(path.read_text(), str(path)).values for agent, path in files.items()}
        )
        if claim is not None:
            stack.callback(claim.release)
        processes = {}
        for agent, path in files.items():
            sets = [
                f'agent.fleet="{fleet}"',
                f'agent.folders=["{directory}"]',
                f'agent.state_dir="{directory}/state-{agent}"',
                f"clock.speed={SPEED}",
                "service.log.settings.console=false",
                "service.network.settings.insecure=true",
                *moved.get(agent, ()),
            ]
            if agent == "world":
                sets.append(f'task.Trajectory.settings.path="{directory}/trajectory.csv"')
                sets += [f"task.World.settings.robots.agent{n}.battery.capacity_j=1e6" for n in (1, 2)]
            command = [str(Path(sys.executable).with_name("pancakes-agent")), "--config", str(path)]
            command += [part for one in sets for part in ("--set", one)]
            processes[agent] = stack.enter_context(ready_process(command, environment))
        address = listening_at(environment, "world", processes["world"])
        client = stack.enter_context(Client(Target((address,), fleet), READY_S))
        for agent in AGENTS:
            client.request(agent, Begin(0.5), READY_S)
        demo = Demo(directory, client, processes)
        time.sleep(READY_SETTLE_S)
        yield demo


@contextmanager
def recorded(demo: Demo) -> Iterator[None]:
    """All agents record everything."""
    for agent in AGENTS:
        demo.ask(agent, Start(RECORDER, {"path": f"{demo.directory}/{{agent}}.mcap"}))
    time.sleep(RECORDER_SETTLE_S)
    try:
        yield
    finally:
        for agent in AGENTS:
            demo.ask(agent, Stop(RECORDER))


@contextmanager
def watched(demo: Demo) -> Iterator[None]:
    """A page is open: what a page shows is followed, whoever looks at it and however fast."""
    begun_s = time.monotonic()
    addresses = [demo.client.describe().agents[0]["listen"][0]]
    watch = Watch(Feed(lambda: time.monotonic() - begun_s), addresses)
    watch.start()
    time.sleep(PAGE_SETTLE_S)
    try:
        yield
    finally:
        watch.close()


def side_by_side(ours: Demo, bare: Demo, duration_s: float) -> tuple[Span, Span]:
    """Measures two fleets at the same time."""
    demos = (ours, bare)
    for demo in demos:
        demo.mark()
    before_s, all_before_s = [demo.processor_s() for demo in demos], _machine_s()
    begun_s = time.monotonic()
    time.sleep(duration_s)
    used_s, all_s = [demo.processor_s() - at_s for demo, at_s in zip(demos, before_s, strict=True)], _machine_s()
    took_s = time.monotonic() - begun_s
    for demo in demos:
        demo.mark()
    others_ms = 1000 * max(0.0, all_s - all_before_s - sum(used_s)) / took_s
    first, second = (
        Span(1000 * its_s / took_s, demo.ticks(took_s), others_ms) for demo, its_s in zip(demos, used_s, strict=True)
    )
    return first, second


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    span_s = max(2.0, SPAN_S * plan.scale)
    observers = (("recording everything", recorded), ("one open page", watched))
    figures = {
        name: [
            Compared(f"{name}: {what}", "ms" if share is None else "µs", wanted=WANTED, share=share)
            for what, share in SHOWN
        ]
        for name, _ in observers
    }
    fleets = [f"bench-{os.getpid()}-{number}" for number in (1, 2)]
    with running_demo(fleets[0]) as one, running_demo(fleets[1]) as other:
        for demo in (one, other):
            for _, observer in observers:
                with observer(demo):  # the first time modules are imported
                    time.sleep(SETTLE_S)
        for _ in range(max(ROUNDS, plan.rounds) if plan.scale == 1.0 else plan.rounds):
            for name, observer in observers:
                halves = []
                for ours, bare in ((one, other), (other, one)):
                    time.sleep(SETTLE_S)
                    with observer(ours):
                        halves.append(side_by_side(ours, bare, span_s))
                measured = Round((halves[0][0], halves[1][0]), (halves[0][1], halves[1][1]))
                for figure in figures[name]:
                    figure.take(measured)
    for found in figures.values():
        yield from found


def _machine_s() -> float:
    """Returns how long the machine's processors have been busy so far, all together."""
    busy = psutil.cpu_times()
    return float(sum(busy) - busy.idle - getattr(busy, "iowait", 0.0) - getattr(busy, "guest", 0.0))
