"""The clocks of one peer: what its stamps mean on one's own clock. Pure."""

from __future__ import annotations

from typing import Final

import msgspec

from pancakes.mesh.wire.clock_estimate import ClockOffset
from pancakes.mesh.wire.link_messages import Timebase
from pancakes.runtime.foundation.local_time import LocalTime

ROUNDING_S: Final = 1e-6
"""A stamp that lies before the beginning of its mission by no more than this lies at it."""


class PeerClock(msgspec.Struct, frozen=True):
    """What is known of the clocks of a peer.

    Attributes:
        offset: how its host clock stands to one's own.
        timebase: what its mission time and its time of day are, as its host clock counts.
    """

    offset: ClockOffset
    timebase: Timebase

    def local_time(self, stamp_s: float, own: Timebase) -> LocalTime | None:
        """Returns when a stamp of the peer was, on one's own mission clock.

        Args:
            stamp_s: the peer's mission time.
            own: what one's own mission time is.

        Returns:
            None where that cannot be known: one of the two missions is held, or the stamp is that of a mission that was
            held, or of an earlier life of the peer.
        """
        theirs = self.timebase
        zero_s, own_zero_s = theirs.zero_s(), own.zero_s()
        if zero_s is None or own_zero_s is None or stamp_s <= 0.0 or stamp_s < theirs.start_s - ROUNDING_S:
            return None
        host_s = self.offset.own_s(zero_s + stamp_s / theirs.speed)
        return LocalTime((host_s - own_zero_s) * own.speed, self.offset.bound_at(host_s) * own.speed)

    def mission_at(self, own_s: float) -> float | None:
        """Returns the peer's mission time at a moment of one's own host time, in seconds; None: its mission is held."""
        zero_s = self.timebase.zero_s()
        return (own_s + self.offset.offset_at(own_s) - zero_s) * self.timebase.speed if zero_s is not None else None

    def day_ahead_s(self, own: Timebase, now_s: float) -> float | None:
        """Returns how far the peer's time of day is ahead of one's own; None: one of the two has none.

        Args:
            own: what one's own time of day is.
            now_s: one's own host time.
        """
        theirs_s, own_s = self.timebase.day_s, own.day_s
        return theirs_s - own_s + self.offset.offset_at(now_s) if theirs_s is not None and own_s is not None else None
