"""The search of test_local_time.py with more seeds."""

from __future__ import annotations

import itertools

from clocks.test_local_time import CLOCKS, check_stamp
from seeded import for_each


def test_local_time_error_below_half_a_round_trip_full():
    for_each(itertools.product(range(4), CLOCKS), check_stamp)
