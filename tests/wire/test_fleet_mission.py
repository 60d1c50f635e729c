"""Which mission time an agent takes that has just begun."""

from __future__ import annotations

from pancakes.mesh.clock_sync import PeerMission, mission_of_fleet


def mission(peer, zero_s, bound_s=0.001, speed=1.0):
    return PeerMission(peer, zero_s, bound_s, speed)


def test_where_there_is_none_there_is_none():
    assert mission_of_fleet([], 1.0) is None
    assert mission_of_fleet([mission("a", 0.0, speed=2.0)], 1.0) is None


def test_of_peers_that_agree_the_one_that_is_known_best_is_taken():
    known = [mission("a", 10.0, 0.002), mission("c", 10.3, 0.001), mission("b", 10.2, 0.001)]
    assert mission_of_fleet(known, 1.0) == known[2]


def test_most_peers_are_right_against_one_that_claims_an_old_mission():
    known = [mission("a", 10.0), mission("liar", -1e9), mission("b", 10.1)]
    assert mission_of_fleet(known, 1.0) in (known[0], known[2])


def test_of_two_missions_of_as_many_peers_the_older_is_taken():
    known = [mission("a", 10.0), mission("b", 4.0)]
    assert mission_of_fleet(known, 1.0) == known[1]


def test_what_is_known_badly_may_be_the_same_mission():
    known = [mission("a", 10.0), mission("b", 14.0, 4.0), mission("c", -100.0)]
    assert mission_of_fleet(known, 1.0) == known[0]


def test_missions_are_as_far_apart_as_they_say_in_mission_time():
    known = [mission("a", 10.0, 0.0, 10.0), mission("b", 9.5, 0.0, 10.0), mission("c", 9.45, 0.0, 10.0)]
    assert mission_of_fleet(known, 10.0) in known[1:]
