"""How a peer's clock stands to one's own, as the heartbeats of the link to it tell. Pure.

A ping is answered with the host time at which that is done. That moment lies between the two at which the ping left and
the answer came back: the peer's clock is known to half a round trip. Of all answers in each while the one with the
shortest round trip is kept (the clock filter of NTP, RFC 5905). What all of them allow bounds the error.
"""

from __future__ import annotations

from typing import Final

import msgspec

MOST_DRIFT: Final = 0.1
"""Two clocks whose rates differ by more than this are none that Pancakes can work with."""
WANDER: Final = 2e-5
"""So much the rate of a clock may change while it is looked at: by its temperature, or because it is disciplined."""
SHARE: Final = 0.1
"""Ways that are longer than the shortest by no more than this share of it count about as much."""
STEADY_S: Final = 1e-5
"""And by no more than this."""
SOON_S: Final = 0.5
"""Answers must be further apart than this to tell much about the drift."""
MOST_KEPT: Final = 32
LONGEST_SLOT_S: Final = 5.0
"""Of the answers in so long a time one is kept at least."""
SLOTS: Final = 8
"""So many are kept of the time that has passed, where that is less than as many of the longest slots."""


class ClockOffset(msgspec.Struct, frozen=True):
    """How a peer's host clock stands to one's own.

    Attributes:
        at_s: the moment at which it stands so, in one's own host time.
        offset_s: how far the peer's clock is ahead then, in seconds.
        bound_s: the truth lies no further from it.
        drift: how many seconds the peer's clock gains in each second of one's own.
        drift_bound: the truth lies no further from it.
    """

    at_s: float
    offset_s: float
    bound_s: float
    drift: float = 0.0
    drift_bound: float = MOST_DRIFT

    def offset_at(self, own_s: float) -> float:
        """Returns how far the peer's clock is ahead at a moment of one's own host time."""
        return self.offset_s + self.drift * (own_s - self.at_s)

    def bound_at(self, own_s: float) -> float:
        """Returns how far from the truth that may be."""
        return self.bound_s + self.drift_bound * abs(own_s - self.at_s)

    def own_s(self, peer_s: float) -> float:
        """Returns one's own host time at a moment of the peer's."""
        return self.at_s + (peer_s - self.at_s - self.offset_s) / (1.0 + self.drift)


class PingAnswer(msgspec.Struct, frozen=True):
    """An answer to a ping that was kept.

    Attributes:
        slot_s: since when it is the best one, in host time.
        at_s: the middle of its round trip.
        offset_s: how far the peer's clock was ahead.
        error_s: half the round trip.
    """

    slot_s: float
    at_s: float
    offset_s: float
    error_s: float


class ClockEstimate:
    """What is believed of one peer's host clock. One thread.

    Attributes:
        found: how it stands to one's own; None: that was never measured.
        kept: the answers that it rests on, the oldest first.
    """

    def __init__(self) -> None:
        self.found: ClockOffset | None = None
        self.kept: list[PingAnswer] = []

    def take(self, sent_s: float, peer_s: float, back_s: float) -> bool:
        """Takes the answer to a ping.

        Args:
            sent_s: when the ping left, in one's own host time.
            peer_s: when it was answered, in the peer's.
            back_s: when the answer came, in one's own.

        Returns:
            Whether it goes with what was believed before. Where it does not, one of the clocks was set, or stood still
            with its machine, and only this answer is believed.
        """
        at_s, error_s = (sent_s + back_s) / 2, (back_s - sent_s) / 2
        offset_s, found = peer_s - at_s, self.found
        fits = found is None or abs(offset_s - found.offset_at(at_s)) <= error_s + found.bound_at(at_s)
        if not fits:
            self.kept.clear()
        self._keep(at_s, offset_s, error_s)
        self.found = self._believed(at_s)
        return fits

    def rest(self) -> None:
        """The link has ended: keeps what is believed, without the answers, which take a hundred times the room."""
        self.kept.clear()

    def _keep(self, at_s: float, offset_s: float, error_s: float) -> None:
        kept = self.kept
        if kept:
            last = kept[-1]
            slot_s = min(LONGEST_SLOT_S, (at_s - kept[0].slot_s) / SLOTS)
            if at_s - last.slot_s < slot_s:
                if error_s <= last.error_s + self._growth() * (at_s - last.at_s):
                    kept[-1] = PingAnswer(last.slot_s, at_s, offset_s, error_s)
                return
        kept.append(PingAnswer(at_s, at_s, offset_s, error_s))
        if len(kept) > MOST_KEPT:
            del kept[0]

    def _growth(self) -> float:
        """Returns by how much an answer gets worse in each second."""
        return self.found.drift_bound if self.found is not None else MOST_DRIFT

    def _believed(self, at_s: float) -> ClockOffset:
        """Returns what is likely among what all answers allow; the oldest are given up until they allow something."""
        while len(self.kept) > 1:
            drifts = self._allowed_drifts(at_s)
            lowest_s = max(it.offset_s - it.error_s + drifts[0] * (at_s - it.at_s) for it in self.kept)
            highest_s = min(it.offset_s + it.error_s + drifts[1] * (at_s - it.at_s) for it in self.kept)
            if drifts[0] <= drifts[1] and lowest_s <= highest_s:
                offset_s, drift = self._likely(at_s, *drifts)
                offset_s = _within(offset_s, lowest_s, highest_s)
                bound_s = max(offset_s - lowest_s, highest_s - offset_s)
                return ClockOffset(at_s, offset_s, bound_s, drift, max(drift - drifts[0], drifts[1] - drift))
            del self.kept[0]
        (answer,) = self.kept
        return ClockOffset(answer.at_s, answer.offset_s, answer.error_s)

    def _allowed_drifts(self, at_s: float) -> tuple[float, float]:
        """Returns the least and the greatest drift that the answers allow: none, where the first is the greater."""
        growth = self._growth()
        newest = min(self.kept, key=lambda it: it.error_s + growth * abs(at_s - it.at_s))
        low, high = -MOST_DRIFT, MOST_DRIFT
        for other in self.kept:
            between_s = newest.at_s - other.at_s
            if between_s == 0.0:
                continue
            slope = (newest.offset_s - other.offset_s) / between_s
            error = (newest.error_s + other.error_s) / abs(between_s) + WANDER
            low, high = max(low, slope - error), min(high, slope + error)
        return low, high

    def _likely(self, at_s: float, least: float, most: float) -> tuple[float, float]:
        """Returns the offset at a moment and the drift: those of a line through the answers with the shortest ways."""
        shortest_s = min(it.error_s for it in self.kept)
        rows = []
        for it in self.kept:
            excess_s = it.error_s - shortest_s + SHARE * shortest_s + STEADY_S + WANDER * abs(at_s - it.at_s)
            rows.append((1.0 / (excess_s * excess_s), it.at_s - at_s, it.offset_s))
        weight = sum(row[0] for row in rows)
        middle_s = sum(row[0] * row[1] for row in rows) / weight
        offset_s = sum(row[0] * row[2] for row in rows) / weight
        spread = sum(row[0] * (row[1] - middle_s) ** 2 for row in rows)
        common = sum(row[0] * (row[1] - middle_s) * (row[2] - offset_s) for row in rows)
        # Answers of one moment tell little of the drift but the noise of their ways; and most clocks have next to none.
        usual, firm = (0.0 if least <= 0.0 <= most else (least + most) / 2), weight * SOON_S * SOON_S
        drift = _within((common + firm * usual) / (spread + firm), least, most)
        return offset_s - drift * middle_s, drift


def _within(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
