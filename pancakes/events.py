"""What is said on the `log` channel: events for programs, lines for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import msgspec

from pancakes.packet import packet_type

LEVELS: Final = ("debug", "info", "warning", "error")


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
    """

    level: str
    text: str
