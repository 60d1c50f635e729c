"""The soak: a live fleet in which random things happen all the time, drawn from a seed."""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from soak.agents import Fleet, NotInTimeError
from soak.judgement import Sample, Trend, leaks, lost_pieces, memory_fault
from soak.tasks import SWEPT_S
from soak.vitals import vitals_of

from pancakes.client import Client, Target
from pancakes.control import Configure, Follow, Migrate, Reschedule, Restart, Start, Stop, Unfollow
from pancakes.errors import PancakesError

SAMPLE_S: Final = 5.0
"""How often each process is sampled, in seconds."""
SETTLES_WITHIN_S: Final = 60.0
"""How long the fleet may take to settle, in seconds. Some pauses are long: 10 s between two dials, and the pauses
between the repetitions of a hand-off in doubt."""
KILLS_EVERY_S: Final = 6.0
"""The mean time between two kills, in seconds."""
LOOKS: Final = 6
"""How many samples are taken of each agent at rest, each after a garbage collection."""
PAUSE_S: Final = 0.25
"""The mean pause between two actions, in seconds."""
PASSING: Final = ("PassingA", "PassingB")
OTHER_RECORDS: Final = 7
"""Other files in a state directory: the sweeper's, the journal, its lock, mark and identity, fences, recordings."""


@dataclass
class Outcome:
    """The result of a soak.

    Attributes:
        counts: how often each action was done, and, with ` refused` appended, how often it was refused.
        trends: the memory of each agent that was never killed, in MiB.
        samples: the samples of each agent.
        calm: the samples of each agent at rest: after the warm-up, and at the end.
        faults: a sentence for each fault; empty: the soak has passed.
    """

    counts: Counter[str] = field(default_factory=Counter)
    trends: dict[str, Trend] = field(default_factory=dict)
    samples: dict[str, list[Sample]] = field(default_factory=dict)
    calm: dict[str, list[Sample]] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)


class Churn:
    """One soak.

    Args:
        directory: the folder for all files.
        seed: the seed of the actions; their timing depends on the machine.
        names: the agents; the first half of them is never killed, so that its memory can be followed.
        say: prints a line for people.
        leak_bytes: how many bytes each agent leaks on purpose, every two seconds.
    """

    def __init__(
        self, directory: Path, seed: int, names: Sequence[str], say: Callable[[str], None], leak_bytes: int = 0
    ) -> None:
        self._leak_bytes = leak_bytes
        self.random = random.Random(f"soak/{seed}")
        self.names = tuple(names)
        self.steady = self.names[: (len(names) + 1) // 2]
        self.mortal = self.names[len(self.steady) :]
        self.born = {f"Work{number}": name for number, name in enumerate(self.names)}
        self.work = directory / "work"
        self.work.mkdir()
        self.fleet = Fleet(directory, self.names, {name: self._rest(name) for name in self.names}, peers=len(names))
        self.outcome = Outcome()
        self._say = say
        self._began_s = time.monotonic()
        self._back: dict[str, float] = {}
        self._seen: dict[str, list[str]] = {}
        self._sampled_s = 0.0
        self._killed_s = 0.0
        self._client: Client | None = None

    def _rest(self, name: str) -> str:
        workers = list(self.born)
        lines = []
        for number, worker in enumerate(workers):
            if self.born[worker] != name:
                continue
            other = workers[(number + 1) % len(workers)]
            settings = f'directory = "{self.work}", friend = "{self.born[other]}/{other}"'
            durability = "each" if number % 2 else "lazy"
            lines.append(f'[task.{worker}]\ntype = "soak.Worker"\ndurability = "{durability}"')
            lines.append(f"settings = {{{settings}}}")
        lines.append(f'[task.Sweeper]\ntype = "soak.Sweeper"\nsettings = {{leak_bytes = {self._leak_bytes}}}')
        # A small buffer of remembered log lines is full soon, so that it does not count as growth.
        lines.append("[service.log]\nsettings = {remembered = 100}")
        for passing in PASSING:
            lines.append(f'[task.{passing}]\ntype = "soak.Passing"\nstart = false')
        return "\n".join(lines)

    def run(self, duration_s: float, warm_up_s: float) -> Outcome:
        """Run the soak: the warm-up, a rest, the main part, and another rest."""
        with self.fleet:
            try:
                self._run(duration_s, warm_up_s)
            except NotInTimeError as error:
                self.outcome.faults.append(str(error))
        return self.outcome

    def _run(self, duration_s: float, warm_up_s: float) -> None:
        self.fleet.start()
        self.fleet.until(lambda: self.fleet.all_ready() and self.fleet.is_full_mesh(), "the fleet comes together")
        self._trouble(self._began_s + warm_up_s)
        self._rest_a_while()
        before = len(self.outcome.samples[self.names[0]])
        self._trouble(self._began_s + duration_s)
        self._rest_a_while()
        for name in self.steady:
            fault, found = memory_fault(name, self.outcome.samples[name][before:])
            if found is not None:
                self.outcome.trends[name] = found
            lost = lost_pieces(name, *self.outcome.calm[name])
            self.outcome.faults += [it for it in (fault, lost) if it]
        for name in self.names:
            first, last = self.outcome.calm[name]
            boots = len(self.names) - 1  # a file for each other agent
            records = len(self.born) + len(PASSING) + boots + OTHER_RECORDS
            self.outcome.faults += leaks(name, first, last, records)
        self.outcome.faults += [
            line for path in sorted(self.work.glob("*.doubled")) for line in path.read_text().splitlines()
        ]

    # Actions ---------------------------------------------------------------------------------------------------

    def _trouble(self, until_s: float) -> None:
        """Do random actions until a time."""
        self._killed_s = time.monotonic() - KILLS_EVERY_S / 2
        with self._asking():
            while (now_s := time.monotonic()) < until_s:
                self._kill_and_raise(now_s)
                self._ask_for_something()
                self._sample()
                if self.fleet.dead():
                    raise NotInTimeError(f"{', '.join(self.fleet.dead())} ended by itself")
                time.sleep(self.random.expovariate(1 / PAUSE_S))

    def _kill_and_raise(self, now_s: float) -> None:
        for name in [name for name, due_s in self._back.items() if now_s >= due_s]:
            del self._back[name]
            self.fleet.start(name)
        if now_s - self._killed_s > KILLS_EVERY_S and self.mortal:
            self._killed_s = now_s + self.random.uniform(-0.5, 0.5) * KILLS_EVERY_S
            name = self.random.choice(self.mortal)
            if name not in self._back:
                self.fleet.agents[name].end(kill=True)
                self._back[name] = now_s + self.random.uniform(0.2, 4.0)
                self.outcome.counts["killed"] += 1

    def _ask_for_something(self) -> None:
        draw = self.random
        agent = draw.choice(self.names)
        passing = draw.choice(PASSING)
        worker = draw.choice(list(self.born))
        kind = draw.choices(
            ("move", "start", "stop", "restart", "configure", "reschedule", "follow", "look"),
            (8, 6, 5, 2, 2, 2, 1, 1),
        )[0]
        to = draw.choice(["", *self.names])
        rate_hz = draw.uniform(1.0, 20.0)
        loudness = draw.random()
        match kind:
            case "move":
                self._ask(kind, self._home(worker), Migrate(f"client/{worker}", to=to))
            case "start":
                self._ask(kind, agent, Start(f"client/{passing}", {"loudness": loudness}))
            case "stop":
                self._ask(kind, agent, Stop(f"client/{passing}"))
            case "restart":
                self._ask(kind, self._home(worker), Restart(f"client/{worker}", keep_state=True))
            case "configure":
                self._ask(kind, self._home(worker), Configure(f"client/{worker}", {"loudness": loudness}))
            case "reschedule":
                self._ask(kind, self._home(worker), Reschedule(f"client/{worker}", rate_hz, timer="beat"))
            case "follow":
                self._ask(kind, agent, Follow("system"))
                self._ask("unfollow", agent, Unfollow("system"))
            case "look":
                # A new terminal, whose client has a new name.
                self.outcome.counts["look"] += 1
                with Client(Target(tuple(self._addresses()), "soak"), 2.0) as client:
                    self._survey(client)

    def _ask(self, kind: str, agent: str, body: Any) -> None:
        if not agent or agent in self._back:
            return
        try:
            assert self._client is not None
            done = self._client.request(agent, body, 3.0).ok
        except PancakesError:  # the agent is dead, or not back yet
            done = False
        self.outcome.counts[kind if done else f"{kind} refused"] += 1

    def _home(self, worker: str) -> str:
        """Return the agent on which a worker ran at the last survey."""
        return next((name for name in self.names if worker in self._seen.get(name, ())), self.born[worker])

    # Samples ---------------------------------------------------------------------------------------------------

    @contextmanager
    def _asking(self) -> Iterator[None]:
        with Client(Target(tuple(self._addresses()), "soak"), 3.0) as client:
            self._client = client
            try:
                yield
            finally:
                self._client = None

    def _addresses(self) -> list[str]:
        return [self.fleet.agents[name].address for name in self.names]

    def _survey(self, client: Client) -> dict[str, list[str]]:
        """Return the tasks that run on each agent that answers, and remember them."""
        try:
            rows = client.describe().agents
        except PancakesError:
            return {}
        self._seen = {
            row["agent"]: [task["task"] for task in row["tasks"] if task["state"] == "running"]
            for row in rows
            if row["ready"]
        }
        return self._seen

    def _sample(self, now: bool = False) -> None:
        self.fleet.read()
        time_s = time.monotonic() - self._began_s
        if time_s - self._sampled_s < SAMPLE_S and not now:
            return
        self._sampled_s = time_s
        if self._client is not None:
            self._survey(self._client)
        for agent in self.fleet.alive():
            assert agent.process is not None
            try:
                vitals = vitals_of(agent.process.pid)
            except OSError:  # it is just ending
                continue
            kept = [path for path in self.fleet.state_of(agent.name).iterdir() if not path.name.startswith("ledger.")]
            workers = sum(task in self.born for task in self._seen.get(agent.name, ()))
            sample = Sample(time_s, vitals, workers, len(kept), agent.pieces)
            self.outcome.samples.setdefault(agent.name, []).append(sample)

    def _rest_a_while(self) -> None:
        """Stop all actions, wait until only the workers run, each once and at home, and sample each agent."""
        for name in self._back:
            self.fleet.start(name)
        self._back = {}
        self.fleet.until(lambda: self.fleet.all_ready() and self.fleet.is_full_mesh(), "all are back", SETTLES_WITHIN_S)
        with self._asking():
            assert self._client is not None
            began_s = time.monotonic()
            while True:
                for name in self.names:
                    for passing in PASSING:
                        if passing in self._seen.get(name, ()):
                            self._ask("stop", name, Stop(f"client/{passing}"))
                for worker, home in self.born.items():
                    # Each worker goes home, so that each agent can be compared with itself.
                    if (away := self._home(worker)) != home:
                        self._ask("move", away, Migrate(f"client/{worker}", to=home))
                seen = self._survey(self._client)
                copies = Counter(task for tasks in seen.values() for task in tasks)
                if len(seen) == len(self.names) and all(
                    copies[task] == (task in self.born) for task in (*self.born, *PASSING)
                ):
                    if all(home in seen and worker in seen[home] for worker, home in self.born.items()):
                        break
                if time.monotonic() - began_s > SETTLES_WITHIN_S:
                    wrong = {task: copies[task] for task in self.born if copies[task] != 1}
                    raise NotInTimeError(
                        f"not each task once and at home within {SETTLES_WITHIN_S:g} s: {wrong or seen}"
                    )
                time.sleep(0.2)
        # An agent gives back temporary things (threads, links of a closed terminal) within seconds, so the least of
        # several samples counts.
        lowest: dict[str, Sample] = {}
        for _ in range(LOOKS):
            time.sleep(SWEPT_S)
            self._sample(now=True)
            for name in self.names:
                sample = self.outcome.samples[name][-1]
                lowest[name] = lowest[name].least(sample) if name in lowest else sample
        for name, sample in lowest.items():
            self.outcome.calm.setdefault(name, []).append(sample)
        self._say(f"{time.monotonic() - self._began_s:.0f} s: all at rest, each task runs once")
