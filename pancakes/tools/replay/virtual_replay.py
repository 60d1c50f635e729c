"""Feed recorded packets into agents in virtual time, and record the result."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from msgspec.structs import replace

from pancakes.config import Config
from pancakes.config.tables import RecordConfig
from pancakes.errors import ConfigError, Fault, MailboxFullError, PancakesError
from pancakes.packet import join
from pancakes.recording.records import NANOSECONDS, RecordedPacket
from pancakes.recording.virtual_recorder import VirtualRecorder
from pancakes.services.root import Root
from pancakes.simulation.fleet import Fleet
from pancakes.tools.replay.replay import Live, Selection, Tally
from pancakes.util.plugins import Plugins

READY_S: Final = 30.0
"""How long agents may take to become ready, in seconds of virtual time."""
AFTER_S: Final = 1.0
"""How long the agents run after the last packet, in seconds of virtual time, so that its effects are recorded."""


class VirtualReplay:
    """Agents in virtual time that are fed with a recording.

    Args:
        configs: their configurations.
        out: the folder for their recordings, `AGENT.mcap` for each; None: they are not recorded.
        plugins: where their classes are found.
        seed: the seed for the order of the actors, and of agents whose configuration has no seed.

    Attributes:
        tally: the packets that were fed so far.
        refused: sentences about packets that found a full mailbox, and packets that could not be recorded.

    Raises:
        ConfigError: two agents have the same name.
    """

    def __init__(self, configs: Sequence[Config], out: Path | None, plugins: Plugins, seed: int = 0) -> None:
        self._fleet = Fleet(seed, plugins=plugins)
        self._configs: dict[str, Config] = {}
        self._records: dict[str, RecordConfig] = {}
        self._recorders: list[VirtualRecorder] = []
        for config in configs:
            name = config.agent.name
            if name in self._configs:
                raise ConfigError([Fault("--config", "[agent] name", f"two of the agents are called {name!r}")])
            self._configs[name] = _virtual(config, seed)
            if out is not None:
                record = config.record or RecordConfig()
                self._records[name] = replace(record, path=str(out / f"{name}.mcap"))
        self.tally = Tally()
        self.refused: list[str] = []

    def __enter__(self) -> VirtualReplay:
        return self

    def __exit__(self, *error: object) -> None:
        try:
            self._fleet.close()
        finally:
            for recorder in self._recorders:
                recorder.end()

    def start(self) -> dict[str, Live]:
        """Start the agents, and return them by name.

        Raises:
            PancakesError: an agent does not become ready, or cannot be started or recorded.
        """
        agents = []
        for name, config in self._configs.items():
            agent = self._fleet.start_config(config, settle=False, probe=False).agent
            agents.append(agent)
            if name in self._records:
                self._recorders.append(VirtualRecorder(agent.kernel, self._records[name], self.refused.append))
        if not self._fleet.run_until(lambda: all(agent.ready.is_set() for agent in agents), READY_S):
            late = ", ".join(agent.name for agent in agents if not agent.ready.is_set())
            raise PancakesError(f"{late} did not become ready within {READY_S:g} s of virtual time")
        roots = [agent.kernel.registry.get(join(agent.name, "kernel")) for agent in agents]
        return {root.agent: Live.of(root.describe()) for root in roots if isinstance(root, Root)}

    def feed(self, selection: Selection, entries: Iterable[RecordedPacket], first_ns: int, scale: float) -> None:
        """Feed all packets, and run the agents a little longer.

        Args:
            selection: which packets are fed, and into which agent.
            entries: the recording, in the order of time.
            first_ns: when the first packet to feed was recorded; it is fed at once.
            scale: seconds of virtual time per second of the recording.
        """
        begin_s = self._fleet.now()
        for fed in selection.of(entries):
            if fed.topic.left_out:
                continue
            due_s = begin_s + (fed.time_ns - first_ns) / NANOSECONDS * scale
            self._fleet.run_to(max(due_s, self._fleet.now()))
            kernel = self._fleet.agents[fed.topic.agent].kernel
            try:
                kernel.stream.inject(replace(fed.packet, stamp_s=kernel.mission.now()))
            except MailboxFullError as error:
                self.refused.append(str(error))
                continue
            self.tally.add(fed)
        self._fleet.run_for(AFTER_S)


def _virtual(config: Config, seed: int) -> Config:
    """Return a configuration for virtual time: without a recorder, and with a mission that begins at once."""
    seed = seed if config.agent.seed is None else config.agent.seed
    agent = replace(config.agent, seed=seed, birth_wait_s=0.0)  # its peers are not here
    log = config.services["log"]
    services = {**config.services, "log": replace(log, settings={**log.settings, "console": False})}
    clock = replace(config.clock, hold=False, speed=1.0, join_s=0.0)
    return replace(config, agent=agent, record=None, clock=clock, services=services)
