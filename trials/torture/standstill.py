"""Look for standstills of one agent in a process of its own: tasks of all kinds, and probes that notice a standstill.

Every 20 ms a bare thread asks the pool, the timer and the network's loop a trivial question, and checks the last tick
of each ticker; every second it checks their rates. If one of them has not answered for `GAP_S`, or a ticker had less
than a fifth of its ticks, although the bare thread itself was on time (so the process had the processor and the
interpreter), it dumps the stacks of all threads, and whether the system lets them run.

Run by `scripts/torture standstill`: `python -m torture.standstill '{"name": ...}'`; it ends when its input does.
"""

from __future__ import annotations

import faulthandler
import json
import os
import random
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TextIO

from cli.processes import INSECURE

from pancakes.control import Reschedule, Start, Stop
from pancakes.kernel.actor import Component
from pancakes.packet import Packet, packet_type
from pancakes.task import Task, Tick, every, on
from pancakes.testing import AgentHandle, threaded_agent
from pancakes.tools.cli.agent_process import tune_interpreter

LOOK_S: Final = 0.02
GAP_S: Final = 0.15
ON_TIME_S: Final = 0.03
"""The bare thread was on time if it was never later than this during the gap."""
THIN: Final = 0.2
TICKING: dict[str, Any] = {}
"""The tickers, by name: time of the last tick, rate, and number of ticks so far."""


@packet_type("standstill.word")
@dataclass(frozen=True)
class Word:
    """A packet."""

    text: str


@packet_type("standstill.other")
@dataclass(frozen=True)
class Other:
    """A packet of another type."""

    text: str


class Ticker(Task):
    """Ticks, and publishes now and then."""

    @dataclass
    class Settings:
        says: int = 10

    def on_start(self) -> None:
        self._left = self.settings.says

    @every(hz=100)
    def tick(self, tick: Tick) -> None:
        TICKING[self.name] = (time.monotonic(), self._actor.timers["tick"].rate_hz, self._actor.timers["tick"].ticks)
        self._left -= 1
        if self._left <= 0:
            self._left = self.settings.says
            self.publish("system", Word(self.name), to=self.random.choice(("", "", "*")))

    def on_stop(self) -> None:
        TICKING.pop(self.name, None)


class PinnedTicker(Ticker):
    """The same task in a thread of its own."""

    blocking = True


class Waiting(Task):
    """Blocks its thread now and then, asleep."""

    @on("system", Word)
    def hear(self, packet: Packet) -> None:
        if self.random.random() < 0.01:
            time.sleep(self.random.choice((0.001, 0.019, 0.021, 0.045, 0.2, 0.7)))


class Computing(Task):
    """Blocks its thread and the interpreter now and then."""

    @every(hz=5)
    def compute(self, tick: Tick) -> None:
        until_s = time.monotonic() + self.random.choice((0.001, 0.005, 0.03))
        while time.monotonic() < until_s:
            sum(range(100))


class Changing(Task):
    """Subscribes, changes rates, and stops and starts other tasks."""

    @every(hz=4)
    def change(self, tick: Tick) -> None:
        name = f"T{self.random.randrange(4)}"
        match self.random.randrange(5):
            case 0:
                self.subscribe("system", self.random.choice((Word, Other, None)), lambda packet: None)
            case 1:
                self.publish("sysctrl", Reschedule(name, self.random.choice((100.0, 200.0, 500.0, 1000.0))))
            case 2:
                self.publish("sysctrl", Stop(name))
            case 3:
                self.publish("sysctrl", Start(name))
            case 4:
                self.after(self.random.random() / 10, self._say)

    def _say(self) -> None:
        self.publish("system", Other("later"))


class Probe:
    """Asks a trivial question again and again, and knows how long it has waited for the answer.

    Args:
        ask: sends the question; it gets the callback for the answer.
    """

    def __init__(self, ask: Callable[[Callable[[], Any]], Any]) -> None:
        self._ask = ask
        self._asked_s = 0.0
        self._waits = False

    def look(self, now_s: float) -> float:
        """Return how long an answer has been due; if it has arrived, ask again."""
        if self._waits:
            return now_s - self._asked_s
        self._asked_s, self._waits = now_s, True
        self._ask(self._answered)
        return 0.0

    def _answered(self) -> None:
        self._waits = False


class Watch:
    """The bare thread.

    Attributes:
        gaps: how often each one had a standstill.
        worst_s: the longest wait of each while the bare thread was on time.
        late: how often the bare thread itself was late.
        least: the smallest share of its ticks that a ticker had in any second.
    """

    def __init__(self, agent: AgentHandle, out: TextIO) -> None:
        kernel = agent.kernel
        echo = kernel.spawn(Component, f"{agent.name}/echo")
        self._kernel = kernel
        self._out = out
        self._probes = {
            "pool": Probe(echo.call),
            "timer": Probe(lambda answer: kernel.timer.after_host(0.01, answer)),
            "loop": Probe(lambda answer: kernel.transport.call_later(0.01, answer)),
        }
        self.gaps: Counter[str] = Counter()
        self.worst_s: dict[str, float] = {}
        self.late = 0
        self.least = 1.0
        self.looks = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """End it."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        before_s = on_time_s = time.monotonic()
        quiet_until_s = 0.0
        counted_s, counted = before_s, dict(TICKING)
        while not self._ended.wait(LOOK_S):
            now_s = time.monotonic()
            self.looks += 1
            if now_s - before_s > LOOK_S + ON_TIME_S:
                self.late += 1
                on_time_s = now_s
            before_s = now_s
            waits = {name: probe.look(now_s) for name, probe in self._probes.items()}
            ticking = dict(TICKING)
            for name, (last_s, rate_hz, _) in ticking.items():
                waits[name] = now_s - last_s - 1 / rate_hz
            for name, waits_s in waits.items():
                if waits_s > now_s - on_time_s:
                    continue  # the gap began while the process itself was late
                kind = "ticks" if name in ticking else name
                self.worst_s[kind] = max(self.worst_s.get(kind, 0.0), waits_s)
                if waits_s > GAP_S and now_s > quiet_until_s:
                    quiet_until_s = now_s + 1.0
                    self.gaps[kind] += 1
                    self._dump(f"{name} has waited for {waits_s:.3f} s")
            if now_s - counted_s >= 1.0:
                if on_time_s < counted_s:
                    self._count(now_s - counted_s, counted, ticking)
                counted_s, counted = now_s, ticking

    def _count(self, took_s: float, before: dict[str, Any], now: dict[str, Any]) -> None:
        for name, (_, rate_hz, ticks) in now.items():
            if name not in before or before[name][1] != rate_hz or ticks < before[name][2]:
                continue  # it has a new rate, or was restarted
            share = (ticks - before[name][2]) / (rate_hz * took_s)
            self.least = min(self.least, share)
            if share < THIN:
                self.gaps["thin"] += 1
                self._dump(f"{name} had {share:.0%} of its ticks")
                return

    def _dump(self, what: str) -> None:
        kernel = self._kernel
        self._out.write(f"\n=== {kernel.agent}: {what}, load {os.getloadavg()[0]:.1f}\n")
        for thread in threading.enumerate():
            self._out.write(f"{thread.name}: {_run_state(thread)}\n")
        self._out.flush()
        faulthandler.dump_traceback(self._out)
        self._out.write(f"timer: inbox {len(kernel.timer.actor_inbox)}; load {os.getloadavg()}\n")
        self._out.flush()


def _run_state(thread: threading.Thread) -> str:
    """Return whether a thread runs or waits for a core (R), and how long it has waited for one so far."""
    place = Path(f"/proc/self/task/{thread.native_id}")
    try:
        state = (place / "stat").read_text().rpartition(")")[2].split()[0]
        ran_ns, waited_ns, _ = (place / "schedstat").read_text().split()
    except (OSError, ValueError):
        return "gone, or not to be known"
    return f"{state}, ran {int(ran_ns) / 1e9:.3f} s, waited for a core {int(waited_ns) / 1e9:.3f} s"


def slow_disk(draws: random.Random) -> None:
    """Make the disk slow now and then."""
    fsync = os.fsync

    def slow(fd: Any) -> None:
        if draws.random() < 0.1:
            time.sleep(draws.choice((0.1, 0.5, 1.5)))
        fsync(fd)

    os.fsync = slow


def main() -> None:
    """Run the agent until the input ends, and print the figures."""
    told = json.loads(sys.argv[1])
    tune_interpreter()
    draws = random.Random(told["seed"])
    if told["record"]:
        slow_disk(draws)
    tasks: dict[str, Any] = {}
    for number in range(told["tickers"]):
        kind = PinnedTicker if draws.random() < 0.2 else Ticker
        rate_hz = draws.choice((100.0, 200.0, 500.0, 1000.0) if number < 4 else (100.0, 40.0))
        tasks[f"T{number}"] = {"type": kind, "rate_hz": rate_hz, "settings": {"says": draws.choice((1, 10, 50))}}
    others: tuple[type[Task], ...] = (Waiting, Computing, Changing)
    for other in others:
        tasks |= {f"{other.__name__}{number}": other for number in range(told[other.__name__.lower()])}
    peers = told["peers"]
    with tempfile.TemporaryDirectory() as directory, Path(told["file"]).open("a") as out:
        with threaded_agent(told["name"], INSECURE, tasks=tasks, listen=told["listen"], peers=peers) as agent:
            if told["record"]:
                agent.publish("sysctrl", Start("log/Recorder", {"path": f"{directory}/it.mcap"}))
            watch = Watch(agent, out)
            print("ready", flush=True)
            sys.stdin.read()
            watch.end()
            worst = {name: round(waits_s, 3) for name, waits_s in sorted(watch.worst_s.items())}
            seen = {"gaps": watch.gaps, "worst": worst, "least": round(watch.least, 2)}
            print(json.dumps({**seen, "late": watch.late, "looks": watch.looks}))


if __name__ == "__main__":
    main()
