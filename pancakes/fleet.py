"""A whole fleet in one process and in virtual time: missions that repeat themselves, and tests."""

from __future__ import annotations

import random
import uuid
from collections.abc import Callable

from pancakes.mesh.net.memory import MemoryNetwork, Quality
from pancakes.runtime.agent import Agent, Virtual
from pancakes.runtime.clock import SkewedClock
from pancakes.runtime.config import Config
from pancakes.runtime.journal import MemoryJournal
from pancakes.runtime.kernel.virtual import VirtualDispatcher
from pancakes.runtime.plugins import Plugins


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
