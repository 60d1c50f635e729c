"""Keep the clocks of all peers of an agent, and tell each peer the clocks of this one.

It runs in the transport's thread; `clock_of`, `describe` and `missions` may be called from any thread. What is known of
a peer outlives its link. The estimates themselves are in `pancakes.mesh.clock_sync`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import msgspec

from pancakes.mesh.clock_sync import ClockEstimate, PeerClock, PeerMission
from pancakes.mesh.link import Measured
from pancakes.mesh.links import Links
from pancakes.mesh.session import Session
from pancakes.util.timebase import Timebase

DAY_STEP_S: Final = 0.01
"""A change of the time of day by less than this is not sent."""
MOST_REMEMBERED: Final = 512
"""At most this many peers' clocks are kept, including those of peers whose links have ended."""


class _PeerKnown(msgspec.Struct):
    """What is known of one peer.

    Attributes:
        life: its journal and boot: another life has another mission and perhaps another clock.
        estimate: of its host clock.
        timebase: its last message about its clocks; None: none yet.
    """

    life: tuple[str, int, str]
    estimate: ClockEstimate
    timebase: Timebase | None = None


class PeerClocks:
    """The clocks of one agent's peers. In the transport's thread, except methods marked "any thread".

    What is known of a peer outlives its link, and gets less precise with time. If the peer comes back in the same life,
    it is used again at once.

    Args:
        own: returns the agent's own mission time and time of day; None: this is a terminal, which has none.
        now: the host clock.
        links: the links of the agent.
        tell: sends a message over a link.
    """

    def __init__(
        self,
        own: Callable[[], Timebase] | None,
        now: Callable[[], float],
        links: Links,
        tell: Callable[[Session, Timebase], None],
    ) -> None:
        self._own = own
        self._now = now
        self._links = links
        self._tell = tell
        self._known: dict[str, _PeerKnown] = {}
        self._clocks: dict[str, PeerClock] = {}

    def clock_of(self, peer: str) -> PeerClock | None:
        """Return what is known of a peer's clocks; None: nothing. Any thread."""
        return self._clocks.get(peer)

    def describe(self, peer: str) -> dict[str, Any] | None:
        """Compare a peer's clocks with one's own, as plain values; None: nothing is known. Any thread."""
        clock, own, now_s = self._clocks.get(peer), self._own, self._now()
        if clock is None or own is None:
            return None
        offset, base = clock.offset, own()
        mission_s, own_zero_s = clock.mission_at(now_s), base.zero_s()
        ahead_s = None
        if mission_s is not None and own_zero_s is not None and clock.timebase.speed == base.speed:
            ahead_s = mission_s - (now_s - own_zero_s) * base.speed
        return {
            "offset_s": offset.offset_at(now_s),
            "bound_s": offset.bound_at(now_s),
            "drift": offset.drift,
            "drift_bound": offset.drift_bound,
            "mission_ahead_s": ahead_s,
            "day_ahead_s": clock.day_ahead_s(base, now_s),
        }

    def missions(self, may_say: Callable[[str], bool]) -> tuple[tuple[PeerMission, ...], bool]:
        """Return the missions of the linked agents that may tell theirs, and whether one is not known yet.

        Any thread. Terminals do not take part in the mission.
        """
        found, unknown, now_s = [], False, self._now()
        for session in self._links:
            if session.role == "client" or not may_say(session.peer):
                continue
            clock = self._clocks.get(session.peer)
            if clock is None:
                unknown = True
            elif (mission_s := clock.mission_at(now_s)) is not None and mission_s >= 0.0:
                zero_s, speed = now_s - mission_s / clock.timebase.speed, clock.timebase.speed
                found.append(PeerMission(session.peer, zero_s, clock.offset.bound_at(now_s), speed))
        return tuple(found), unknown

    def on_link_up(self, session: Session) -> None:
        """Note that a link is up."""
        hello = session.hello
        assert hello is not None
        life = (hello.journal, hello.boot, hello.life)
        known = self._known.pop(hello.name, None)
        if known is None or known.life != life:
            known = _PeerKnown(life, ClockEstimate())
            self._clocks.pop(hello.name, None)
        self._known[hello.name] = known
        while len(self._known) > MOST_REMEMBERED:
            self._forget(next(iter(self._known)))
        self._tell_own(session)

    def on_link_ended(self, session: Session) -> None:
        """Note that a link has ended."""
        if session.role == "client":  # each has a new name
            self._forget(session.peer)
        elif (known := self._known.get(session.peer)) is not None:
            known.estimate.rest()

    def on_mission_changed(self) -> None:
        """Tell all peers that the agent's own mission has begun."""
        for session in self._links:
            self._tell_own(session)

    def on_answer(self, session: Session, what: Measured | Timebase) -> None:
        """Take a peer's answer to a ping, or its message about its clocks."""
        known = self._known.get(session.peer)
        if known is None or not session.is_up:  # before the link is up, its owner is not known
            return
        if isinstance(what, Timebase):
            known.timebase = what
        else:
            if not known.estimate.take(what.sent_s, what.peer_s, what.back_s) and session.link is not None:
                session.link.hurry()
            self._tell_own(session)
        if known.estimate.found is not None and known.timebase is not None:
            self._clocks[session.peer] = PeerClock(known.estimate.found, known.timebase)

    def _tell_own(self, session: Session) -> None:
        """Send a peer this agent's clocks, unless it has their present values."""
        if self._own is None:
            return
        own, told = self._own(), session.told_timebase
        if told is not None and _mission_of(told) == _mission_of(own) and _same_day(told.day_s, own.day_s):
            return
        session.told_timebase = own
        self._tell(session, own)

    def _forget(self, peer: str) -> None:
        self._known.pop(peer, None)
        self._clocks.pop(peer, None)


def _mission_of(timebase: Timebase) -> tuple[float | None, float, float]:
    return timebase.began_s, timebase.start_s, timebase.speed


def _same_day(told_s: float | None, own_s: float | None) -> bool:
    return told_s == own_s if told_s is None or own_s is None else abs(told_s - own_s) <= DAY_STEP_S
