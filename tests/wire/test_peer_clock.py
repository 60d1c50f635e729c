"""What the stamps of a peer mean on one's own clock."""

from __future__ import annotations

import itertools
import math

import pytest

from pancakes.mesh.clock_sync import ClockOffset, PeerClock
from pancakes.util.timebase import Timebase

OFFSET = ClockOffset(50.0, 1000.0, 0.001, 0.0, 0.0001)
OWN = Timebase(20.0, 0.0, 1.0, 1e9)


def test_a_stamp_is_told_in_ones_own_mission_time():
    clock = PeerClock(OFFSET, Timebase(1030.0, 5.0, 2.0))
    local = clock.local_time(25.0, OWN)  # 10 host seconds after the peer's mission began at 5, at 30 of one's own
    assert local is not None
    assert local.time_s == pytest.approx(20.0)
    assert local.bound_s == pytest.approx(0.001 + 0.0001 * 10.0)
    fast = clock.local_time(25.0, Timebase(20.0, 100.0, 10.0))
    assert fast is not None
    assert (fast.time_s, fast.bound_s) == (pytest.approx(300.0), pytest.approx(0.02))
    assert clock.mission_at(40.0) == pytest.approx(25.0)


def test_a_moment_before_ones_own_mission_began_is_negative():
    local = PeerClock(OFFSET, Timebase(1000.0)).local_time(5.0, OWN)
    assert local is not None and local.time_s == pytest.approx(-15.0)


def test_what_says_nothing_is_told_nothing():
    clock = PeerClock(OFFSET, Timebase(1030.0, 5.0))
    assert clock.local_time(4.9, OWN) is None  # of an earlier life
    assert clock.local_time(0.0, OWN) is None  # while it was held
    assert clock.local_time(6.0, Timebase()) is None
    assert PeerClock(OFFSET, Timebase()).local_time(6.0, OWN) is None
    assert PeerClock(OFFSET, Timebase()).mission_at(6.0) is None


def test_the_times_of_day_are_compared_at_one_moment():
    # The peer's host clock is ahead by 1000 s, so at one moment its day is by 7 s.
    assert PeerClock(OFFSET, Timebase(day_s=1e9 - 993.0)).day_ahead_s(OWN, 50.0) == pytest.approx(7.0)
    assert PeerClock(OFFSET, Timebase()).day_ahead_s(OWN, 50.0) is None
    assert PeerClock(OFFSET, Timebase(day_s=1e9)).day_ahead_s(Timebase(), 50.0) is None


def test_whatever_a_peer_may_say_gives_numbers():
    bounds = {
        "offset_s": (-1e12, 0.0, 1e12),
        "drift": (-0.1, 0.0, 0.1),
        "began_s": (-1e12, 0.0, 1e12),
        "start_s": (0.0, 1e9),
        "speed": (1e-6, 1.0, 1e6),
        "stamp": (0.0, 1e-300, 1.0, 1e15),
    }
    for offset_s, drift, began_s, start_s, speed, stamp in itertools.product(*bounds.values()):
        clock = PeerClock(ClockOffset(1.0, offset_s, 0.1, drift, 0.2), Timebase(began_s, start_s, speed, began_s))
        local, mission_s = clock.local_time(stamp, OWN), clock.mission_at(5.0)
        assert local is None or (math.isfinite(local.time_s) and local.bound_s >= 0 and math.isfinite(local.bound_s))
        assert mission_s is not None and math.isfinite(mission_s)
