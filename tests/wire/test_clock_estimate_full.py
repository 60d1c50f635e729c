"""The searches of test_clock_estimate.py with more seeds."""

from __future__ import annotations

from seeded import for_each
from wire import test_clock_estimate as short


def test_clock_error_below_half_a_round_trip_full():
    for_each([(seed, drift) for seed in range(10) for drift in short.DRIFTS], short.check_error_bound)


def test_clock_error_of_a_way_longer_in_one_direction_full():
    for_each(range(5), short.check_long_way)


def test_clock_of_wandering_rate_is_followed_full():
    for_each(range(5), short.check_wandering_rate)


def test_clock_of_a_peer_that_answers_anything_full():
    for_each(range(20), short.check_any_answers)
