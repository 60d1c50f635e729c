"""Estimate the clocks of a peer from heartbeats, and convert its stamps to this agent's mission time. Pure.

A pong carries the host time at which it was sent. That moment lies between the ping and the pong here, so half a
round trip bounds the error. Of each period the answer with the shortest round trip is kept (NTP's clock filter, RFC
5905). `ClockEstimate` derives offset, drift and bounds; `PeerClock` adds the peer's mission time and time of day.
`mission_of_fleet` chooses the running mission that an agent joins when it starts. For the exchange over links see
`pancakes.mesh.peer_clocks`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec

from pancakes.packet import LocalTime
from pancakes.util.timebase import Timebase

MOST_DRIFT: Final = 0.1
"""Pancakes cannot work with two clocks whose rates differ by more than this."""
WANDER: Final = 2e-5
"""How much the rate of a clock may change while it is observed: it depends on temperature, or is disciplined."""
SHARE: Final = 0.1
"""Round trips that exceed the shortest by at most this share of it count about as much."""
STEADY_S: Final = 1e-5
"""They also exceed it by at most this."""
SOON_S: Final = 0.5
"""Only answers that are further apart than this tell much about the drift."""
MOST_KEPT: Final = 32
LONGEST_SLOT_S: Final = 5.0
"""At least one of the answers in this time is kept."""
BETTER: Final = 0.5
"""An answer whose error is at most this share of the present bound is believed at once, others with the next slot."""
SLOTS: Final = 8
"""How many answers are kept while less time has passed than this number of the longest slots."""


class ClockOffset(msgspec.Struct, frozen=True):
    """The offset of a peer's host clock from one's own.

    Attributes:
        at_s: the moment of that offset, in one's own host time.
        offset_s: how far the peer's clock is ahead then, in seconds.
        bound_s: the error of `offset_s` is at most this.
        drift: how many seconds the peer's clock gains in each second of one's own.
        drift_bound: the error of `drift` is at most this.
    """

    at_s: float
    offset_s: float
    bound_s: float
    drift: float = 0.0
    drift_bound: float = MOST_DRIFT

    def offset_at(self, own_s: float) -> float:
        """Return how far the peer's clock is ahead at a moment of one's own host time."""
        return self.offset_s + self.drift * (own_s - self.at_s)

    def bound_at(self, own_s: float) -> float:
        """Return the bound on the error of that offset."""
        return self.bound_s + self.drift_bound * abs(own_s - self.at_s)

    def own_s(self, peer_s: float) -> float:
        """Return one's own host time at a moment of the peer's."""
        return self.at_s + (peer_s - self.at_s - self.offset_s) / (1.0 + self.drift)


class PingAnswer(msgspec.Struct, frozen=True):
    """An answer to a ping that was kept.

    Attributes:
        slot_s: the begin of its slot, in host time.
        at_s: the middle of its round trip.
        offset_s: how far the peer's clock was ahead.
        error_s: half the round trip.
    """

    slot_s: float
    at_s: float
    offset_s: float
    error_s: float


class ClockEstimate:
    """The estimate of one peer's host clock. For one thread.

    Attributes:
        found: the estimated offset from one's own clock; None: never measured.
        kept: the answers that it is computed from, the oldest first.
    """

    def __init__(self) -> None:
        self.found: ClockOffset | None = None
        self.kept: list[PingAnswer] = []

    def take(self, sent_s: float, peer_s: float, back_s: float) -> bool:
        """Take the answer to a ping.

        Args:
            sent_s: when the ping left, in one's own host time.
            peer_s: when it was answered, in the peer's.
            back_s: when the answer came, in one's own.

        Returns:
            Whether it agrees with the estimate so far. If it does not, one of the clocks was set, or its machine was
            paused,
                and only this answer counts from now on.
        """
        at_s, error_s = (sent_s + back_s) / 2, (back_s - sent_s) / 2
        offset_s, found = peer_s - at_s, self.found
        fits = found is None or abs(offset_s - found.offset_at(at_s)) <= error_s + found.bound_at(at_s)
        if not fits:
            self.kept.clear()
        # The estimate is computed again when it can become much better, not for each of many similar answers.
        if self._keep(at_s, offset_s, error_s) or found is None or error_s < BETTER * found.bound_at(at_s):
            self.found = self._believed(at_s)
        return fits

    def rest(self) -> None:
        """Keep only the estimate, as the link has ended. The answers take a hundred times the memory."""
        self.kept.clear()

    def _keep(self, at_s: float, offset_s: float, error_s: float) -> bool:
        """Keep the best answer of each slot of time. Return whether a slot has begun with this one."""
        kept = self.kept
        if kept:
            last = kept[-1]
            slot_s = min(LONGEST_SLOT_S, (at_s - kept[0].slot_s) / SLOTS)
            if at_s - last.slot_s < slot_s:
                if error_s <= last.error_s + self._growth() * (at_s - last.at_s):
                    kept[-1] = PingAnswer(last.slot_s, at_s, offset_s, error_s)
                return False
        kept.append(PingAnswer(at_s, at_s, offset_s, error_s))
        if len(kept) > MOST_KEPT:
            del kept[0]
        return True

    def _growth(self) -> float:
        """Return by how much the error of an answer grows in each second."""
        return self.found.drift_bound if self.found is not None else MOST_DRIFT

    def _believed(self, at_s: float) -> ClockOffset:
        """Return the likely offset that all answers allow; the oldest are dropped until there is one."""
        while len(self.kept) > 1:
            drifts = self._allowed_drifts(at_s)
            lowest_s = max([it.offset_s - it.error_s + drifts[0] * (at_s - it.at_s) for it in self.kept])
            highest_s = min([it.offset_s + it.error_s + drifts[1] * (at_s - it.at_s) for it in self.kept])
            if drifts[0] <= drifts[1] and lowest_s <= highest_s:
                offset_s, drift = self._likely(at_s, *drifts)
                offset_s = _within(offset_s, lowest_s, highest_s)
                bound_s = max(offset_s - lowest_s, highest_s - offset_s)
                return ClockOffset(at_s, offset_s, bound_s, drift, max(drift - drifts[0], drifts[1] - drift))
            del self.kept[0]
        (answer,) = self.kept
        return ClockOffset(answer.at_s, answer.offset_s, answer.error_s)

    def _allowed_drifts(self, at_s: float) -> tuple[float, float]:
        """Return the least and the greatest drift that the answers allow; if the first is greater, they allow none."""
        growth = self._growth()
        errors_s = [it.error_s + growth * abs(at_s - it.at_s) for it in self.kept]
        newest = self.kept[errors_s.index(min(errors_s))]
        lows, highs = [-MOST_DRIFT], [MOST_DRIFT]
        for other in self.kept:
            between_s = newest.at_s - other.at_s
            if between_s == 0.0:
                continue
            slope = (newest.offset_s - other.offset_s) / between_s
            error = (newest.error_s + other.error_s) / abs(between_s) + WANDER
            lows.append(slope - error)
            highs.append(slope + error)
        return max(lows), min(highs)

    def _likely(self, at_s: float, least: float, most: float) -> tuple[float, float]:
        """Return the offset at a moment and the drift, by a line through the answers with the shortest round trips."""
        shortest_s = min([it.error_s for it in self.kept])
        rows = []
        for it in self.kept:
            excess_s = it.error_s - shortest_s + SHARE * shortest_s + STEADY_S + WANDER * abs(at_s - it.at_s)
            rows.append((1.0 / (excess_s * excess_s), it.at_s - at_s, it.offset_s))
        weight = sum([share for share, _, _ in rows])
        middle_s = sum([share * later_s for share, later_s, _ in rows]) / weight
        offset_s = sum([share * ahead_s for share, _, ahead_s in rows]) / weight
        spread = sum([share * (later_s - middle_s) ** 2 for share, later_s, _ in rows])
        common = sum([share * (later_s - middle_s) * (ahead_s - offset_s) for share, later_s, ahead_s in rows])
        # Answers that are close in time tell only noise about the drift, and most clocks have almost no drift.
        usual, firm = (0.0 if least <= 0.0 <= most else (least + most) / 2), weight * SOON_S * SOON_S
        drift = _within((common + firm * usual) / (spread + firm), least, most)
        return offset_s - drift * middle_s, drift


def _within(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


ROUNDING_S: Final = 1e-6
"""A stamp that lies before the beginning of its mission by at most this counts as the beginning."""


class PeerClock(msgspec.Struct, frozen=True):
    """What is known of the clocks of a peer.

    Attributes:
        offset: the offset of its host clock from one's own.
        timebase: its mission time and time of day, by its host clock.
    """

    offset: ClockOffset
    timebase: Timebase

    def local_time(self, stamp_s: float, own: Timebase) -> LocalTime | None:
        """Convert a stamp of the peer to one's own mission clock.

        Args:
            stamp_s: the peer's mission time.
            own: one's own clocks.

        Returns:
            None if it cannot be converted: one of the two missions is held, or the stamp is from a held mission, or
                from an earlier life of the peer.
        """
        theirs = self.timebase
        zero_s, own_zero_s = theirs.zero_s(), own.zero_s()
        if zero_s is None or own_zero_s is None or stamp_s <= 0.0 or stamp_s < theirs.start_s - ROUNDING_S:
            return None
        host_s = self.offset.own_s(zero_s + stamp_s / theirs.speed)
        return LocalTime((host_s - own_zero_s) * own.speed, self.offset.bound_at(host_s) * own.speed)

    def mission_at(self, own_s: float) -> float | None:
        """Return the peer's mission time at a moment of one's own host time, in seconds; None: its mission is held."""
        zero_s = self.timebase.zero_s()
        return (own_s + self.offset.offset_at(own_s) - zero_s) * self.timebase.speed if zero_s is not None else None

    def day_ahead_s(self, own: Timebase, now_s: float) -> float | None:
        """Return how far the peer's time of day is ahead of one's own; None: one of the two is not set.

        Args:
            own: one's own clocks.
            now_s: one's own host time.
        """
        theirs_s, own_s = self.timebase.day_s, own.day_s
        return theirs_s - own_s + self.offset.offset_at(now_s) if theirs_s is not None and own_s is not None else None


AGREE_S: Final = 1.0
"""Missions that are at most this far apart are the same, in mission seconds: agents never begin quite together."""


class PeerMission(msgspec.Struct, frozen=True):
    """The mission of a peer.

    Attributes:
        peer: the peer.
        zero_s: the asking agent's host time when the mission was 0; negative if that was before its clock began.
        bound_s: the error of `zero_s` is at most this, in host seconds.
        speed: mission seconds for each host second.
    """

    peer: str
    zero_s: float
    bound_s: float
    speed: float


def mission_of_fleet(missions: Sequence[PeerMission], speed: float) -> PeerMission | None:
    """Return the mission to join: the one that most peers have, so that no single peer misleads; of two, the older.

    Args:
        missions: those of the peers.
        speed: the speed of the mission here; a mission at another speed is another one.

    Returns:
        Of the peers that agree, the one with the smallest bound; None: no mission runs.
    """
    same = [it for it in missions if it.speed == speed]
    groups = [
        [it for it in same if abs(it.zero_s - one.zero_s) * speed <= AGREE_S + (it.bound_s + one.bound_s) * speed]
        for one in same
    ]
    if not groups:
        return None
    chosen = max(groups, key=lambda group: (len(group), -min(it.zero_s for it in group)))
    return min(chosen, key=lambda it: (it.bound_s, it.peer))
