"""The commands that a report lets one look at one by one: evenly spread, and the slowest. Pure, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass, field
from heapq import heappush, heappushpop
from typing import Any, Final

from pancakes.packet import agent_of
from pancakes.tools.recording.chains import ChainStep
from pancakes.tools.recording.commands import ActuatorCommand, body_text
from pancakes.tools.recording.mission_time import MissionTime

MOST_EVEN: Final = 24_000
"""The most commands that are kept, as many of each actuator; where there were more, each second one is left out, ..."""
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
        """Makes one of a command; not of its stamp, as an agent that is started again counts its time anew."""
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
        """Takes a command, in the order of time; keeps at most so many, the slowest aside."""
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
        """Returns those that were kept, oldest first."""
        by_number = dict(self._even)
        by_number.update((-number, picked) for _, number, picked in self._slow)
        return [by_number[number] for number in sorted(by_number)]

    def slowest(self) -> list[PickedCommand]:
        """Returns those that took longest from their first cause, the slowest first."""
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
        """Takes a command, in the order of time."""
        key = (agent_of(command.packet.source), command.packet.type)
        actuator = self._by_actuator.get(key)
        if actuator is None:
            if len(self._by_actuator) >= MOST_ACTUATORS:
                self.left_out += 1
                return
            actuator = self._by_actuator[key] = ActuatorCommands(*key)
        actuator.add(command, min(MOST_EVEN_EACH, MOST_EVEN // len(self._by_actuator)), self.time)

    def actuators(self) -> list[ActuatorCommands]:
        """Returns the actuators that were commanded, by name."""
        return [actuator for _, actuator in sorted(self._by_actuator.items())]

    def plain(self) -> dict[str, Any]:
        """Returns all of it as plain values, each name once.

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
