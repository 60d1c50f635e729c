"""What led to the commands of actuators, over which steps, and how long each took. Pure, in bounded memory.

`Reactions` groups chains of one shape. `PickedCommands` keeps commands for a person to look at one by one: evenly
spread, and the slowest.
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
"""The most commands that are kept, as many of each actuator; if there were more, each second one is left out, ..."""
MOST_EVEN_EACH: Final = 4000
"""... and the most of one actuator."""
MOST_SLOW: Final = 50
"""The number of the slowest to each actuator that are kept as well."""
MOST_ACTUATORS: Final = 100
"""The most actuators that are told apart."""
BODY_CHARACTERS: Final = 60


@dataclass(frozen=True, slots=True)
class PickedCommand:
    """A command and its chain, as little of it as a report tells.

    Attributes:
        mission_s: when it was given.
        text: what it said, cut off after some characters.
        steps: what led to it, the first cause first and itself last.
        latency_s: from the first cause to it.
    """

    mission_s: float
    text: str
    steps: tuple[ChainStep, ...]
    latency_s: float

    @classmethod
    def of(cls, command: ActuatorCommand, time: MissionTime) -> PickedCommand:
        """Make one of a command; not of its stamp, as an agent that is started again counts its time from scratch."""
        text = body_text(command.packet.body, BODY_CHARACTERS)
        return cls(time.at(command.time_ns), text, command.chain.steps, command.chain.latency_s)


@dataclass
class ActuatorCommands:
    """The commands to one actuator.

    Attributes:
        agent: where it is.
        type: its device type.
        count: how many commands there were.
        stride: of so many one was kept, the slowest aside.
    """

    agent: str
    type: str
    count: int = 0
    stride: int = 1
    _even: list[tuple[int, PickedCommand]] = field(default_factory=list)
    _slow: list[tuple[float, int, PickedCommand]] = field(default_factory=list)

    def add(self, command: ActuatorCommand, most: int, time: MissionTime) -> None:
        """Take a command, in the order of time; keep at most so many, the slowest aside."""
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
        """Return those that were kept, oldest first."""
        by_number = dict(self._even)
        by_number.update((-number, picked) for _, number, picked in self._slow)
        return [by_number[number] for number in sorted(by_number)]

    def slowest(self) -> list[PickedCommand]:
        """Return those that took longest from their first cause, the slowest first."""
        return [picked for _, _, picked in sorted(self._slow, key=lambda it: (-it[0], -it[1])) if len(picked.steps) > 1]


@dataclass
class PickedCommands:
    """What was kept of all commands.

    Attributes:
        time: turns the recording's time into mission time.
        left_out: how many were to further actuators than are told apart.
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
        """Return all of it as plain values, each name once.

        `names`: publishers with the types of their packets. `kinds`: the shapes of chains, each a list of places in
        `names`. `texts`: what commands said. `actuators`: `agent`, `type`, `count`, `stride`, and `commands`, each a
        list: mission time in ms, place in `texts`, place in `kinds`, the number of each step's packet, and of each step
        but the last the microseconds on its way, and until the next.
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
        """Take a packet, in the order of time."""
        self._take(self._chains.add(entry))

    def close(self) -> None:
        """Take what is left, now that no more packets come."""
        self._take(self._chains.close())

    def add_command(self, command: ActuatorCommand) -> None:
        """Count a command, whatever task gave it."""
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
        """Return the chains by their shape, the most frequent first."""
        return sorted(self._by_shape.values(), key=lambda it: (-it.count, it.steps))

    def alike(self, chain: Chain) -> Reaction | None:
        """Return all chains of the shape of one; None if that is none that is told apart."""
        return self._by_shape.get(chain.shape)

    def _take(self, commands: list[ActuatorCommand]) -> None:
        for command in commands:
            fence = command.packet.fence
            if not self.task_id or (fence is not None and fence.task_id == self.task_id):
                self.add_command(command)
