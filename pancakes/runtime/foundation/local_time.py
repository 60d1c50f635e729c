"""A moment on an agent's own mission clock, how well it is known, and the reader of a packet, who has such a clock."""

from __future__ import annotations

from contextvars import ContextVar
from typing import Any, Final, Protocol

import msgspec


class LocalTime(msgspec.Struct, frozen=True):
    """When something happened elsewhere, on one's own clock.

    Attributes:
        time_s: the moment, in one's own mission time, in seconds; negative: before one's own mission began.
        bound_s: the true moment lies no further from it, in mission seconds, as long as both clocks run evenly.
    """

    time_s: float
    bound_s: float


class Reader(Protocol):
    """A task or service that reads a packet."""

    def now(self) -> float:
        """Returns the mission time of its agent, in seconds."""

    def local_time(self, packet: Any) -> LocalTime | None:
        """Returns when a packet was published, on the clock of its agent; None: that is not known."""


READER: Final[ContextVar[Reader | None]] = ContextVar("READER", default=None)
"""The task or service whose turn a thread gives now; None: it gives none."""
