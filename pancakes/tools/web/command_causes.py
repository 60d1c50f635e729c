"""Explain why actuators were commanded: the chain of packets from a sensor reading to each recent command. Pure.

In a running fleet, `FleetTraces` builds the chains from what each agent reports of its own packets.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from pancakes.control import Traces
from pancakes.packet import Cause, Packet, agent_of
from pancakes.recording.causal_chains import ActuatorCommand, Causes, Chain, body_text, chain_rows, is_command
from pancakes.recording.records import NANOSECONDS, RecordedPacket
from pancakes.tools.report.time_series import Distribution

REMEMBERED: Final = 30_000
"""How many packets are kept until their chains are complete."""
SOON_S: Final = 0.5
"""The pause between two questions to an agent that other agents' chains lead to, in seconds."""
BUSY_S: Final = 2.0
"""The same for an agent whose actuators are commanded; long, because answering costs more than recording."""
IDLE_S: Final = 4.0
"""The same for any other agent."""
PATIENCE_S: Final = 6.0
"""How long other agents may take to report their part of a chain, in seconds."""
LOOK_S: Final = 0.5
"""How often complete and expired chains are looked for, in seconds."""
MOST_ASKED: Final = 250
"""The most packets of other agents that one question asks about."""
MOST_TRACED_COMMANDS: Final = 1200
"""The most commands in one round of questions to all agents, so that a page does not slow the fleet."""
FEW_COMMANDS: Final = 10
"""The least number of commands that each agent is asked for, even in a large fleet."""


@dataclass(slots=True)
class _Open:
    """A command whose chain may be incomplete."""

    packet: Packet
    time_ns: int
    t: float
    until: float


@dataclass(slots=True)
class _AgentProgress:
    """How much an agent has reported so far, and what it is still asked for."""

    since_ns: int = 0
    left_out: int = 0
    answers: bool = True
    busy: bool = True
    wanted: dict[Cause, None] = field(default_factory=dict)


class FleetTraces:
    """Take the answers to `Traces` of all agents, and give commands with their chains.

    Times `t` are seconds on the page's timeline.
    """

    def __init__(self) -> None:
        self._causes = Causes(REMEMBERED)
        self._progress: dict[str, _AgentProgress] = {}
        self._missing: set[Cause] = set()
        self._open: dict[Cause, _Open] = {}
        self._look_at = 0.0

    def question(self, agent: str) -> Traces:
        """Return what to ask an agent now."""
        progress = self._of(agent)
        progress.answers = True
        most = max(FEW_COMMANDS, MOST_TRACED_COMMANDS // len(self._progress))
        return Traces(progress.since_ns, tuple(progress.wanted)[:MOST_ASKED], most)

    def pause_s(self, agent: str) -> float:
        """Return how long to wait after a question to an agent before the next one."""
        progress = self._of(agent)
        return SOON_S if progress.wanted else BUSY_S if progress.busy else IDLE_S

    def left_out(self, agent: str) -> int:
        """Return how many commands of an agent were left out because there were too many."""
        return self._of(agent).left_out

    def take(self, agent: str, asked: Sequence[Cause], result: Mapping[str, Any], t: float) -> None:
        """Take an answer.

        Args:
            agent: the agent that answered.
            asked: the packets that it was asked about.
            result: its result, see `Traces`.
            t: when it arrived.
        """
        self._look_at = t
        progress = self._of(agent)
        now_ns = int(result["now_ns"])
        before_ns, progress.since_ns = progress.since_ns, int(result["until_ns"])
        progress.busy = bool(result["rows"])
        progress.left_out += int(result["left_out"])
        for key in asked:
            progress.wanted.pop(key, None)
            self._missing.discard(key)
        for time_ns, channel, type_, source, seq, stamp, cause, number, body in result["rows"]:
            packet = Packet(channel, type_, source, "", stamp, seq, body, (cause, number) if cause else None)
            self._causes.add(RecordedPacket(time_ns, agent, packet))
            key = (source, seq)
            other = agent_of(source)
            if other != agent:
                self._want(other, key)
            elif is_command(agent, packet) and before_ns < time_ns <= progress.since_ns:
                at = t - (now_ns - time_ns) / NANOSECONDS
                self._open[key] = _Open(packet, time_ns, at, t + PATIENCE_S)

    def settled(self, t: float) -> list[tuple[float, ActuatorCommand]]:
        """Return the commands whose chains are complete or have waited long enough, each with its time."""
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
        """Stop waiting for the answers of an agent that does not answer, until it is asked again."""
        progress = self._of(agent)
        self._missing.difference_update(progress.wanted)
        progress.wanted.clear()
        progress.answers = False

    def _want(self, agent: str, key: Cause) -> None:
        progress = self._progress.get(agent)
        # Do not wait for an agent that does not answer.
        if progress is not None and progress.answers and key not in progress.wanted:
            progress.wanted[key] = None
            self._missing.add(key)

    def _of(self, agent: str) -> _AgentProgress:
        return self._progress.setdefault(agent, _AgentProgress())


MOST_COMMANDS: Final = 20_000
"""The most commands that are kept, shared equally among the actuators; beyond that the oldest are dropped."""
FEW: Final = 100
"""The least number of commands that are kept of each actuator."""
BINS: Final = 30
"""The number of bars of a histogram."""


@dataclass(order=True, frozen=True, slots=True)
class _TimedCommand:
    """A command, and its time on the timeline."""

    t: float
    number: int
    command: ActuatorCommand = field(compare=False)


class CommandExplainer:
    """Keep the commands of the last minutes, and explain any of them.

    Times `t` are seconds on the page's timeline.
    """

    def __init__(self, most: int = MOST_COMMANDS) -> None:
        self._most = most
        self._given: dict[tuple[str, str], list[_TimedCommand]] = {}
        self._kinds: dict[tuple[str, ...], Distribution] = {}
        self._count = 0

    def add(self, commands: Iterable[tuple[float, ActuatorCommand]]) -> set[str]:
        """Take commands, each with its time; return the agents with an actuator that is commanded for the first time.

        `actuators` returns the actuators of an agent.
        """
        new = set()
        for t, command in commands:
            key = (command.agent, command.packet.type)
            given = self._given.get(key)
            if given is None:
                given = self._given[key] = []
                new.add(command.agent)
            self._count += 1
            insort(given, _TimedCommand(t, self._count, command))
            if len(given) > 1.25 * (most := max(FEW, self._most // len(self._given))):
                del given[: len(given) - most]
            if command.caused:
                self._kinds.setdefault(command.chain.shape, Distribution()).add(command.chain.latency_s)
        return new

    def actuators(self, agent: str) -> list[str]:
        """Return the types of the commanded actuators of an agent."""
        return sorted(type_ for name, type_ in self._given if name == agent)

    def explain(
        self, agent: str, type_: str = "", t: float | None = None, command: Cause | None = None, step: int = 0
    ) -> dict[str, Any] | None:
        """Return why a command was given, as plain values; None if no command is known.

        Args:
            agent: the agent with the actuator.
            type_: the actuator's type; empty: the actuator that was commanded last, at `t`.
            t: choose the command that was in force at this moment; None: the newest command.
            command: choose the command by its source and number instead of by `t`.
            step: choose the command this many after it, or before it if negative.

        Returns:
            `agent`, `type`, `source`, `seq`, `t`, `mission_s`; `place` among the `count` commands that are known, from
            1; `actuators`; `steps`, the first cause first, each with `source`, `seq`, `number`, `channel`, `type`,
            `body`, `at_ms` (since the first), `travel_ms` (to the next agent) and `handling_ms` (until the next was
            published); and `alike`: of the commands whose chain has the same shape `count`, `p50_ms`, `p90_ms`,
            `p99_ms`, `max_ms` from end to end, and `bars` of a histogram from `from_ms` to `to_ms`, whose last bar also
            counts all longer times. `alike` is None if no packet is known that caused the command.
        """
        found = self._find(agent, type_, t, command)
        if found is None:
            return None
        kept_type, place = found
        given = self._given[agent, kept_type]
        place = min(max(place + step, 0), len(given) - 1)
        it = given[place]
        packet = it.command.packet
        return {
            "agent": agent,
            "type": kept_type,
            "source": packet.source,
            "seq": packet.seq,
            "t": round(it.t, 3),
            "mission_s": round(packet.stamp_s, 3),
            "place": place + 1,
            "count": len(given),
            "actuators": self.actuators(agent),
            "steps": _steps(it.command.chain),
            "alike": _spread(self._kinds[it.command.chain.shape]) if it.command.caused else None,
        }

    def _find(self, agent: str, type_: str, t: float | None, command: Cause | None) -> tuple[str, int] | None:
        """Return the type of the actuator, and the index of the command among its commands."""
        best: tuple[float, str, int] | None = None
        for name in [type_] if type_ else self.actuators(agent):
            given = self._given.get((agent, name))
            if not given:
                continue
            if command is not None:
                for place, it in enumerate(given):
                    if (it.command.packet.source, it.command.packet.seq) == command:
                        return name, place
            place = len(given) - 1 if t is None else bisect_right(given, t, key=lambda it: it.t) - 1
            if best is None or (place >= 0 and given[place].t > best[0]):
                best = (given[place].t if place >= 0 else float("-inf"), name, max(0, place))
        return best[1:] if best is not None else None


TIMES: Final = ("at_ms", "travel_ms", "handling_ms")
"""The times of a step: 0 if unknown, or if the agents' clocks disagree so that they would be negative."""


def _steps(chain: Chain) -> list[dict[str, Any]]:
    return [
        {**row, **{key: max(0.0, row[key] or 0.0) for key in TIMES}, "body": body_text(step.packet.body)}
        for row, step in zip(chain_rows(chain), chain.steps, strict=True)
    ]


def _spread(sample: Distribution) -> dict[str, Any]:
    low_s = min(sample.kept)
    # A few very long times would squeeze all others into one bar, so the last bar takes them.
    high_s = max(sample.quantile(0.97), low_s + 1e-6)
    bars = [0] * BINS
    for value in sample.kept:
        bars[min(BINS - 1, int(BINS * (value - low_s) / (high_s - low_s)))] += 1
    return {
        "count": sample.count,
        **{f"{name}_ms": _ms(value_s) for name, value_s in sample.quantiles().items()},
        "max_ms": _ms(sample.largest),
        "from_ms": _ms(low_s),
        "to_ms": _ms(high_s),
        "bars": bars,
    }


def _ms(seconds: float) -> float:
    return round(max(0.0, 1000.0 * seconds), 3)
