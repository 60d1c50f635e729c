"""Why actuators were commanded: of any command the chain back to the sensor reading, and its times. Pure."""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final

from pancakes.packet import Cause
from pancakes.tools.recording.chains import Chain
from pancakes.tools.recording.commands import ActuatorCommand, body_text
from pancakes.tools.recording.recorded_packet import NANOSECONDS
from pancakes.tools.report.series import Distribution

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


class Explaining:
    """Keeps the commands of the last minutes, and explains any of them.

    Times `t` are seconds on the page's timeline.
    """

    def __init__(self, most: int = MOST_COMMANDS) -> None:
        self._most = most
        self._given: dict[tuple[str, str], list[_TimedCommand]] = {}
        self._kinds: dict[tuple[str, ...], Distribution] = {}
        self._count = 0

    def add(self, commands: Iterable[tuple[float, ActuatorCommand]]) -> set[str]:
        """Takes commands, each with its time; returns the agents of which an actuator was commanded for the first time.

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
        """Returns which actuators of an agent were commanded, by their types."""
        return sorted(type_ for name, type_ in self._given if name == agent)

    def explain(
        self, agent: str, type_: str = "", t: float | None = None, command: Cause | None = None, step: int = 0
    ) -> dict[str, Any] | None:
        """Returns why a command was given, as plain values; None where there is none.

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
            all that took longer. It is None where the command answers no packet that is known.
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
        """Returns the actuator's type, and the place of the command among those to it."""
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


def _steps(chain: Chain) -> list[dict[str, Any]]:
    first_ns = chain.steps[0].time_ns
    return [
        {
            "source": step.packet.source,
            "seq": step.packet.seq,
            "number": step.packet.number,
            "channel": step.packet.channel,
            "type": step.packet.type,
            "body": body_text(step.packet.body),
            "at_ms": _ms((step.time_ns - first_ns) / NANOSECONDS),
            "travel_ms": _ms(step.travel_s),
            "handling_ms": _ms(step.handling_s),
        }
        for step in chain.steps
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
