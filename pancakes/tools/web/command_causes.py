"""Explain why actuators were commanded: of a recent command the chain back to the sensor reading. Pure.

In a running fleet `FleetTraces` puts the chains together from what each agent reports of its own packets.
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
MOST_TRACED_COMMANDS: Final = 1200
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
    """Take the answers to `Traces` of all agents, and give commands with their chains.

    Times `t` are seconds on the page's timeline.
    """

    def __init__(self) -> None:
        self._causes = Causes(REMEMBERED)
        self._told: dict[str, _Told] = {}
        self._missing: set[Cause] = set()
        self._open: dict[Cause, _Open] = {}
        self._look_at = 0.0

    def question(self, agent: str) -> Traces:
        """Return what to ask an agent now."""
        told = self._of(agent)
        told.answers = True
        most = max(FEW_COMMANDS, MOST_TRACED_COMMANDS // len(self._told))
        return Traces(told.since_ns, tuple(told.wanted)[:MOST_ASKED], most)

    def pause_s(self, agent: str) -> float:
        """Return how long to wait after a question to an agent before the next one."""
        told = self._of(agent)
        return SOON_S if told.wanted else BUSY_S if told.busy else IDLE_S

    def left_out(self, agent: str) -> int:
        """Return how many commands of an agent there were too many of."""
        return self._of(agent).left_out

    def take(self, agent: str, asked: Sequence[Cause], result: Mapping[str, Any], t: float) -> None:
        """Take an answer.

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
        """Return the commands whose chains are known now, and those that were waited for long enough, with when."""
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
        """Wait no longer for what an agent might tell that cannot be asked; until it is asked again."""
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


MOST_COMMANDS: Final = 20_000
"""The most commands that are kept, as many of each actuator; then the oldest are forgotten."""
FEW: Final = 100
"""The least that are kept of each actuator."""
BINS: Final = 30
"""A distribution is shown in so many bars."""


@dataclass(order=True, frozen=True, slots=True)
class _TimedCommand:
    """A command, and where it lies on the timeline."""

    t: float
    number: int
    command: ActuatorCommand = field(compare=False)


class CommandExplainer:
    """Keep the commands of the last minutes, and explains any of them.

    Times `t` are seconds on the page's timeline.
    """

    def __init__(self, most: int = MOST_COMMANDS) -> None:
        self._most = most
        self._given: dict[tuple[str, str], list[_TimedCommand]] = {}
        self._kinds: dict[tuple[str, ...], Distribution] = {}
        self._count = 0

    def add(self, commands: Iterable[tuple[float, ActuatorCommand]]) -> set[str]:
        """Take commands, each with its time; return the agents of which an actuator was commanded for the first time.

        Of those, and of all others, `actuators` tells which they are.
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
        """Return which actuators of an agent were commanded, by their types."""
        return sorted(type_ for name, type_ in self._given if name == agent)

    def explain(
        self, agent: str, type_: str = "", t: float | None = None, command: Cause | None = None, step: int = 0
    ) -> dict[str, Any] | None:
        """Return why a command was given, as plain values; None if there is none.

        Args:
            agent: whose actuator was commanded.
            type_: the actuator's type; empty: the one that was commanded last until then.
            t: the command that was in force then: the newest that is no later; None: the newest of all.
            command: this one, by its source and number, and not that at `t`.
            step: so many commands after it, or before it where it is negative.

        Returns:
            `agent`, `type`, `source`, `seq`, `t`, `mission_s`; `place` among the `count` commands that are known, from
            1; `actuators`; `steps`, the first cause first, each with `source`, `seq`, `number`, `channel`, `type`,
            `body`, `at_ms` (since the first), `travel_ms` (to the next agent) and `handling_ms` (until the next was
            published); and `alike`: of the commands whose chain has the same shape `count`, `p50_ms`, `p90_ms`,
            `p99_ms`, `max_ms` from end to end, and `bars` of a histogram from `from_ms` to `to_ms`, the last with
            all that took longer. It is None if the command answers no packet that is known.
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
            "mission_s": round(packet.stamp, 3),
            "place": place + 1,
            "count": len(given),
            "actuators": self.actuators(agent),
            "steps": _steps(it.command.chain),
            "alike": _spread(self._kinds[it.command.chain.shape]) if it.command.caused else None,
        }

    def _find(self, agent: str, type_: str, t: float | None, command: Cause | None) -> tuple[str, int] | None:
        """Return the actuator's type, and the place of the command among those to it."""
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
"""They are 0 if they are not known, or clocks put them below it."""


def _steps(chain: Chain) -> list[dict[str, Any]]:
    return [
        {**row, **{key: max(0.0, row[key] or 0.0) for key in TIMES}, "body": body_text(step.packet.body)}
        for row, step in zip(chain_rows(chain), chain.steps, strict=True)
    ]


def _spread(sample: Distribution) -> dict[str, Any]:
    low_s = min(sample.kept)
    # A few that took very long would leave the others one bar: they are all in the last one.
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
