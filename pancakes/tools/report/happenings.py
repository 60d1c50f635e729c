"""What was said on `log` that matters: warnings, errors, failures, and events of the mission's own. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import msgspec

from pancakes.events import Event, LogLine
from pancakes.packet import LOG, Packet, agent_of
from pancakes.runtime.foundation.arrays import without_arrays

MOST: Final = 300
"""The most different ones that are kept of each sort."""
LONGEST: Final = 300
GRAVE: Final = (
    "task_failed",
    "task_given_up",
    "task_stuck",
    "service_failed",
    "handoff_failed",
    "command_refused",
    "recording_stopped",
)
"""Events that tell of something that went wrong."""
USUAL: Final = (
    "ready",
    "asked",
    "task_started",
    "task_stopped",
    "task_arrived",
    "task_frozen",
    "task_resumed",
    "task_handed_over",
    "service_started",
    "service_stopped",
    "migration",
    "migration_asked",
    "migration_bid",
    "migration_refused",
    "recording_started",
)
"""Events that other parts of the report tell of, or that say little."""


@dataclass
class Happening:
    """Something that was said, once or several times in the same words.

    Attributes:
        t_s: when it was said first.
        agent: the agent that said it.
        kind: `warning`, `error`, or the event's kind.
        text: what.
        count: how often.
    """

    t_s: float
    agent: str
    kind: str
    text: str
    count: int = 1


@dataclass
class Happenings:
    """What was said on `log`.

    Attributes:
        grave: warnings, errors and failures.
        told: events of the mission's own.
        left_out: how many different ones there were beyond those that are kept.
    """

    grave: list[Happening] = field(default_factory=list)
    told: list[Happening] = field(default_factory=list)
    left_out: int = 0
    _known: dict[tuple[str, str, str], Happening] = field(default_factory=dict)

    def add(self, agent: str, packet: Packet, t_s: float) -> None:
        """Takes a packet that was seen on an agent."""
        if packet.channel != LOG or agent_of(packet.source) != agent:
            return
        body = packet.body
        if isinstance(body, LogLine) and body.level in ("warning", "error"):
            self._note(self.grave, t_s, agent, body.level, body.text)
        elif isinstance(body, Event) and body.kind in GRAVE:
            self._note(self.grave, t_s, agent, body.kind, _text(body.fields))
        elif isinstance(body, Event) and body.kind not in USUAL:
            self._note(self.told, t_s, agent, body.kind, _text(body.fields))

    def _note(self, into: list[Happening], t_s: float, agent: str, kind: str, text: str) -> None:
        text = text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"
        known = self._known.get((agent, kind, text))
        if known is not None:
            known.count += 1
        elif len(into) >= MOST:
            self.left_out += 1
        else:
            happening = self._known[agent, kind, text] = Happening(t_s, agent, kind, text)
            into.append(happening)


def _text(fields: Any) -> str:
    plain: dict[str, Any] = msgspec.to_builtins(without_arrays(fields))
    return ", ".join(f"{key} {_short(value)}" for key, value in plain.items() if value not in ("", None, {}, []))


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
