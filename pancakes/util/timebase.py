"""An agent's mission time and time of day relative to its host clock. Pure."""

from __future__ import annotations

from typing import Annotated

import msgspec

Moment = Annotated[float, msgspec.Meta(ge=-1e12, le=1e12)]
"""A moment of a clock, in seconds, within bounds, because other agents send it."""


class Timebase(msgspec.Struct, frozen=True, array_like=True, tag=10):
    """The sender's mission time and time of day, relative to its host clock.

    Agents send it to each other at first and after changes; the tag is its number among the messages of a link.

    Attributes:
        began_s: when its mission began, in its host time; None: it has not begun.
        start_s: the mission time at which it began, in seconds.
        speed: its mission seconds for each host second.
        day_s: the time of day, in seconds since 1970 (UTC), at 0 of its host clock; None: unknown.
    """

    began_s: Moment | None = None
    start_s: Annotated[float, msgspec.Meta(ge=0, le=1e9)] = 0.0
    speed: Annotated[float, msgspec.Meta(ge=1e-6, le=1e6)] = 1.0
    day_s: Moment | None = None

    def zero_s(self) -> float | None:
        """Return the host time at which the mission time was, or would have been, 0; None: the mission is held."""
        return None if self.began_s is None else self.began_s - self.start_s / self.speed
