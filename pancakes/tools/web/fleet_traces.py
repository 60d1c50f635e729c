"""Puts together what agents tell of the packets that led to their commands. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from pancakes.control import Traces
from pancakes.packet import Cause, Packet, agent_of
from pancakes.tools.recording.chains import Causes
from pancakes.tools.recording.commands import ActuatorCommand, is_command
from pancakes.tools.recording.recorded_packet import NANOSECONDS, RecordedPacket

REMEMBERED: Final = 30_000
"""The number of packets that are remembered until all of their chains are known."""
SOON_S: Final = 0.5
"""The pause before an agent is asked again to which the chains of another one lead, ..."""
BUSY_S: Final = 2.0
"""... before one whose actuators are commanded: a question costs it more than the notes for the answer, ..."""
IDLE_S: Final = 4.0
"""... and before any other."""
PATIENCE_S: Final = 6.0
"""The time that other agents have to tell what they know of a chain."""
LOOK_S: Final = 0.5
"""How often it is checked whether that time has passed."""
MOST_ASKED: Final = 250
"""The most packets of other agents that one question asks about."""
MOST_COMMANDS: Final = 1200
"""The most commands in a round of questions, of all agents together: a page must not slow the fleet; ..."""
FEW_COMMANDS: Final = 10
"""... and the least of each agent."""


@dataclass(slots=True)
class _Open:
    """A command whose chain may not be known yet."""

    packet: Packet
    time_ns: int
    t: float
    until: float


@dataclass(slots=True)
class _Told:
    """How far an agent has told what it knows."""

    since_ns: int = 0
    left_out: int = 0
    answers: bool = True
    busy: bool = True
    wanted: dict[Cause, None] = field(default_factory=dict)


class FleetTraces:
    """Takes the answers to `Traces` of all agents, and gives commands with their chains.

    Times `t` are seconds on the page's timeline.
    """

    def __init__(self) -> None:
        self._causes = Causes(REMEMBERED)
        self._told: dict[str, _Told] = {}
        self._missing: set[Cause] = set()
        self._open: dict[Cause, _Open] = {}
        self._look_at = 0.0

    def question(self, agent: str) -> Traces:
        """Returns what to ask an agent now."""
        told = self._of(agent)
        told.answers = True
        most = max(FEW_COMMANDS, MOST_COMMANDS // len(self._told))
        return Traces(told.since_ns, tuple(told.wanted)[:MOST_ASKED], most)

    def pause_s(self, agent: str) -> float:
        """Returns how long to wait after a question to an agent before the next one."""
        told = self._of(agent)
        return SOON_S if told.wanted else BUSY_S if told.busy else IDLE_S

    def left_out(self, agent: str) -> int:
        """Returns how many commands of an agent there were too many of."""
        return self._of(agent).left_out

    def take(self, agent: str, asked: Sequence[Cause], result: Mapping[str, Any], t: float) -> None:
        """Takes an answer.

        Args:
            agent: the agent that answered.
            asked: the packets that it was asked about.
            result: its result, see `Traces`.
            t: when it came.
        """
        self._look_at = t
        told = self._of(agent)
        now_ns = int(result["now_ns"])
        before_ns, told.since_ns = told.since_ns, int(result["until_ns"])
        told.busy = bool(result["rows"])
        told.left_out += int(result["left_out"])
        for key in asked:
            told.wanted.pop(key, None)
            self._missing.discard(key)
        for time_ns, channel, type_, source, seq, stamp, cause, number, said in result["rows"]:
            packet = Packet(channel, type_, source, "", stamp, seq, said, (cause, number) if cause else None)
            self._causes.add(RecordedPacket(time_ns, agent, packet))
            key = (source, seq)
            other = agent_of(source)
            if other != agent:
                self._want(other, key)
            elif is_command(agent, packet) and before_ns < time_ns <= told.since_ns:
                at = t - (now_ns - time_ns) / NANOSECONDS
                self._open[key] = _Open(packet, time_ns, at, t + PATIENCE_S)

    def settled(self, t: float) -> list[tuple[float, ActuatorCommand]]:
        """Returns the commands whose chains are known now, and those that were waited for long enough, with when."""
        if t < self._look_at:
            return []
        self._look_at = t + LOOK_S
        found = []
        for key, it in list(self._open.items()):
            chain = self._causes.chain(*key)
            if chain is None:
                del self._open[key]
                continue
            missing = any((step.packet.source, step.packet.seq) in self._missing for step in chain.steps)
            if not missing or t >= it.until:
                del self._open[key]
                found.append((it.t, ActuatorCommand(it.time_ns, it.packet, chain)))
        return found

    def forget(self, agent: str) -> None:
        """Waits no longer for what an agent might tell that cannot be asked; until it is asked again."""
        told = self._of(agent)
        self._missing.difference_update(told.wanted)
        told.wanted.clear()
        told.answers = False

    def _want(self, agent: str, key: Cause) -> None:
        told = self._told.get(agent)
        # No answer is awaited of an agent that cannot be asked.
        if told is not None and told.answers and key not in told.wanted:
            told.wanted[key] = None
            self._missing.add(key)

    def _of(self, agent: str) -> _Told:
        return self._told.setdefault(agent, _Told())
