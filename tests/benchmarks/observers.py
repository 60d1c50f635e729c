"""What it costs the agents of the demo to be recorded, and to be watched by an open page.

Everything is measured on one live fleet, as `pancakes demo encirclement` runs it (five times real time), in spans that
take turns: with the observer, and without. The baseline is the same agents, unobserved. Processor time is that of the
agents' processes; lateness is that of a task of agent1 that is ticked 100 times a second of host time.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from benchmarks.agent_process import offer_tasks, process
from benchmarks.figure import Figure, Plan, in_turns

from pancakes.client import Client
from pancakes.control import Begin, Configure, Describe, Start, Stop
from pancakes.errors import PancakesError
from pancakes.launch.ports import claim_ports
from pancakes.web.feed import Feed
from pancakes.web.watch import Watch

TITLE = "being observed, the agents of the demo; bare: the same, unobserved"
AGENTS = ("world", "agent1", "agent2", "sensor")
SPEED = 5.0
SPAN_S = 6.0
SETTLE_S = 1.0
"""So long after something was switched nothing is measured."""
READY_S = 30.0
RECORDER, STEADY = "log/Recorder", "client/Steady"
CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "encirclement"


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

    def span(self, duration_s: float) -> list[float]:
        """Measures for a while. Returns the agents' processor time for each second, and p50 and p99 of the lateness."""
        self._mark()
        before_s = self._processor_s()
        begun_s = time.monotonic()
        time.sleep(duration_s)
        used_s = self._processor_s() - before_s
        took_s = time.monotonic() - begun_s
        self._mark()
        state = self.ask("agent1", Describe(STEADY, state=True))["state"]
        if state["window"] != self._window or state["ticks"] < 0.5 * 20 * SPEED * duration_s:
            raise RuntimeError(f"only {state['ticks']} ticks came in {duration_s:g} s")
        return [1000 * used_s / took_s, state["p50_us"], state["p99_us"]]

    def _mark(self) -> None:
        self._window += 1
        self.ask("agent1", Configure(STEADY, {"window": self._window}))

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
            if agent == "agent1":
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


def recorded(demo: Demo, span_s: float) -> list[float]:
    """One span in which all agents record everything."""
    for agent in AGENTS:
        demo.ask(agent, Start(RECORDER, {"path": f"{demo.directory}/{{agent}}.mcap"}))
    time.sleep(SETTLE_S)
    try:
        return demo.span(span_s)
    finally:
        for agent in AGENTS:
            demo.ask(agent, Stop(RECORDER))


def watched(demo: Demo, span_s: float) -> list[float]:
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


def unobserved(demo: Demo, span_s: float) -> list[float]:
    """One span in which nobody looks."""
    time.sleep(SETTLE_S)
    return demo.span(span_s)


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    span_s = max(2.0, SPAN_S * plan.scale)
    observers: tuple[tuple[str, Callable[[Demo, float], list[float]]], ...] = (
        ("recording everything", recorded),
        ("one open page", watched),
    )
    with running_demo() as demo:
        for name, observer in observers:
            observer(demo, 2.0)  # the first time modules are imported
            figures = [
                Figure(f"{name}: processor time a second", "ms", wanted=1.1),
                Figure(f"{name}: lateness p50", "µs"),
                Figure(f"{name}: lateness p99", "µs"),
            ]
            yield from in_turns(
                plan,
                figures,
                lambda observer=observer: observer(demo, span_s),  # type: ignore[misc]
                lambda: unobserved(demo, span_s),
            )
