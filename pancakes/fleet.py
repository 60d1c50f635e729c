"""Run a whole fleet in one process and in virtual time, and inject faults: slow links, cuts, lost packets, bad disks.

One thread, one network in memory, one clock. The same seed and the same calls give the same run. The demos, the replay
and `pancakes.simulation` stand on it.
"""

from __future__ import annotations

import math
import random
import uuid
from collections.abc import Callable
from dataclasses import dataclass, replace

from pancakes.agent.agent import Agent, Virtual
from pancakes.config import Config
from pancakes.journal import MemoryJournal
from pancakes.kernel.virtual_time import VirtualDispatcher
from pancakes.mesh.memory_network import MemoryNetwork, Quality
from pancakes.packet import NETWORK, SYSCTRL, Packet, covers, type_name
from pancakes.util.clock import SkewedClock
from pancakes.util.plugins import Plugins


class VirtualFleet:
    """Agents on one thread, one network in memory and one virtual clock; the same classes as anywhere else.

    Args:
        seed: draws the order of the actors, the network's jitter and the journals' identities.
        quality: how well agents hear each other where nothing else is said.
        plugins: where the agents' classes are found.

    Attributes:
        dispatcher: runs everything.
        network: the network; faults are made there.
        agents: the agents that run, by name.
        journals: what each agent, as it runs now or ran last, writes its disk with, by name.
    """

    def __init__(self, seed: int = 0, quality: Quality | None = None, plugins: Plugins | None = None) -> None:
        self.seed = seed
        self.dispatcher = VirtualDispatcher(seed)
        self.network = MemoryNetwork(
            self.dispatcher.call_at, self.dispatcher.clock.now, random.Random(f"network/{seed}"), quality
        )
        self.agents: dict[str, Agent] = {}
        self.journals: dict[str, MemoryJournal] = {}
        self._plugins = plugins or Plugins()
        self._disks: dict[str, dict[str, bytes]] = {}
        self._identities: dict[str, random.Random] = {}

    def now(self) -> float:
        """Returns the virtual time, in seconds; agents take it for the host's."""
        return self.dispatcher.clock.now()

    def start(self, config: Config) -> Agent:
        """Starts an agent. One that ran before under this name finds its disk as it left it.

        Raises:
            PancakesError: its address is in use, a plug-in is missing, ...
        """
        return self.add(config.agent.name, lambda virtual: Agent(config, self._plugins, virtual))

    def add(
        self, name: str, make: Callable[[Virtual], Agent], clock_rate: float = 1.0, clock_ahead_s: float = 0.0
    ) -> Agent:
        """Starts an agent that `make` makes of what it shares with the fleet; see `start`.

        Args:
            name: its name.
            make: makes it.
            clock_rate: how fast its host clock runs: its seconds for each virtual second.
            clock_ahead_s: what its host clock says at 0 of virtual time.
        """
        disk = self.disk(name)
        # Not the same one twice: an agent that has lost its identity is another one from then on.
        source = self._identities.setdefault(name, random.Random(f"journal/{self.seed}/{name}"))
        identity = uuid.UUID(int=source.getrandbits(128), version=4)
        journal = self.journals[name] = MemoryJournal(disk, str(identity), name)
        is_true = (clock_rate, clock_ahead_s) == (1.0, 0.0)
        clock = None if is_true else SkewedClock(self.dispatcher.clock, clock_rate, clock_ahead_s)
        transport = self.network.transport(name, clock.due_s if clock is not None else None)
        agent = make(Virtual(self.dispatcher, transport, journal, clock))
        agent.start()
        self.agents[name] = agent
        return agent

    def stop(self, name: str) -> None:
        """Stops one agent in good order."""
        self.agents.pop(name).stop()
        self.run_for(0.0)

    def crash(self, name: str) -> None:
        """Ends one agent as a kill does: nothing of it runs on, and what its disk has not yet got is lost."""
        self.agents.pop(name).crash()
        self.run_for(0.0)

    def disk(self, name: str) -> dict[str, bytes]:
        """Returns what an agent has on its disk; a change of it is a change of the disk."""
        return self._disks.setdefault(name, {})

    def run_until(self, time_s: float) -> None:
        """Runs until the virtual clock says `time_s`."""
        self.dispatcher.run_until(time_s)

    def run_for(self, duration_s: float) -> None:
        """Runs for so many seconds of virtual time."""
        self.run_until(self.now() + duration_s)

    def run_while(self, condition: Callable[[], bool], at_most_s: float) -> bool:
        """Runs while `condition` is true, for no more than `at_most_s` of virtual time.

        Returns:
            Whether it became false.
        """
        return self.dispatcher.run_while(condition, self.now() + at_most_s)

    def close(self) -> None:
        """Stops all agents, those that started last first."""
        for name in reversed(list(self.agents)):
            self.stop(name)


SPARED = (NETWORK, SYSCTRL)
"""What agents say to each other to keep themselves in order: links lose nothing of that unless they break."""
DISK_FULL = "no space left on device"
"""Why nothing can be written to a disk that is full."""


@dataclass(eq=False, slots=True)
class _Mishap:
    """What happens to some of the packets that come to an agent."""

    share: float
    copies: int
    type: str
    source: str
    at: str
    channel: str

    def concerns(self, agent: str, packet: Packet) -> bool:
        """Whether a packet that comes to an agent is one of those."""
        return (
            packet.channel not in SPARED
            and self.type in ("", packet.type)
            and self.at in ("", agent)
            and self.channel in ("", packet.channel)
            and (not self.source or covers(self.source, packet.source))
        )


class Faults:
    """Delays, cuts, losses, doubles and bad disks, drawn from the fleet's seed; `calm` ends them all.

    Agents are named by their names. Times are virtual seconds.

    Args:
        fleet: the fleet that they happen to.
        quality: how well its agents hear each other where nothing goes wrong.
    """

    def __init__(self, fleet: VirtualFleet, quality: Quality | None = None) -> None:
        self._fleet = fleet
        self._usual = quality or Quality()
        self._qualities: dict[tuple[str, str], Quality] = {}
        self._random = random.Random(f"faults/{fleet.seed}")
        self._mishaps: list[_Mishap] = []

    def delay(self, a: str, b: str, latency_s: float, jitter_s: float = 0.0) -> None:
        """Lets all that two agents send each other travel longer from now on.

        Args:
            a: one of the two.
            b: the other.
            latency_s: how long it travels.
            jitter_s: how much longer it may travel; the order is kept.
        """
        self._change(a, b, replace(self._quality(a, b), latency_s=latency_s, jitter_s=jitter_s))

    def slow(self, a: str, b: str, bytes_per_s: float) -> None:
        """Lets what two agents send each other leave no faster than this from now on."""
        self._change(a, b, replace(self._quality(a, b), bytes_per_s=bytes_per_s))

    def _quality(self, a: str, b: str) -> Quality:
        return self._qualities.get((min(a, b), max(a, b)), self._usual)

    def _change(self, a: str, b: str, quality: Quality) -> None:
        self._qualities[(min(a, b), max(a, b))] = quality
        self._fleet.network.set_quality(a, b, quality)

    def cut(self, *agents: str, off: tuple[str, ...] | None = None, for_s: float | None = None) -> None:
        """Lets agents not hear others for a while. Both have only the silence to tell them; what is sent is lost.

        Args:
            agents: the agents on one side.
            off: those on the other; None: all others.
            for_s: how long; None: until `calm`.
        """
        until_s = math.inf if for_s is None else self._fleet.now() + for_s
        self._fleet.network.partition(agents, off, until_s=until_s)

    def break_link(self, a: str, b: str, noticed: bool = True) -> None:
        """Breaks the link of two agents once; what was on its way is lost. They make it anew.

        Args:
            a: one of the two.
            b: the other.
            noticed: whether both see it break; otherwise they have only the silence to tell them.
        """
        self._fleet.network.break_links(a, b, noticed)

    def break_links(self, count: int, within_s: float) -> None:
        """Breaks the links of pairs of agents, at so many points in time; both are drawn."""
        for at_s in sorted(self._random.uniform(0.0, within_s) for _ in range(count)):
            self._fleet.dispatcher.call_at(self._fleet.now() + at_s, self._break_one)

    def _break_one(self) -> None:
        if len(self._fleet.agents) > 1:
            one, other = self._random.sample(list(self._fleet.agents), 2)
            self.break_link(one, other)

    def lose(
        self, share: float, body: type | None = None, *, source: str = "", at: str = "", channel: str = ""
    ) -> Callable[[], None]:
        """Lets packets from other agents be lost on their way.

        Links lose nothing unless they break, but a publisher drops packets where a peer is too slow or away. What
        is on `network` and `sysctrl` is spared; packets to tasks by `task_address` are among that.

        Args:
            share: which part of them, from 0 to 1; which ones is drawn.
            body: only packets of this type.
            source: only those of this agent, service or task.
            at: only where they come to this agent.
            channel: only those on this channel.

        Returns:
            What ends it.
        """
        return self._let(_Mishap(share, 0, type_name(body) if body is not None else "", source, at, channel))

    def double(
        self, share: float, body: type | None = None, *, source: str = "", at: str = "", channel: str = ""
    ) -> Callable[[], None]:
        """Lets packets from other agents come twice; see `lose` for the arguments and the result."""
        return self._let(_Mishap(share, 2, type_name(body) if body is not None else "", source, at, channel))

    def _let(self, mishap: _Mishap) -> Callable[[], None]:
        if not 0.0 <= mishap.share <= 1.0:
            raise ValueError(f"{mishap.share} is no share of packets: it must be from 0 to 1")
        self._mishaps.append(mishap)
        return lambda: self._mishaps.remove(mishap) if mishap in self._mishaps else None

    def copies(self, agent: str, packet: Packet) -> int:
        """Draws how often a packet that comes to an agent is handed to it."""
        for mishap in self._mishaps:
            if mishap.concerns(agent, packet) and self._random.random() < mishap.share:
                return mishap.copies
        return 1

    def fill_disk(self, agent: str) -> Callable[[], None]:
        """Lets an agent write nothing to its disk any more, until it is started again.

        Args:
            agent: its name.

        Returns:
            A function that ends it.
        """
        journal = self._fleet.journals[agent]
        journal.fault = DISK_FULL

        def end() -> None:
            journal.fault = ""

        return end

    def slow_disk(self, agent: str, latency_s: float) -> None:
        """Lets each write of an agent to its disk take so long, until the agent is started again."""
        self._fleet.journals[agent].latency_s = latency_s

    def calm(self) -> None:
        """Ends all that goes wrong, cuts that are still to come too."""
        for journal in self._fleet.journals.values():
            journal.fault, journal.latency_s = "", MemoryJournal.latency_s
        self._mishaps.clear()
        self._fleet.network.heal()
        for one, other in self._qualities:
            self._fleet.network.set_quality(one, other, self._usual)
        self._qualities.clear()
