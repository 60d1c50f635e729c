"""What is said on the `log` channel: events for programs, lines for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import msgspec

from pancakes.packet import packet_type
from pancakes.runtime.foundation.log import LEVELS as LEVELS

SAID_IN_A_LINE: Final = frozenset(
    (
        *("task_failed", "task_given_up", "task_stuck", "service_failed", "command_refused"),
        *("taken_over", "takeover_waits", "guard_thin", "disk_is_old"),
    )
)
"""Kinds of events of which a line tells people the same, so that an event would tell them twice."""


@packet_type("event")
class Event(msgspec.Struct, frozen=True):
    """Something that happened, in a form that programs read.

    Attributes:
        kind: what happened, such as `task_started`.
        fields: its particulars, as plain values.
    """

    kind: str
    fields: Mapping[str, Any] = msgspec.field(default_factory=dict)


@packet_type("line")
class LogLine(msgspec.Struct, frozen=True):
    """A line for people.

    Attributes:
        level: one of `LEVELS`.
        text: the line.
        traceback: where it tells of a failure, the traceback of that; else empty.
    """

    level: str
    text: str
    traceback: str = ""


def level_of(body: Any) -> str:
    """Returns the level of what is said on `log`: an event is `info`, or `debug` where a line says the same."""
    if isinstance(body, LogLine):
        return body.level
    return "debug" if isinstance(body, Event) and body.kind in SAID_IN_A_LINE else "info"
