"""Cause and effect: what led to the commands of actuators, over which steps, and how long each took. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from pancakes.tools.recording.chains import Chain
from pancakes.tools.recording.commands import ActuatorCommand, CommandChains
from pancakes.tools.recording.recorded_packet import RecordedPacket
from pancakes.tools.report.picked import PickedCommands
from pancakes.tools.report.series import Distribution

MOST_SHAPES: Final = 200
"""The most kinds of chains that are told apart."""


@dataclass
class Reaction:
    """All chains of one shape: the same packet types of the same sources, in the same order.

    Attributes:
        steps: publisher and packet type of each step, the first cause first.
        latency_s: from the first cause to the command.
        step_sums_s: of each step but the last, the time to the next one: summed, travel included.
        travel_sums_s: of that, the time between agents.
    """

    steps: tuple[str, ...]
    latency_s: Distribution = field(default_factory=Distribution)
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
        task_id: only commands of this task; empty: of all.
        commands: how many commands there were.
        uncaused: how many of them answered nothing: a timer led to them, or nothing of theirs was recorded.
        left_out: how many were of further shapes than are told apart.
        picked: those that can be looked at one by one.
    """

    task_id: str = ""
    commands: int = 0
    uncaused: int = 0
    left_out: int = 0
    picked: PickedCommands = field(default_factory=PickedCommands)
    _by_shape: dict[tuple[str, ...], Reaction] = field(default_factory=dict)
    # Of causes only the names and times count; what they said may be large.
    _chains: CommandChains = field(default_factory=lambda: CommandChains(bodies=False))

    def add(self, entry: RecordedPacket) -> None:
        """Takes a packet, in the order of time."""
        self._take(self._chains.add(entry))

    def close(self) -> None:
        """Takes what is left, now that no more packets come."""
        self._take(self._chains.close())

    def add_command(self, command: ActuatorCommand) -> None:
        """Counts a command, whatever task gave it."""
        self.commands += 1
        self.picked.add(command)
        if not command.caused:
            self.uncaused += 1
            return
        shape = command.chain.shape
        reaction = self._by_shape.get(shape)
        if reaction is None:
            if len(self._by_shape) >= MOST_SHAPES:
                self.left_out += 1
                return
            reaction = self._by_shape[shape] = Reaction(shape)
        reaction.add(command.chain)

    def reactions(self) -> list[Reaction]:
        """Returns the chains by their shape, the most frequent first."""
        return sorted(self._by_shape.values(), key=lambda it: (-it.count, it.steps))

    def alike(self, chain: Chain) -> Reaction | None:
        """Returns all chains of the shape of one; None where that is none that is told apart."""
        return self._by_shape.get(chain.shape)

    def _take(self, commands: list[ActuatorCommand]) -> None:
        for command in commands:
            fence = command.packet.fence
            if not self.task_id or (fence is not None and fence.task_id == self.task_id):
                self.add_command(command)
