"""Why an actuator was commanded: the chain back to the sensor reading, and how long its steps took. Pure."""

from __future__ import annotations

from collections import deque
from typing import Any, Final

import msgspec

from pancakes.control import Hold
from pancakes.packet import CTRL, Packet, agent_of
from pancakes.recording.chains import Causes, Chain, latencies
from pancakes.recording.entry import NANOSECONDS, Entry

REMEMBERED: Final = 20_000
"""So many packets are remembered."""
COMMANDS: Final = 500
"""So many commands to the actuators of each agent are remembered: for how long their chains took."""
BODY_CHARACTERS: Final = 160
"""A packet's body is shown in so many characters."""


class Explaining:
    """Learns packets and explains commands. Times are seconds as they pass for whoever watches.

    Packets bear the mission time of their publisher. How that lies on the timeline is told by the packet of each agent
    that was the least held up on its way here, of all that were heard; so what happens inside an agent is exact, and
    what lies between two agents is as exact as that.
    """

    def __init__(self, limit: int = REMEMBERED) -> None:
        self._heard: deque[tuple[str, Packet, float, float]] = deque(maxlen=limit)
        self._commands: dict[str, deque[tuple[str, int]]] = {}
        self._offsets: dict[str, float] = {}

    def hear(self, agent: str, packet: Packet, t: float, speed: float) -> None:
        """Takes a packet that was seen on an agent's channel.

        Args:
            agent: on whose channel.
            packet: the packet.
            t: when it came here.
            speed: how fast the publisher's mission time goes.
        """
        source = agent_of(packet.source)
        offset = t - packet.stamp / speed
        if source == agent:
            self._offsets[source] = min(self._offsets.get(source, offset), offset)
        else:
            self._offsets.setdefault(source, offset)
        self._heard.append((agent, packet, t, packet.stamp / speed))
        if packet.channel == CTRL and source == agent and not isinstance(packet.body, Hold):
            self._commands.setdefault(agent, deque(maxlen=COMMANDS)).append((packet.source, packet.seq))

    def explain(self, agent: str) -> dict[str, Any] | None:
        """Returns why the newest command on an agent was given, as plain values; None where there was none.

        `steps`: the first cause first, each with `source`, `channel`, `type`, `body`, `at_ms` (since the first),
        `travel_ms` (to the agent of the next step) and `handling_ms` (until the next was published). `alike`: of the
        commands with a chain of the same shape, `count`, and `p50_ms`, `p90_ms` and `max_ms` from end to end.
        """
        causes = self._causes()
        chains = [
            chain for source, seq in self._commands.get(agent, ()) if (chain := causes.chain(source, seq)) is not None
        ]
        if not chains:
            return None
        newest = chains[-1]
        alike = next(it for it in latencies(chains) if it.shape == newest.shape)
        return {
            "agent": agent,
            "steps": _steps(newest),
            "alike": {
                "count": len(alike.seconds),
                "p50_ms": _ms(alike.quantile_s(0.5)),
                "p90_ms": _ms(alike.quantile_s(0.9)),
                "max_ms": _ms(alike.seconds[-1]),
            },
        }

    def _causes(self) -> Causes:
        """Only now: a packet that comes later may tell better how an agent's time lies on the timeline."""
        causes = Causes(REMEMBERED)
        for agent, packet, t, stamp_s in self._heard:
            source = agent_of(packet.source)
            causes.add(Entry(round((self._offsets[source] + stamp_s) * NANOSECONDS), source, packet))
            if source != agent:
                causes.add(Entry(round(t * NANOSECONDS), agent, packet))
        return causes


def _steps(chain: Chain) -> list[dict[str, Any]]:
    first_ns = chain.steps[0].time_ns
    return [
        {
            "source": step.packet.source,
            "channel": step.packet.channel,
            "type": step.packet.type,
            "body": _text(step.packet.body),
            "at_ms": _ms((step.time_ns - first_ns) / NANOSECONDS),
            "travel_ms": _ms(step.travel_s),
            "handling_ms": _ms(step.handling_s),
        }
        for step in chain.steps
    ]


def _ms(seconds: float) -> float:
    return round(max(0.0, 1000.0 * seconds), 3)


def _text(body: Any) -> str:
    plain = msgspec.to_builtins(body, enc_hook=str, str_keys=True)
    if isinstance(plain, dict):
        text = ", ".join(f"{name} {_value(value)}" for name, value in plain.items())
    else:
        text = _value(plain)
    return text if len(text) <= BODY_CHARACTERS else text[: BODY_CHARACTERS - 1] + "…"


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple) and (len(value) > 4 or any(isinstance(it, dict) for it in value)):
        return f"{len(value)} values"
    return str(value)
