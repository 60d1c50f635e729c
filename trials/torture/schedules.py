"""Seeded fault schedules: whole virtual agents whose tasks migrate both ways at once, under all kinds of faults.

A seed draws everything: the delays of the links, which packets of the hand-off are lost, doubled, late and overtaken,
when links break and networks part, between which two steps an agent is killed, and what an operator requests meanwhile.
In a third of the schedules the tasks send each other letters all the time.
At the end all faults end, and each task must run once. Only the seed matters, so a schedule does the same again, even
when it is traced.
"""

from __future__ import annotations

import multiprocessing
import random
import time
import traceback
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

from torture.oracle import Drives, Oracle, Roamer, Violation
from torture.story import Story

from pancakes.agent.agent import Agent, Virtual
from pancakes.control import Configure, Migrate, Reschedule, Restart, Start, Stop
from pancakes.durable.client_service import ClientServiceCore
from pancakes.durable.record import Record
from pancakes.durable.register import Standing, Wanted
from pancakes.durable.store import RECORD
from pancakes.errors import PancakesError
from pancakes.journal import JournalEntry
from pancakes.kernel.mailbox import Mailbox
from pancakes.mesh.memory_network import Quality
from pancakes.packet import CTRL, LOG, NETWORK, SYSCTRL, Packet, agent_of, join
from pancakes.testing import Fleet, Probe, config_of, registered
from pancakes.util.plugins import Plugins

ROBOTS = ("a", "b", "c")
BORN = {"One": "a", "Two": "b", "Three": "a", "Four": "c"}
HEALS_WITHIN_S = 60.0
"""How long healing may take: the longest pauses are between two dials (10 s) and two repetitions in doubt (7.5 s)."""
TOLD = {
    "kill": "killed:",
    "break": "a link is broken:",
    "partition": "cut off:",
    "migrate": "asked for a move:",
    "command": "asked:",
    "lost": "... which is lost:",
    "doubled": "... which comes twice:",
    "late": "... which comes late:",
}
"""The names of the counted things for people."""


@cache
def _plugins() -> Plugins:
    """Return the plug-ins of the agents; read once, so that all schedules of a process use the same."""
    return registered({"test.Roamer": Roamer, "test.Drives": Drives})


@dataclass
class Outcome:
    """The result of one schedule.

    Attributes:
        seed: draws all of it.
        violation: the broken promise; empty: none.
        counts: how often each kind of event happened.
        healed_s: how long the fleet took to recover after the end of the faults, in virtual time.
        wall_s: how long it took on this machine.
        fingerprint: equal for two identical runs: a digest of the random numbers, the disks and the counts.
    """

    seed: int
    violation: str = ""
    counts: Counter[str] = field(default_factory=Counter)
    healed_s: float = 0.0
    wall_s: float = 0.0
    fingerprint: int = 0


class Schedule:
    """One fleet, one seed.

    Args:
        seed: draws all of it.
        trace: called with a line for each event; None: no trace.
    """

    def __init__(self, seed: int, trace: Callable[[str], None] | None = None) -> None:
        self.random = random.Random(f"schedule/{seed}")
        draw = self.random
        self.quality = Quality(latency_s=draw.choice([0.0005, 0.005, 0.05]), jitter_s=draw.choice([0.0, 0.03]))
        self.fleet = Fleet(seed, self.quality)
        self.outcome = Outcome(seed)
        self.story = Story(trace, self.fleet.now)
        self._lost, self._doubled, self._late = draw.choice(
            [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.5, 0.5), (0.1, 0.3, 0.3), (0.3, 0.3, 0.3)]
        )
        self._longest_s = draw.choice([0.05, 0.5, 6.0])
        self._faulty = True
        self._doomed: dict[
            str, tuple[str, int]
        ] = {}  # agents that will be killed: at which kind of step, and after how many
        self._plugins = _plugins()
        self._drivers: tuple[str, ...] = draw.choice([("Two",), ("One", "Two")])
        self._each = draw.choice([(), ("One", "Four")])
        # Only in a third of the schedules: four tasks with ten letters a second take half of the time of a schedule.
        self.oracle = Oracle(self.fleet.now, talk=seed % 3 == 0, each=self._each)
        self._probes: dict[str, Probe] = {}
        give_turn = self.fleet.dispatcher.give_turn

        def turn(mailbox: Mailbox, slice_s: float | None = None) -> None:
            """Give a turn, then check all tasks: between two turns, every state is visible to others."""
            component = mailbox.component
            give_turn(mailbox, slice_s)
            self.oracle.check()
            if self._doomed and component is not None:
                self._step(agent_of(component.address), "turn")

        self.fleet.dispatcher.give_turn = turn  # type: ignore[method-assign]

    def tell(self, kind: str, text: str = "") -> None:
        """Count an event, and trace it."""
        self.outcome.counts[kind] += 1
        self.story.say(f"{TOLD.get(kind, kind)} {text}")

    # Agents ----------------------------------------------------------------------------------------------------

    def start(self, name: str) -> None:
        """Start an agent with its former disk."""
        tasks = {
            task: {
                "type": "test.Drives" if task in self._drivers else "test.Roamer",
                "durability": "each" if task in self._each else "lazy",
                "restart": {"policy": "always", "at_most": 1000},
            }
            for task, born in BORN.items()
            if born == name
        }
        peers = tuple(f"tcp://{other}:7400" for other in ROBOTS if other != name)
        config = config_of(
            name,
            tasks=tasks,
            devices={"motors": "null.motors"},
            services={"network": {"settings": {"discovery_hz": 0.1}}},
            listen=f"tcp://{name}:7400",
            peers=peers,
            seed=self.outcome.seed,
            join_s=0.0,  # mission time does not matter here
        )
        self.fleet.add(name, partial(self._make, config))

    def _make(self, config: Any, virtual: Virtual) -> Agent:
        agent = Agent(config, self._plugins, virtual)
        name = agent.name
        probe = agent.kernel.spawn(Probe, join(name, "test", "Probe"), channels=(CTRL,))
        assert isinstance(probe, Probe)
        self._probes[name] = probe
        inject = partial(self._inject, name, agent.kernel.stream.inject)
        agent.kernel.stream.inject_all = partial(_one_by_one, inject)  # type: ignore[method-assign]
        write = virtual.journal.write

        def write_and_tell(batch: Sequence[JournalEntry]) -> None:
            self._step(name, "write")
            if self._agent(name) is not agent:
                return  # killed just before the write
            write(batch)
            for entry in batch:
                if entry.kind == RECORD:
                    record = Record.decode(entry.data)
                    self.oracle.written(record)
                    self.story.wrote(name, record)
            self._step(name, "written")

        virtual.journal.write = write_and_tell  # type: ignore[method-assign]
        if self.story.told:
            # A tap and not a reader: another actor would get turns, and change the order of all others.
            agent.kernel.stream.tap(LOG, self.story.logged)
        return agent

    def _step(self, name: str, kind: str) -> None:
        """Note a step of an agent, and kill it if it was its last."""
        doom = self._doomed.get(name)
        if doom is None or doom[0] != kind:
            return
        self._doomed[name] = (kind, doom[1] - 1)
        if doom[1] <= 1:
            self.kill(name)

    def _agent(self, name: str) -> Agent | None:
        handle = self.fleet.agents.get(name)
        return handle.agent if handle is not None else None

    def kill(self, name: str) -> None:
        """Kill an agent at once, possibly between any two steps."""
        self._doomed.pop(name, None)
        handle = self.fleet.agents.pop(name, None)
        if handle is not None:
            self.tell("kill", name)
            handle.agent.crash()

    # The network -----------------------------------------------------------------------------------------------

    def _inject(self, name: str, inject: Callable[[Packet], object], packet: Packet) -> None:
        """Lose a packet of the migration, deliver it twice, or deliver it late, behind later packets."""
        if packet.channel != NETWORK or not packet.type.startswith(("migration.", "task.")):
            inject(packet)
            return
        self.outcome.counts["packet"] += 1
        self.story.heard(name, packet)
        if not self._faulty:
            inject(packet)
            return
        draw = self.random
        copies = 2 if draw.random() < self._doubled else 1
        if copies > 1:
            self.tell("doubled", packet.type)
        for _ in range(copies):
            if draw.random() < self._lost:
                self.tell("lost", packet.type)
            elif draw.random() < self._late:
                delay_s = draw.uniform(0.0, self._longest_s)
                self.tell("late", f"{packet.type} by {delay_s:.3f} s")
                self.fleet.dispatcher.call_at(self.fleet.now() + delay_s, partial(self._come_late, name, packet))
            else:
                inject(packet)
        self._step(name, "packet")

    def _come_late(self, name: str, packet: Packet) -> None:
        """Deliver a late packet to the agent that has the name by then, even if it was restarted in between."""
        agent = self._agent(name)
        if agent is not None:
            self.story.heard(name, packet, " late")
            # Without faults: each packet gets a fault at most once.
            type(agent.kernel.stream).inject(agent.kernel.stream, packet)

    # Random events ---------------------------------------------------------------------------------------------

    def ask(self, name: str, body: Any) -> None:
        """Send an agent a random control packet, as an operator."""
        self.tell("migrate" if isinstance(body, Migrate) else "command", f"{name} {body}")
        self._probes[name].publish(SYSCTRL, body)

    def hosts(self, task: str) -> list[str]:
        return [copy.agent for copy in self.oracle.running(task)]

    def move(self) -> None:
        """Request the migration of some or all tasks, to any agent or to a named one."""
        for task in BORN:
            if self.random.random() < 0.7:
                for host in self.hosts(task):
                    self.ask(host, Migrate(f"client/{task}", to=self.random.choice(["", "", *ROBOTS])))

    def command(self) -> None:
        task = self.random.choice(list(BORN))
        target = f"client/{task}"
        body = self.random.choice(
            [
                Restart(target),
                Restart(target),
                Stop(target),
                Start(target),
                Reschedule(target, self.random.choice([5.0, 20.0])),
                Configure(target, {"colour": "blue"}),
                Migrate(target, dry_run=True),
                Stop("network", for_s=self.random.uniform(0.1, 3.0)),
            ]
        )
        asked = self.hosts(task) if self.random.random() < 0.8 else list(self.fleet.agents)
        for name in asked[:1]:
            self.ask(name, body)

    def doom(self) -> None:
        """Plan the kill of one agent: before or after a write, after a packet, or after any actor's turn."""
        if self.fleet.agents:
            name = self.random.choice(list(self.fleet.agents))
            kind = self.random.choice(["write", "written", "packet", "turn"])
            most = {"turn": 60, "packet": 8}.get(kind, 6)
            self._doomed[name] = (kind, self.random.randint(1, most))

    def kill_now(self) -> None:
        if self.fleet.agents:
            self.kill(self.random.choice(list(self.fleet.agents)))

    def break_link(self) -> None:
        one, other = self.random.sample(ROBOTS, 2)
        self.tell("break", f"{one} {other}")
        self.fleet.network.break_links(one, other, at_once=self.random.random() < 0.5)

    def part(self) -> None:
        alone, for_s = self.random.choice(ROBOTS), self.random.uniform(0.1, 5.0)
        self.tell("partition", f"{alone} for {for_s:.2f} s")
        self.fleet.network.partition([alone], until_s=self.fleet.now() + for_s)

    def revive(self) -> None:
        for name in ROBOTS:
            if name not in self.fleet.agents:
                self.story.say(f"{name} is started")
                self.start(name)

    # The whole -------------------------------------------------------------------------------------------------

    def run(self) -> Outcome:
        """Run the schedule to its end; the outcome has the violation."""
        began_s = time.perf_counter()
        Roamer.oracle = self.oracle
        try:
            self._storm()
            self._heal()
        except Violation as violation:
            self.outcome.violation = str(violation)
        except Exception:  # an error is a finding, and the other seeds must run
            self.outcome.violation = traceback.format_exc()
        finally:
            # Kill its agents in the middle of their work, so that nothing of them stays.
            for agent in [handle.agent for handle in self.fleet.agents.values()]:
                agent.crash()
            self.fleet.agents.clear()
        if self.outcome.violation:
            self.story.say(f"VIOLATION: {self.outcome.violation}")
        Roamer.oracle = None
        self.outcome.counts["start"] = self.oracle.starts
        self.outcome.counts["moved"] = self.oracle.moves
        self.outcome.counts["note"] = self.oracle.notes
        self.outcome.fingerprint = self._fingerprint()
        self.outcome.wall_s = time.perf_counter() - began_s
        return self.outcome

    def _fingerprint(self) -> int:
        # The next random number depends on how many were drawn, and the disks on the order of the agents' work.
        drawn, disks = self.random.random(), [self.fleet.disk(name) for name in ROBOTS]
        return zlib.crc32(repr((drawn, disks, self.fleet.now(), sorted(self.outcome.counts.items()))).encode())

    def _storm(self) -> None:
        draw = self.random
        for name in ROBOTS:
            self.start(name)
        self.fleet.run_for(draw.uniform(0.5, 2.0))
        troubles = [self.doom] * 3 + [
            self.break_link,
            self.part,
            self.command,
            self.command,
            self.revive,
            self.kill_now,
        ]
        for _ in range(draw.randint(3, 8)):
            self.move()
            for _ in range(draw.randint(0, 3)):
                self.fleet.run_for(draw.choice([0.0, 0.01, 0.1, 0.6]) * draw.random())
                draw.choice(troubles)()
            self.fleet.run_for(draw.uniform(0.0, 1.5))
            if draw.random() < 0.7:
                self.revive()

    def _heal(self) -> None:
        """End all faults: then each task must run exactly once, on any agent."""
        self.story.say("all heals: no more faults, all links up, all agents started")
        self._faulty = False
        self._doomed.clear()
        self.fleet.network.heal()
        self.revive()
        healed_s = self.fleet.now()
        if not self.fleet.run_until(self._settled, HEALS_WITHIN_S):
            raise Violation(f"{HEALS_WITHIN_S:g} s after all healed: {self._state()}")
        for _ in range(2):
            for name, task in self._stopped():
                # An operator's stop outlives everything, so start such tasks on their agents. If a start is refused
                # because a late snapshot had reserved the wheels for a moment, request it once more.
                self.ask(name, Start(f"client/{task}"))
            self.fleet.run_for(3.0)
            # Packets from before the end of the faults may arrive only now, and need another round of messages.
            self.fleet.run_until(self._settled, HEALS_WITHIN_S)
        resting = [task for _, task in self._stopped()]
        if not self._settled() or any(not self._waits_for_wheels(name, task) for name, task in self._stopped()):
            raise Violation(f"{HEALS_WITHIN_S:g} s after all healed: {self._state()}")
        self.outcome.healed_s = self.fleet.now() - 3.0 - healed_s
        counts = {task: self.oracle.running(task)[0].state.n for task in BORN if task not in resting}
        self.fleet.run_for(2.0)
        for task, before in counts.items():
            now = self.oracle.running(task)[0].state.n
            if now <= before or now < self.oracle.durable.get(task, 0):
                raise Violation(f"{task} has counted {now - before} in 2 s, {self.oracle.durable.get(task)} on disk")
        self.oracle.talk = False
        if not self.fleet.run_until(lambda: not self._unheard(resting), HEALS_WITHIN_S):
            raise Violation(f"{HEALS_WITHIN_S:g} s after all healed these wait for packets: {self._unheard(resting)}")

    def _unheard(self, resting: Sequence[str]) -> dict[str, int]:
        """Return how many packets still wait for each running task."""
        waiting: Counter[str] = Counter()
        for agent in (handle.agent for handle in self.fleet.agents.values()):
            waiting.update(agent.outbox.waiting())
        return {task: count for task, count in waiting.items() if task.partition("/")[2] not in resting}

    def _records(self) -> list[tuple[str, Record]]:
        found = []
        for name, agent in ((name, handle.agent) for name, handle in self.fleet.agents.items()):
            service = agent.kernel.registry.get(join(name, "client"))
            if isinstance(service, ClientServiceCore):
                found += [(name, place.record) for place in service.places.values()]
        return found

    def _stopped(self) -> list[tuple[str, str]]:
        return [
            (name, record.task_id.name)
            for name, record in self._records()
            if record.standing is Standing.OWNER and record.wanted is not Wanted.RUNNING
        ]

    def _waits_for_wheels(self, name: str, task: str) -> bool:
        """Return whether the start of a stopped task is refused because another task has the wheels by now."""
        others = [other for other in self._drivers if other != task and self.hosts(other) == [name]]
        return task in self._drivers and bool(others)

    def _settled(self) -> bool:
        """Return whether each task has one owner and runs where it should, and no migration is under way."""
        owners: Counter[str] = Counter()
        for _, record in self._records():
            if record.standing in (Standing.OFFERED, Standing.YIELDED, Standing.HEIR):
                return False
            if record.standing is Standing.OWNER:
                owners[record.task_id.name] += 1
                if len(self.hosts(record.task_id.name)) != (record.wanted is Wanted.RUNNING):
                    return False
        return all(owners[task] == 1 for task in BORN) and all(
            handle.agent.ready.is_set() for handle in self.fleet.agents.values()
        )

    def _state(self) -> str:
        records = [
            f"{record.task_id} on {name} {record.standing.value} {record.wanted.value} epoch {record.epoch}"
            for name, record in self._records()
            if record.standing not in (Standing.NONE, Standing.RELEASED)
        ]
        running = [f"{task} runs on {self.hosts(task)}" for task in BORN]
        broken = [
            f"{name} has no client service: {' '.join(agent.agent.skipped)}"
            for name, agent in self.fleet.agents.items()
            if agent.kernel.registry.get(join(name, "client")) is None
        ]
        return "; ".join([*running, *records, *broken])


def run_schedule(seed: int, trace: Callable[[str], None] | None = None) -> Outcome:
    """Run one schedule; the same seed gives the same run."""
    return Schedule(seed, trace).run()


def run_schedules(seeds: Sequence[int], jobs: int) -> Iterator[Outcome]:
    """Run a schedule for each seed, several at once, and yield their results as they end."""
    if jobs == 1:
        yield from map(run_schedule, seeds)
        return
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        yield from pool.imap_unordered(run_schedule, seeds, chunksize=4)


def _one_by_one(
    inject: Callable[[Packet], None],
    packets: Sequence[Packet],
    refused: Callable[[Packet, PancakesError], None],
    size: int | None = None,
) -> None:
    """Do the work of `InformationStream.inject_all` with an `inject` of our own."""
    for packet in packets:
        try:
            inject(packet)
        except PancakesError as error:
            refused(packet, error)
