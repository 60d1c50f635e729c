"""What is said on the `log` channel: events for programs, lines for people."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from pancakes.packet import packet_type

LEVELS: Final = ("debug", "info", "warning", "error")


@packet_type("event")
@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened, in a form that programs read.

    Attributes:
        kind: what happened, such as `task_started`.
        fields: its particulars, as plain values.
    """

    kind: str
    fields: Mapping[str, Any] = field(default_factory=dict)


@packet_type("line")
@dataclass(frozen=True, slots=True)
class LogLine:
    """A line for people; `level` is one of `LEVELS`."""

    level: str
    text: str
