"""Measure what led to the commands of actuators: the chain of packets and the time of each step. Pure, bounded memory.

`Reactions` groups chains of the same shape. `PickedCommands` keeps single commands for a person to look at: an even
sample, and the slowest.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from heapq import heappush, heappushpop
from typing import Any, Final

from pancakes.packet import agent_of
from pancakes.recording.causal_chains import ActuatorCommand, Chain, ChainStep, CommandChains, body_text
from pancakes.recording.clock_alignment import MissionTime
from pancakes.recording.records import RecordedPacket
from pancakes.tools.report.time_series import Distribution

MOST_EVEN: Final = 24_000
"""The most commands in the even sample, shared equally among the actuators; beyond that every second one is dropped."""
MOST_EVEN_EACH: Final = 4000
"""The most commands of one actuator in the even sample."""
MOST_SLOW: Final = 50
"""How many of the slowest commands to each actuator are kept in addition."""
MOST_ACTUATORS: Final = 100
"""The most actuators; commands to further ones are only counted."""
BODY_CHARACTERS: Final = 60


@dataclass(frozen=True, slots=True)
class PickedCommand:
    """A command and its chain, with only what a report shows.

    Attributes:
        mission_s: when it was given, in mission time.
        text: its body as text, cut off after some characters.
        steps: the packets of its chain: the first cause first, the command last.
        latency_s: the time from the first cause to the command.
    """

    mission_s: float
    text: str
    steps: tuple[ChainStep, ...]
    latency_s: float

    @classmethod
    def of(cls, command: ActuatorCommand, time: MissionTime) -> PickedCommand:
        """Convert a command. Its stamp is not used: a restarted agent counts mission time from 0 again."""
        text = body_text(command.packet.body, BODY_CHARACTERS)
        return cls(time.at(command.time_ns), text, command.chain.steps, command.chain.latency_s)


@dataclass
class ActuatorCommands:
    """The commands to one actuator.

    Attributes:
        agent: the agent with the actuator.
        type: the device type of the actuator.
        count: how many commands there were.
        stride: one of this many is in the even sample.
    """

    agent: str
    type: str
    count: int = 0
    stride: int = 1
    _even: list[tuple[int, PickedCommand]] = field(default_factory=list)
    _slow: list[tuple[float, int, PickedCommand]] = field(default_factory=list)

    def add(self, command: ActuatorCommand, most: int, time: MissionTime) -> None:
        """Take a command, in the order of time; keep at most `most` in the even sample."""
        number = self.count
        self.count += 1
        latency_s = command.chain.latency_s
        even = number % self.stride == 0
        slow = len(self._slow) < MOST_SLOW or latency_s > self._slow[0][0]
        if not even and not slow:
            return
        picked = PickedCommand.of(command, time)
        if slow:
            (heappush if len(self._slow) < MOST_SLOW else heappushpop)(self._slow, (latency_s, -number, picked))
        if even:
            self._even.append((number, picked))
            if len(self._even) > most:
                self._even = self._even[::2]
                self.stride *= 2

    def commands(self) -> list[PickedCommand]:
        """Return the commands that were kept, oldest first."""
        by_number = dict(self._even)
        by_number.update((-number, picked) for _, number, picked in self._slow)
        return [by_number[number] for number in sorted(by_number)]

    def slowest(self) -> list[PickedCommand]:
        """Return the commands with the longest time from their first cause, the slowest first."""
        return [picked for _, _, picked in sorted(self._slow, key=lambda it: (-it[0], -it[1])) if len(picked.steps) > 1]


@dataclass
class PickedCommands:
    """The commands that were kept, by actuator.

    Attributes:
        time: converts recording time to mission time.
        left_out: how many commands were left out because there were too many actuators.
    """

    time: MissionTime = MissionTime()
    left_out: int = 0
    _by_actuator: dict[tuple[str, str], ActuatorCommands] = field(default_factory=dict)

    def add(self, command: ActuatorCommand) -> None:
        """Take a command, in the order of time."""
        key = (agent_of(command.packet.source), command.packet.type)
        actuator = self._by_actuator.get(key)
        if actuator is None:
            if len(self._by_actuator) >= MOST_ACTUATORS:
                self.left_out += 1
                return
            actuator = self._by_actuator[key] = ActuatorCommands(*key)
        actuator.add(command, min(MOST_EVEN_EACH, MOST_EVEN // len(self._by_actuator)), self.time)

    def actuators(self) -> list[ActuatorCommands]:
        """Return the actuators that were commanded, by name."""
        return [actuator for _, actuator in sorted(self._by_actuator.items())]

    def plain(self) -> dict[str, Any]:
        """Return all commands as plain values for the page, with each name only once.

        `names`: publishers with the types of their packets. `kinds`: the shapes of chains, each a list of indices in
        `names`. `texts`: the bodies of commands. `actuators`: `agent`, `type`, `count`, `stride`, and `commands`, each
        a list: mission time in ms, index in `texts`, index in `kinds`, the packet number of each step, and for each
        step except the last the microseconds on its way, and the microseconds until the next packet.
        """
        names: dict[str, int] = {}
        kinds: dict[tuple[int, ...], int] = {}
        texts: dict[str, int] = {}
        actuators = []
        for actuator in self.actuators():
            rows = []
            for it in actuator.commands():
                kind = tuple(names.setdefault(step.name, len(names)) for step in it.steps)
                before = it.steps[:-1]
                rows.append(
                    [
                        round(1e3 * it.mission_s),
                        texts.setdefault(it.text, len(texts)),
                        kinds.setdefault(kind, len(kinds)),
                        [step.packet.number for step in it.steps],
                        [round(1e6 * step.travel_s) for step in before],
                        [round(1e6 * step.handling_s) for step in before],
                    ]
                )
            actuators.append(
                {
                    "agent": actuator.agent,
                    "type": actuator.type,
                    "count": actuator.count,
                    "stride": actuator.stride,
                    "commands": rows,
                }
            )
        return {"names": list(names), "kinds": list(kinds), "texts": list(texts), "actuators": actuators}


MOST_SHAPES: Final = 200
"""The most shapes of chains; chains of further shapes are only counted."""


@dataclass
class Reaction:
    """All chains of one shape: the same packet types of the same sources, in the same order.

    Attributes:
        steps: publisher and packet type of each step, the first cause first.
        latency_s: the times from the first cause to the command.
        step_sums_s: for each step except the last, the sum of the times to the next step, travel included.
        travel_sums_s: the part of `step_sums_s` that was spent between agents.
    """

    steps: tuple[str, ...]
    latency_s: Distribution = field(default_factory=Distribution)
    step_sums_s: list[float] = field(default_factory=list)
    travel_sums_s: list[float] = field(default_factory=list)

    @property
    def count(self) -> int:
        """How many chains there are."""
        return self.latency_s.count

    @property
    def step_means_s(self) -> list[float]:
        """The mean time from each step except the last to the next one."""
        return [total / self.count for total in self.step_sums_s]

    @property
    def travel_means_s(self) -> list[float]:
        """The part of `step_means_s` that was spent between agents."""
        return [total / self.count for total in self.travel_sums_s]

    def add(self, chain: Chain) -> None:
        """Add a chain of this shape."""
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
        task_id: count only the commands of this task; empty: of all tasks.
        commands: how many commands there were.
        uncaused: how many of them have no known cause: a timer led to them, or their cause was not recorded.
        left_out: how many were left out because there were too many shapes.
        picked: the commands that a person can look at one by one.
    """

    task_id: str = ""
    commands: int = 0
    uncaused: int = 0
    left_out: int = 0
    picked: PickedCommands = field(default_factory=PickedCommands)
    _by_shape: dict[tuple[str, ...], Reaction] = field(default_factory=dict)
    # Only names and times of causes are needed; their bodies may be large.
    _chains: CommandChains = field(default_factory=lambda: CommandChains(bodies=False))

    def add(self, entry: RecordedPacket) -> None:
        """Take a packet, in the order of time."""
        self._take(self._chains.add(entry))

    def close(self) -> None:
        """Take the commands that still wait for causes: no more packets will come."""
        self._take(self._chains.close())

    def add_command(self, command: ActuatorCommand) -> None:
        """Count a command of any task."""
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
        """Return the chains grouped by shape, the most frequent first."""
        return sorted(self._by_shape.values(), key=lambda it: (-it.count, it.steps))

    def alike(self, chain: Chain) -> Reaction | None:
        """Return all chains with the shape of `chain`; None if that shape was left out."""
        return self._by_shape.get(chain.shape)

    def _take(self, commands: list[ActuatorCommand]) -> None:
        for command in commands:
            fence = command.packet.fence
            if not self.task_id or (fence is not None and fence.task_id == self.task_id):
                self.add_command(command)
