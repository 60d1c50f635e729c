"""Cause and effect: what led to the commands of actuators, over which steps, and how long each took. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import msgspec

from pancakes.control import Hold
from pancakes.packet import CTRL, Packet, agent_of
from pancakes.recording.chains import Causes, Chain
from pancakes.recording.entry import Entry
from pancakes.report.series import Sample

REMEMBERED: Final = 50_000
"""So many packets are remembered as causes of later ones."""
MOST_SHAPES: Final = 200
"""So many kinds of chains are told apart."""


@dataclass
class Reaction:
    """All chains of one shape: the same packet types of the same sources, in the same order.

    Attributes:
        steps: who said what, the first cause first.
        latency_s: from the first cause to the command.
        step_sums_s: of each step but the last, the time to the next one: summed, travel included.
        travel_sums_s: of that, the time between agents.
    """

    steps: tuple[str, ...]
    latency_s: Sample = field(default_factory=Sample)
    step_sums_s: list[float] = field(default_factory=list)
    travel_sums_s: list[float] = field(default_factory=list)

    @property
    def count(self) -> int:
        """How many chains."""
        return self.latency_s.count

    @property
    def step_means_s(self) -> list[float]:
        """The mean time of each step but the last to the next one."""
        return [total / self.count for total in self.step_sums_s]

    @property
    def travel_means_s(self) -> list[float]:
        """Of `step_means_s`, what was spent between agents."""
        return [total / self.count for total in self.travel_sums_s]

    def add(self, chain: Chain) -> None:
        """Adds a chain of this shape."""
        if not self.count:
            self.step_sums_s = [0.0] * (len(chain.steps) - 1)
            self.travel_sums_s = [0.0] * (len(chain.steps) - 1)
        self.latency_s.add(chain.latency_s)
        for number, step in enumerate(chain.steps[:-1]):
            self.step_sums_s[number] += step.travel_s + step.handling_s
            self.travel_sums_s[number] += step.travel_s


@dataclass
class Reactions:
    """The chains behind the commands on `ctrl`.

    Attributes:
        commands: how many commands there were.
        uncaused: how many of them answered nothing: a timer led to them, or nothing of theirs was recorded.
        left_out: how many were of further shapes than are told apart.
        task_id: only commands of this task; empty: of all.
    """

    task_id: str = ""
    commands: int = 0
    uncaused: int = 0
    left_out: int = 0
    _by_shape: dict[tuple[str, ...], Reaction] = field(default_factory=dict)
    _causes: Causes = field(default_factory=lambda: Causes(REMEMBERED))

    def add(self, entry: Entry) -> None:
        """Takes a packet, in the order of time."""
        packet: Packet = entry.packet
        # Of causes only the names and times count; what they said may be large.
        self._causes.add(Entry(entry.time_ns, entry.agent, msgspec.structs.replace(packet, body=None)))
        if packet.channel != CTRL or isinstance(packet.body, Hold) or agent_of(packet.source) != entry.agent:
            return
        if self.task_id and (packet.fence is None or packet.fence.task_id != self.task_id):
            return
        self.commands += 1
        chain = self._causes.chain(packet.source, packet.seq)
        if chain is None or len(chain.steps) < 2:
            self.uncaused += 1
            return
        reaction = self._by_shape.get(chain.shape)
        if reaction is None:
            if len(self._by_shape) >= MOST_SHAPES:
                self.left_out += 1
                return
            reaction = self._by_shape[chain.shape] = Reaction(chain.shape)
        reaction.add(chain)

    def reactions(self) -> list[Reaction]:
        """Returns the chains by their shape, the most frequent first."""
        return sorted(self._by_shape.values(), key=lambda it: (-it.count, it.steps))
